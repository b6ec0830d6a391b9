"""The viewer's effects put to the proof: points of a window before a camera, with and without each, and light and codes both ways.

The viewer's own shaders are not run: what is proved is that nothing it could draw by the formulas of docs/EFFECTS.md moves or changes
more than their bounds, on the stored levels themselves.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.address import BlockAddress
from schemas.effects import EffectName, EffectPlan, ProvedEffect
from schemas.region import Rect
from schemas.scene import Scene
from schemas.viewbounds import KOSCHMIEDER, first_distance_m
from tiler.checking.blockreader import BlockReader
from tiler.effects.bounds import FULL_SCALE, code_scale
from tiler.effects.camera import Camera, Float64, cameras_around
from tiler.effects.candidates import PyramidFacts
from tiler.effects.dataset import MeasuredMap, read_heights
from tiler.filters.kernels import DESIGNS
from tiler.stores.dataset import Dataset

ROUNDING: Final = 1e-6
"""Relative error of the proof's own arithmetic."""
_MOST_LEVELS: Final = 4
_MOST_POINTS: Final = 96
"""Points along a side of what is put before a camera."""
_IMAGE_SIDE: Final = 512
"""Samples along a side of the imagery that is filtered both ways."""


@dataclass(frozen=True)
class ViewProof:
    """What effects of the viewer change on a window of a map.

    ``levels_m[l]`` (h, w) are its heights on level l [m], NaN where void, sample (0, 0) at the same place on all. ``cell_m`` is how far
    samples of level 0 lie apart along a row and a column [m], ``lowest_m`` the lowest height of the whole map, at which it keeps distances.
    ``codes`` (h, w, colours) are sRGB codes of imagery (0 to 1), ``taps`` the weights of its filter.
    """

    scene: Scene
    facts: PyramidFacts
    levels_m: tuple[Float64, ...]
    cell_m: tuple[float, float]
    lowest_m: float
    codes: Float64 | None = None
    taps: Float64 | None = None

    def measures(self) -> dict[EffectName, Callable[[], float]]:
        """Return the largest change of each effect that can be told here, as a function of nothing."""
        known: dict[EffectName, Callable[[], float]] = {"haze": self.haze_codes, "curvature_view": self.curvature_px}
        if len(self.levels_m) > 1:
            known |= {"geomorph": self.geomorph_px, "normal_map": self.normal_map_codes}
        if self.facts.detail_sigma_m is not None:
            known["synthesis"] = self.synthesis_px
        if self.codes is not None and self.taps is not None and min(self.codes.shape[:2]) > self.taps.size:
            known["linear_filter"] = self.filter_codes
        return known

    def haze_codes(self) -> float:
        """Return what white haze takes of a black point, the farthest one from any eye [codes]."""
        farthest = max((float(np.nanmax(np.linalg.norm(self._points - eye, axis=-1))) for eye in self._eyes), default=0.0)
        return FULL_SCALE * (1 - math.exp(-KOSCHMIEDER * farthest / self.scene.air.visibility_m))

    def curvature_px(self) -> float:
        """Return how far points move if they lie on a globe that touches the map below the eye, instead of on the map [pixels]."""
        radius, largest = self.scene.ground.radius_m, 0.0
        for eye in self._eyes:
            flat = self._points - eye
            away = np.hypot(flat[..., 0], flat[..., 1])
            above, turn = self._points[..., 2], away / radius
            with np.errstate(invalid="ignore", divide="ignore"):
                nearer = np.where(away > 0, (radius + above) * np.sin(turn) / away, 1.0)
            globe = np.stack([flat[..., 0] * nearer, flat[..., 1] * nearer, (radius + above) * np.cos(turn) - radius - eye[2]], axis=-1)
            largest = max(largest, self._seen(flat, globe))
        return largest

    def geomorph_px(self) -> float:
        """Return how far vertices jump that change to the next level no nearer than that is drawn [pixels]."""
        largest = 0.0
        for level, (fine, coarse) in enumerate(pairwise(self.levels_m)):
            first = first_distance_m(self.scene.viewer.grid, min(self.cell_m) * 2 ** (level + 1))
            thin = _thinned(fine.shape)
            before = _placed(fine, self.cell_m, 2**level, self.lowest_m)[thin]
            after = _placed(_drawn(coarse, fine.shape), self.cell_m, 2**level, self.lowest_m)[thin]
            for eye in self._eyes:
                away = np.abs(before - eye)[..., :2].max(axis=-1)
                far = (away >= first)[..., np.newaxis]
                largest = max(largest, self._seen(np.where(far, before - eye, np.nan), np.where(far, after - eye, np.nan)))
        return largest

    def synthesis_px(self) -> float:
        """Return how far detail of the largest deviates, with signs at random, moves ground at the least distance [pixels]."""
        viewer, sigma = self.scene.viewer, self.facts.detail_sigma_m or 0.0
        rng, detail = np.random.default_rng(1), np.zeros((24, 24))
        for octave in range(1, viewer.detail_octaves + 1):
            detail = _refined(_refined(detail).T).T[:96, :96]
            detail += viewer.largest_deviate * sigma * 2 ** (-self.facts.hurst * octave) * rng.choice([-1.0, 1.0], detail.shape)
        ahead = np.array([0.0, viewer.clearance_m, 0.0])
        moved = ahead + np.array([0.0, 0.0, float(np.abs(detail).max(initial=0.0))])
        return max(Camera(viewer, 0.0, pitch).largest_shift_px(ahead, moved) for pitch in (0.0, 5.0, 15.0, -15.0))

    def normal_map_codes(self) -> float:
        """Return what light changes if facets of level 0 have the normals of those of level 1 [codes]."""
        fine = self.levels_m[0]
        before, after = (_facet_light(self.scene, z, self.cell_m) for z in (fine, _drawn(self.levels_m[1], fine.shape)))
        different = np.abs(before - after)
        return float(np.nanmax(different)) if np.isfinite(different).any() else 0.0

    def filter_codes(self) -> float:
        """Return what filtering codes once instead of light changes [codes of light]."""
        if self.codes is None or self.taps is None:
            return 0.0
        right, wrong = _filtered(_light(self.codes), self.taps), _filtered(self.codes, self.taps)
        return FULL_SCALE * float(np.abs(np.clip(right, 0, 1) - _light(np.clip(wrong, 0, 1))).max())

    def _seen(self, before_m: Float64, after_m: Float64) -> float:
        return max(camera.largest_shift_px(before_m, after_m) for camera in cameras_around(self.scene.viewer))

    @cached_property
    def _points(self) -> Float64:
        return _placed(self.levels_m[0], self.cell_m, 1, self.lowest_m)[_thinned(self.levels_m[0].shape)]

    @cached_property
    def _eyes(self) -> list[Float64]:
        """Eyes at the least distance above corners, sides and middle of the window."""
        points = _placed(self.levels_m[0], self.cell_m, 1, self.lowest_m)
        rows, columns = (np.unique(np.linspace(0, size - 1, 3).round().astype(int)) for size in points.shape[:2])
        eyes = points[np.ix_(rows, columns)].reshape(-1, 3) + np.array([0.0, 0.0, self.scene.viewer.clearance_m])
        return [eye for eye in eyes if np.isfinite(eye).all()]


def prove_view(dataset: Dataset, layer: str, measured: MeasuredMap, plan: EffectPlan, window: Rect) -> list[ProvedEffect]:
    """Return what effects of the viewer change on a ``window`` of the heights of ``layer``, beside their bounds in ``plan``.

    Effects that the scene forces off, that have no bound, or that do not occur on so small a window are not among them. Raises InputError
    or NotFoundError for damaged blocks.
    """
    reader = BlockReader(dataset, layer)
    codes, taps = _imagery(dataset)
    proof = ViewProof(
        measured.scene, measured.facts, _levels(reader, window), measured.place.cell_m, measured.found.low_m, codes=codes, taps=taps
    )
    measures = proof.measures()
    return [
        ProvedEffect(effect=one.effect, verdict=one.verdict, unit=one.unit, bound=one.bound, actual=actual, holds=holds)
        for one in plan.effects
        if one.effect in measures and one.verdict != "forced off" and one.bound is not None
        for actual in (measures[one.effect](),)
        for holds in (actual <= one.bound * (1 + ROUNDING) + ROUNDING,)
    ]


def _levels(reader: BlockReader, window: Rect) -> tuple[Float64, ...]:
    """Return the heights of all levels that have three samples in a window, which is cut so that all begin and end at one place."""
    found = []
    for level in range(min(_MOST_LEVELS, len(reader.layer.levels))):
        step = 2**level
        x0, y0 = (-(-start // 2**_MOST_LEVELS) * 2**_MOST_LEVELS // step for start in (window.x0, window.y0))
        part = Rect(x0, y0, -(-window.x1 // step), -(-window.y1 // step))
        if min(part.width, part.height) < 3:
            break
        found.append(read_heights(reader, part, level).astype(np.float64))
    return tuple(found) or (read_heights(reader, window).astype(np.float64),)


def _imagery(dataset: Dataset) -> tuple[Float64 | None, Float64 | None]:
    """Return codes (h, w, colours) of the middle block of the first imagery, and the weights of its filter; None if there is none."""
    for name, layer in dataset.manifest.layers.items():
        if layer.kind == "imagery" and layer.dtype == "uint8" and not layer.alpha:
            core = BlockReader(dataset, name).read_core(BlockAddress(0, layer.levels[0].columns // 2, layer.levels[0].rows // 2))
            if core is not None and core.valid.all():
                taps = DESIGNS[layer.filter.kernel](layer.filter.radius, layer.registration).taps()[1]
                return core.samples[:_IMAGE_SIDE, :_IMAGE_SIDE].astype(np.float64) / 255, taps
    return None, None


def _thinned(shape: tuple[int, ...]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return which rows and columns stand for all: evenly spread, odd and even ones."""
    rows, columns = (np.unique(np.linspace(0, size - 1, min(size, _MOST_POINTS)).round().astype(np.intp)) for size in shape[:2])
    return np.ix_(rows, columns)  # type: ignore[return-value]


def _placed(z: Float64, cell_m: tuple[float, float], step: int, lowest_m: float) -> Float64:
    """Return heights (h, w) as points (h, w, 3): east, north, and up of the lowest ground [m]."""
    rows, columns = np.mgrid[0 : z.shape[0], 0 : z.shape[1]] * float(step)
    return np.stack([columns * cell_m[0], -rows * cell_m[1], z - lowest_m], axis=-1)


def _drawn(coarse: Float64, shape: tuple[int, ...]) -> Float64:
    """Return a level drawn as triangles at the samples (h, w) of the next finer one, NaN beyond its last sample."""
    y, x = np.arange(shape[0]), np.arange(shape[1])
    last = coarse.shape[0] - 1, coarse.shape[1] - 1
    ends = np.minimum((y + 1) >> 1, last[0]), np.minimum((x + 1) >> 1, last[1])
    drawn = 0.5 * (coarse[np.ix_(y >> 1, x >> 1)] + coarse[np.ix_(*ends)])
    drawn[(y + 1) >> 1 > last[0]], drawn[:, (x + 1) >> 1 > last[1]] = np.nan, np.nan
    return np.asarray(drawn, np.float64)


def _refined(z: Float64) -> Float64:
    """Return rows refined once by the 4-point scheme, (h, 2 w - 7): what has all its neighbours."""
    middle = (9 * (z[:, 1:-2] + z[:, 2:-1]) - z[:, :-3] - z[:, 3:]) / 16
    refined = np.empty((z.shape[0], 2 * middle.shape[1] - 1))
    refined[:, ::2], refined[:, 1::2] = middle, z[:, 2:-2]
    return refined


def _facet_light(scene: Scene, z: Float64, cell_m: tuple[float, float]) -> Float64:
    """Return the light [codes] of the triangles of ``z`` (2, h - 1, w - 1), cut from corner (0, 0) to corner (1, 1), all of it open."""
    azimuth, elevation = (math.radians(angle) for angle in scene.sun.direction_deg)
    across, down = np.diff(z, axis=1) / cell_m[0], np.diff(z, axis=0) / cell_m[1]
    right, below = np.stack([across[:-1], across[1:]]), np.stack([down[:, 1:], down[:, :-1]])
    upright = 1 / np.sqrt(1 + right**2 + below**2)
    toward = right * math.sin(azimuth) - below * math.cos(azimuth)
    facing = np.maximum(upright * (math.sin(elevation) - math.cos(elevation) * toward), 0.0)
    return np.asarray(code_scale(scene.sky.share) * (facing + scene.sky.share * (1 + upright) / 2), np.float64)


def _light(codes: Float64) -> Float64:
    """Return the light, 0 to 1, of sRGB codes of 1 (IEC 61966-2-1)."""
    return np.asarray(np.where(codes <= 0.04045, codes / 12.92, ((np.maximum(codes, 0.0) + 0.055) / 1.055) ** 2.4), np.float64)


def _filtered(samples: Float64, taps: Float64) -> Float64:
    """Return every second sample along both axes of ``samples`` (h, w, c) after a filter, where it has all its taps."""
    for _ in range(2):
        count = (samples.shape[0] - taps.size) // 2 + 1
        total = np.zeros((count, *samples.shape[1:]))
        for place, weight in enumerate(taps):
            total += weight * samples[place : place + 2 * count - 1 : 2]
        samples = np.swapaxes(total, 0, 1)
    return samples
