"""Proofs of the viewer's effects: no bound breaks, changes are those of brute force, and a bound that is too small is found."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from schemas import viewbounds
from schemas.region import Rect
from schemas.scene import Air, Effects, Scene, Sun, Viewer
from schemas.settings import BuildSettings
from tests.contract.picture_files import write_with_rasterio
from tests.reference import effects as reference
from tests.unit.effect_terrains import Array, Case, cases
from tiler.building.build import build_layer
from tiler.effects import bounds
from tiler.effects.camera import Camera, cameras_around
from tiler.effects.candidates import PyramidFacts
from tiler.effects.dataset import measure_dataset
from tiler.effects.levels import compare_levels
from tiler.effects.plan import plan_effects
from tiler.effects.proveview import ViewProof, prove_view
from tiler.effects.statistics import measure_heights
from tiler.stores.dataset import Dataset, open_dataset
from tiler.terrain import make_island


def scene_of(case: Case, **parts: Any) -> Scene:
    return Scene(sun=Sun(azimuth_deg=case.azimuth, elevation_deg=case.elevation), **parts)


@settings(max_examples=60)
@given(case=cases(largest=40), clearance=st.sampled_from([0.5, 30.0, 5000.0]), fov=st.sampled_from([20.0, 60.0, 120.0]))
def test_no_bound_breaks(case: Case, clearance: float, fov: float) -> None:
    assume(min(case.z.shape) >= 5)
    assume(np.isfinite(case.z).any())
    rng = np.random.default_rng(0)
    coarse = case.z[::2, ::2] + rng.normal(size=case.z[::2, ::2].shape) * 0.1 * (float(np.nanmax(case.z)) - float(np.nanmin(case.z)))
    difference = compare_levels(case.z, coarse, case.cell)
    facts = PyramidFacts((difference.height_m,), difference.gradient, detail_sigma_m=0.1)
    scene = scene_of(case, viewer=Viewer(clearance_m=clearance, fov_deg=fov, grid=15), air=Air(visibility_m=1000.0))
    found = measure_heights([case.z], case.z.shape, case.cell, case.sun)
    plan = plan_effects(scene, found, facts)
    proof = ViewProof(scene, facts, (case.z, coarse), case.cell, found.low_m)
    for effect, measure in proof.measures().items():
        bound = plan.effect(effect).bound
        assert bound is None or measure() <= bound * (1 + 1e-6) + 1e-6, effect


def hills(side: int = 129, cell: float = 30.0) -> tuple[Array, tuple[float, float]]:
    return make_island(side, cell).heights_m.astype(np.float64), (cell, cell)


def test_a_globe_moves_the_far_end_of_a_plane() -> None:
    """From 100 m above a plane of 40 km, its end sinks by 125 m: 5 px at a focal length of 1663 px."""
    scene = Scene(sun=Sun(azimuth_deg=0, elevation_deg=45))
    plane = np.zeros((3, 201))
    found = ViewProof(scene, PyramidFacts(), (plane,), (200.0, 200.0), 0.0).curvature_px()
    distance, globe = 40_000.0, scene.ground.radius_m
    ahead = viewbounds.focal_px(1920, 60.0) * (distance / (2 * globe))
    assert ahead * 0.99 < found <= viewbounds.curvature_px(math.hypot(distance, 400), 0, globe, viewbounds.focal_px(1920, 60.0), 1.45)


def test_jumps_are_counted_from_where_levels_change() -> None:
    """A bump that only the fine level has, seen from just outside and from inside of where the coarse one begins."""
    viewer = Viewer(grid=15, clearance_m=10.0)
    scene = Scene(sun=Sun(azimuth_deg=0, elevation_deg=45), viewer=viewer)
    jumps = []
    for column in (3, 15):
        fine = np.zeros((5, 33))
        fine[:, column] = 1.0
        jumps.append(ViewProof(scene, PyramidFacts((1.0,)), (fine[:, :17], fine[::2, 0:17:2] * 0), (10.0, 10.0), 0.0).geomorph_px())
    first = viewbounds.first_distance_m(15, 20.0)
    assert 50 < first < 60
    assert jumps[1] > 0
    assert max(jumps) <= viewbounds.shift_px(1.0, first, viewbounds.focal_px(1920, 60), viewbounds.corner_stretch(1920, 1080, 60))


def test_light_of_facets_is_that_of_their_normals() -> None:
    z, cell = hills(33)
    scene = Scene(sun=Sun(azimuth_deg=250, elevation_deg=30))
    changed = ViewProof(scene, PyramidFacts(), (z, z[::2, ::2]), cell, 0.0).normal_map_codes()
    y, x = np.mgrid[0:33, 0:33] / 2
    drawn = reference.surface(z[::2, ::2], x, y, "diagonal")
    largest = 0.0
    sun = np.array([math.sin(math.radians(250)), math.cos(math.radians(250)), math.tan(math.radians(30))]) * math.cos(math.radians(30))
    for i in range(32):
        for j in range(32):
            for corners in (((0, 0), (0, 1), (1, 1)), ((0, 0), (1, 0), (1, 1))):
                lights = []
                for surface in (z, drawn):
                    a, b, c = (np.array([(j + x) * cell[0], -(i + y) * cell[1], surface[i + y, j + x]]) for y, x in corners)
                    normal = np.cross(b - a, c - a)
                    normal *= np.sign(normal[2]) / np.linalg.norm(normal)
                    lights.append(max(0.0, float(normal @ sun)) + 0.15 * (1 + normal[2]) / 2)
                largest = max(largest, bounds.code_scale(0.15) * abs(lights[0] - lights[1]))
    assert changed == pytest.approx(largest)


def test_cameras_see_all_around() -> None:
    directions = np.random.default_rng(0).normal(size=(2000, 3))
    directions[:, 2] = -np.abs(directions[:, 2])
    seen = np.any([np.isfinite(one.project(directions)).all(axis=-1) for one in cameras_around(Viewer())], axis=0)
    assert seen.mean() > 0.9
    ahead = Camera(Viewer(), 90.0, 0.0).project(np.array([[100.0, 0.0, 0.0], [100.0, -10.0, 5.0], [-1.0, 0.0, 0.0]]))
    focal = viewbounds.focal_px(1920, 60.0)
    np.testing.assert_allclose(ahead[:2], np.array([[0, 0], [focal / 10, focal / 20]]), atol=1e-9)
    assert np.isnan(ahead[2]).all()


def built(folder: Path) -> Dataset:
    """Heights with four levels, and imagery over them."""
    write_with_rasterio(folder / "dem.tif", (0.1 * hills()[0]).astype(np.float32)[..., np.newaxis])
    build_layer(folder / "dem.tif", folder / "out", BuildSettings(layer="height", block=32, codec="raw", workers=1, spacing=30.0))
    y, x = np.mgrid[0:130, 0:130]
    photo = np.stack([127 + 80 * np.sin(x / 3), 100 + 60 * np.cos(y / 5), (x + y) % 256], axis=-1).astype(np.uint8)
    write_with_rasterio(folder / "photo.tif", photo)
    build_layer(folder / "photo.tif", folder / "out", BuildSettings(layer="imagery", block=32, codec="raw", workers=1))
    return open_dataset(folder / "out")


def test_on_a_dataset(tmp_path: Path) -> None:
    dataset = built(tmp_path)
    scene = Scene(sun=Sun(azimuth_deg=250, elevation_deg=30), viewer=Viewer(grid=15, clearance_m=5000.0))
    measured = measure_dataset(dataset, "height", scene, imagery=True)
    plan, window = measured.plan(), Rect(5, 7, 129, 129)
    proved = prove_view(dataset, "height", measured, plan, window)
    assert {one.effect for one in proved} == {"haze", "geomorph", "synthesis", "curvature_view", "normal_map", "linear_filter"}
    assert all(one.holds for one in proved)
    assert all(one.actual > 0 for one in proved)
    small = [one.model_copy(update={"bound": (one.bound or 0) / 1000}) for one in plan.effects]
    assert not any(one.holds for one in prove_view(dataset, "height", measured, plan.model_copy(update={"effects": small}), window))


def test_what_is_forced_off_or_not_measured_is_not_proved(tmp_path: Path) -> None:
    dataset = built(tmp_path)
    scene = Scene(sun=Sun(azimuth_deg=250, elevation_deg=30), effects=Effects(haze="off"))
    measured = measure_dataset(dataset, "height", scene)
    assert {one.effect for one in prove_view(dataset, "height", measured, measured.plan(), Rect(0, 0, 20, 20))} <= {
        "geomorph",
        "synthesis",
        "curvature_view",
        "normal_map",
    }
