"""Four scenes from dataset to proof: alps under a low sun, an island, rough ground under a high sun, a plain. No bound breaks.

Built-in terrains stand in for the real ones, which are proved sample by sample where there is data, and with them every other
elevation model of that folder, estimates allowed.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rasterio.transform import Affine

from schemas.effects import EffectName, EffectProof
from schemas.region import Rect
from schemas.scene import Scene, Sun, Tolerance
from schemas.settings import BuildSettings
from tests.contract.picture_files import write_with_rasterio
from tiler.building.build import build_layer
from tiler.checking.blockreader import BlockReader
from tiler.effects.dataset import MeasuredMap, measure_dataset, place_of_window, read_heights
from tiler.effects.prove import LightBake, prove_plan, roughest_window
from tiler.effects.proveview import prove_view
from tiler.stores.dataset import open_dataset
from tiler.terrain import make_island

Float32 = NDArray[np.float32]
MOST = 1 << 12
"""Side of a window that is larger than any map here."""
BAKED: frozenset[EffectName] = frozenset({"shadow", "penumbra", "sky", "bounce", "curvature_shadow", "refraction_sun", "curvature_sky"})
FREE: frozenset[EffectName] = frozenset({"sun_direction", "refraction_sun", "refraction_path"})
"""Effects that cost nothing, and are left out only if they change next to nothing."""


@dataclass(frozen=True)
class Proved:
    measured: MeasuredMap
    proof: EffectProof
    heights: Float32

    def verdicts(self) -> dict[EffectName, str]:
        return {one.effect: one.verdict for one in self.proof.plan.effects if one.stage == "bake"}

    @property
    def running(self) -> set[EffectName]:
        return {effect for effect, verdict in self.verdicts().items() if verdict == "run"}


def proved(folder: Path, elevation: float, side: int = MOST, estimates: bool = False) -> Proved:
    """Measure, plan and prove the heights of a dataset under a sun in the west."""
    scene = Scene(sun=Sun(azimuth_deg=270, elevation_deg=elevation), tolerance=Tolerance(estimates=estimates))
    dataset = open_dataset(folder)
    measured = measure_dataset(dataset, "height", scene)
    plan, window = measured.plan(), roughest_window(measured.found, side)
    heights = read_heights(BlockReader(dataset, "height"), window)
    proof = prove_plan(plan, measured.scene, heights, place_of_window(measured.place, window), window)
    return Proved(measured, proof.with_view(prove_view(dataset, "height", measured, plan, window)), heights)


def built(folder: Path, heights_m: Float32, spacing_m: float) -> Path:
    place = Affine(spacing_m, 0, 400000, 0, -spacing_m, 5200000)
    write_with_rasterio(folder / "dem.tif", heights_m[..., np.newaxis], crs="EPSG:32632", transform=place)
    build_layer(folder / "dem.tif", folder / "out", BuildSettings(layer="height", block=64, codec="raw", workers=1))
    return folder / "out"


def rough(side: int) -> Float32:
    """Boulders of a metre on gentle ground, as lidar sees it."""
    rng = np.random.default_rng(4)
    z = 0.02 * make_island(side - 1, 1.0).heights_m
    for row, column in rng.integers(3, side - 3, (60, 2)):
        z[row - 1 : row + 2, column - 1 : column + 2] += rng.uniform(0.5, 1.5)
    return np.asarray(z, np.float32)


def plain(side: int) -> Float32:
    """Hills of 20 m."""
    i, j = np.mgrid[0:side, 0:side] / side
    return np.asarray(10 * np.sin(7 * i) * np.cos(5 * j), np.float32)


def island(side: int, spacing_m: float, steeper: float) -> Float32:
    return np.asarray(steeper * make_island(side - 1, spacing_m).heights_m, np.float32)


STAND_INS: dict[str, tuple[Float32, float, float, set[EffectName]]] = {
    "alps": (island(129, 90.0, 2.0), 90.0, 8.0, {"shadow", "penumbra", "sky", "bounce", "refraction_sun", "curvature_shadow"}),
    "island": (island(129, 20.0, 1.0), 20.0, 30.0, {"shadow", "penumbra", "sky", "bounce", "curvature_shadow"}),
    "rough": (rough(129), 1.0, 60.0, {"shadow", "penumbra", "sky", "bounce"}),
    "plain": (plain(97), 40.0, 40.0, set()),
}


def check(found: Proved) -> None:
    proof = found.proof
    assert [one for one in (*proof.effects, *proof.view) if not one.holds] == []
    assert proof.samples_over == 0
    assert proof.difference_codes <= proof.allowed_codes + 0.02
    assert proof.holds


@pytest.mark.parametrize("name", STAND_INS)
def test_stand_ins(name: str, tmp_path: Path) -> None:
    heights, spacing, elevation, runs = STAND_INS[name]
    found = proved(built(tmp_path, heights, spacing), elevation)
    assert (found.proof.width, found.proof.height) == heights.shape[::-1], "all samples"
    check(found)
    verdicts = found.verdicts()
    assert {effect for effect in BAKED if verdicts[effect] == "run"} - FREE == runs - FREE
    assert runs <= found.running
    if name == "plain":
        assert set(verdicts.values()) == {"skip proven"}
        only_lambert(found)


def only_lambert(found: Proved) -> None:
    """Light with every effect differs from how the ground faces the sun by less than the tolerance."""
    measured = found.measured
    window = Rect(0, 0, found.proof.width, found.proof.height)
    bake = LightBake(found.heights, place_of_window(measured.place, window), measured.scene, np.inf, 2)
    bare = bake.codes(frozenset(found.running))
    everything = bake.codes(frozenset(found.verdicts()))
    assert 0 < np.abs(everything - bare).max() <= measured.scene.tolerance.codes


PUGET: dict[str, Any] = {"layer": "height", "spacing": 160.0}
REAL: dict[str, tuple[str, dict[str, Any], float, set[EffectName]]] = {
    "Himalaya": ("dem/mt_everest_90m.tif", {}, 8.0, {"shadow", "penumbra", "sky", "bounce", "curvature_shadow"}),
    "Puget Sound": ("puget/ps_height_1k.png", {**PUGET, "height_scale": 0.1}, 30.0, {"shadow", "penumbra", "sky", "bounce"}),
    "lidar": ("dem/slovenia_lidar_nan.tif", {}, 60.0, {"shadow", "penumbra", "sky", "bounce"}),
    # Puget Sound, pressed until it has 20 m of relief.
    "plain": ("puget/ps_height_1k.png", {**PUGET, "height_scale": 0.1 * 20 / 4380}, 40.0, set()),
}


@pytest.mark.parametrize("name", REAL)
def test_real_scenes(name: str, data_dir: Path, tmp_path: Path) -> None:
    """Every sample of the map, some 15 seconds each."""
    file, settings, elevation, runs = REAL[name]
    build_layer(data_dir / file, tmp_path / "out", BuildSettings(**settings))
    found = proved(tmp_path / "out", elevation)
    check(found)
    assert {effect for effect in BAKED - FREE if found.verdicts()[effect] == "run"} == runs | ({"curvature_shadow"} & found.running)
    if name == "plain":
        assert found.running <= FREE
        only_lambert(found)


DEMS: dict[str, dict[str, Any]] = {
    "dem/mt_everest_90m.tif": {},
    "dem/slovenia_lidar_nan.tif": {},
    "dem/fuji_terrain_rgb.png": {"decode": "terrain-rgb", "spacing": 30.0},
    "dem/st_helens_terrain_rgb.png": {"decode": "terrain-rgb", "spacing": 30.0},
    "dem/grandcanyon_terrarium.png": {"decode": "terrarium", "spacing": 30.0},
    "grandcanyon/gcanyon_elev_crop.bw.png": {"layer": "height", "height_scale": 10.0, "spacing": 60.0},
    "puget/ps_height_1k.png": {**PUGET, "height_scale": 0.01},
}


@pytest.mark.parametrize("name", DEMS)
def test_estimates_hold_on_real_heights(name: str, data_dir: Path, tmp_path: Path) -> None:
    """What is left out by an estimate is not seen; high sun and low, where the ground is roughest."""
    build_layer(data_dir / name, tmp_path / "out", BuildSettings(**DEMS[name]))
    for elevation in (10.0, 60.0):
        check(proved(tmp_path / "out", elevation, side=200, estimates=True))
