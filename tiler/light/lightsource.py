"""Light as the samples of a layer: what is seen of sun and sky is found once, over the whole grid; the rest where a window is read."""

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Final

import numpy as np
from numpy.typing import NDArray
from xxhash import xxh3_128

from schemas.light import Light
from schemas.manifest import Layer, SampleType, digest
from schemas.region import Rect
from tiler.checking.blockreader import BlockReader
from tiler.light.directions import SunDirections, sun_directions
from tiler.light.frame import Earth, SunPosition, sine_cosine_deg
from tiler.light.ground import SunField
from tiler.light.heights import HeightGrid, refined_layer
from tiler.light.place import GridPlace
from tiler.light.shading import shade_patch, shade_window
from tiler.light.sweeping import Float32
from tiler.light.visibility import TOP, Shares, SunSetting, make_shares, sky_shares, sun_shares, sun_slopes, whole_zone
from tiler.light.zones import SunZones, sky_zones
from tiler.rowfile import RowFile
from tiler.sources import FileInfo, Pixels
from tiler.sources.convert import Conversion

_STRIP_ROWS: Final = 256
_MEAN_STEPS: Final = 1024
"""The mean light of the map is rounded to 1/1024: 0.05 codes of what is reflected, and a change of few heights changes nothing far away."""


@dataclass(frozen=True, slots=True)
class Simulation:
    """What is simulated: the manifest's description of it, and how the grid lies."""

    light: Light
    place: GridPlace

    @property
    def sun(self) -> SunPosition:
        """Where the sun stands, as seen from the grid."""
        return SunPosition(self.light.grid_azimuth_deg, self.light.elevation_deg)

    @property
    def field(self) -> SunField | None:
        """Where the sun stands all over the map; None for a flat Earth, or if nothing says where on it the map is."""
        place, light = self.place, self.light
        if place.ground is None or place.longitude_deg is None or place.latitude_deg is None or light.radius_m is None:
            return None
        centre = place.longitude_deg, place.latitude_deg
        return SunField(place.ground, centre, light.azimuth_deg, light.elevation_deg, refraction=light.refraction > 0)

    @property
    def directions(self) -> SunDirections | None:
        """The sun's directions over a map that is too large for one."""
        field, earth = self.field, self.earth
        return None if field is None or earth is None else sun_directions(field, self.place, self.sun, earth)

    @property
    def earth(self) -> Earth | None:
        """The round Earth, None for a flat one."""
        return None if self.light.radius_m is None else Earth(self.light.radius_m, self.light.refraction)


class LightSource:
    """The light on a stored height layer, on every sample of its level 0 and, at twice the density, between them; float32 from 0 to 1.

    ``bake`` must be called before samples are read. ``stages_s`` are the seconds that its parts took.
    """

    def __init__(self, reader: BlockReader, simulation: Simulation, dtype: SampleType, scratch: Path, workers: int) -> None:
        layer = reader.layer
        self.info = height_info(reader.name, refined_layer(layer, simulation.light.density))
        self.conversion = Conversion("light", (0,), None, False, None, None, 1.0, 0.0, dtype)
        self.masked = layer.statistics.valid < layer.width * layer.height
        self.stages_s: dict[str, float] = {}
        self._reader, self.simulation, self._scratch, self._workers = reader, simulation, scratch, workers
        self._local = threading.local()
        self._grid: HeightGrid | None = None
        self._sun: RowFile | None = None
        self._sky: RowFile | None = None
        self._bounced = 0.0
        self._directions: SunDirections | None = None
        self._on_stage: Callable[[str], None] = lambda name: None

    def bake(self, on_stage: Callable[[str], None] = lambda name: None) -> None:
        """Decode the heights, and find what every sample sees of the sun and of the sky; ``on_stage`` is told what begins.

        Raises InputError or StorageError.
        """
        light = self.simulation.light
        self._on_stage = on_stage
        with self._stage("heights"):
            self._grid = HeightGrid(self._reader, self._scratch, self._workers, light.density)
        with self._stage("sun"):
            self._directions = self.simulation.directions
            self._sun = make_shares(self._grid, self._scratch)
            self._find_sun(self._grid, self._sun)
        if light.sky_azimuths:
            with self._stage("sky"):
                self._sky = self._find_sky(self._grid)
        if light.albedo:
            with self._stage("bounce"):
                self._bounced = light.albedo * self._mean_light()

    @contextmanager
    def _stage(self, name: str) -> Iterator[None]:
        self._on_stage(name)
        started = perf_counter()
        yield
        self.stages_s[name] = perf_counter() - started

    def _find_sun(self, grid: HeightGrid, shares: RowFile) -> None:
        simulation, light = self.simulation, self.simulation.light
        if light.shadows == "none":
            for window in _strips(grid.shape):
                shares.write(0, window.y0, np.full((window.height, window.width, 1), TOP, np.uint16))
            return
        radius = (light.radius_deg or 0.0) if light.shadows == "soft" else None
        setting = SunSetting(light.lines, radius, simulation.earth)
        field, zones = simulation.field, None
        if field is not None and simulation.earth is not None:
            zones = SunZones(field, grid.range_m, simulation.earth, radius or 0.0).plan()
        sun_shares(grid, zones or [whole_zone(grid, simulation.place, simulation.sun)], setting, self._workers, shares)

    def _find_sky(self, grid: HeightGrid) -> RowFile:
        simulation = self.simulation
        field, earth = simulation.field, simulation.earth
        zones = None if field is None or earth is None else sky_zones(field, grid.range_m, earth)
        return sky_shares(grid, simulation.place, simulation.light.sky_azimuths, earth, self._workers, self._scratch, zones)

    def _mean_light(self) -> float:
        """Return the mean light of all valid samples before any is reflected, relative to the sun's."""
        total, count = [], 0
        grid = self._baked()
        for window in _strips(grid.shape):
            lit, valid = self._shaded(window)
            total.append(float(np.sum(lit, dtype=np.float64)))
            count += int(valid.sum())
        mean = math.fsum(total) / max(count, 1) * (1 + self.simulation.light.sky_share)
        return round(mean * _MEAN_STEPS) / _MEAN_STEPS

    def _baked(self) -> HeightGrid:
        if self._grid is None:
            raise ValueError("light is read before it is baked")
        return self._grid

    def _shaded(self, window: Rect) -> tuple[Float32, NDArray[np.bool_]]:
        """Return the light (h, w) of a window, and where there is any ground."""
        grid = self._baked()
        around = grid.read_around(window)
        shape = window.height, window.width
        lit = np.empty(shape, np.float32)
        sky = np.empty((window.height, 0), np.uint16) if self._sky is None else self._sky.read(window)[..., 0]
        assert self._sun is not None
        seen = np.ascontiguousarray(self._sun.read(window)[..., 0])
        self._shade(around, window, seen, np.ascontiguousarray(sky), lit)
        return lit, ~np.isnan(around[1:-1, 1:-1])

    def _shade(self, around: Float32, window: Rect, sun: Shares, sky: Shares, lit: Float32) -> None:
        simulation = self.simulation
        light, place = simulation.light, simulation.place
        if self._directions is None:
            east, north = sine_cosine_deg(light.grid_azimuth_deg)
            slopes = sun_slopes(self._baked().shape, place.cell_m, simulation.sun, simulation.earth, window)
            cells = np.ascontiguousarray(place.cells_m[:, window.y0 : window.y1])
            shade_window(around, cells, east, north, slopes, sun, sky, light.sky_share, self._bounced, lit)
            return
        for patch in self._directions.patches(window):
            part = patch.window.shifted(-window.x0, -window.y0)
            rows, columns = slice(part.y0, part.y1), slice(part.x0, part.x1)
            hidden = sky[rows, columns] if sky.shape[1] else sky[rows]
            out = np.empty((part.height, part.width), np.float32)
            near = np.ascontiguousarray(around[part.y0 : part.y1 + 2, part.x0 : part.x1 + 2])
            seen, hidden = np.ascontiguousarray(sun[rows, columns]), np.ascontiguousarray(hidden)
            shade_patch(near, patch.corners, patch.place, seen, hidden, light.sky_share, self._bounced, out)
            lit[rows, columns] = out

    def read(self, window: Rect) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """Return light (rows, columns, 1) and coverage (rows, columns), None unless ``masked``."""
        lit, valid = self._shaded(window)
        if hasher := getattr(self._local, "hasher", None):
            hasher.update(lit)
            hasher.update(np.packbits(valid))
        return lit[..., np.newaxis], valid.astype(np.float32) if self.masked else None

    def read_lean(self, window: Rect) -> tuple[Pixels, NDArray[np.float32] | None]:
        """Return the same, without a coverage that is all 1."""
        lit, coverage = self.read(window)
        return lit, None if coverage is None or (coverage == 1).all() else coverage

    def begin(self) -> None:
        """Start anew what ``digest`` covers, for this thread."""
        self._local.hasher = xxh3_128()

    def digest(self) -> str:
        """Return the digest of the light that this thread has read since ``begin``."""
        return digest(self._local.hasher.digest())

    def close(self) -> None:
        """Free the scratch files."""
        for part in (self._grid, self._sun, self._sky):
            if part is not None:
                part.close()


def _strips(shape: tuple[int, int]) -> Iterator[Rect]:
    for y in range(0, shape[0], _STRIP_ROWS):
        yield Rect(0, y, shape[1], min(shape[0], y + _STRIP_ROWS))


def height_info(name: str, layer: Layer) -> FileInfo:
    """Return what a layer of heights is as a source: one of floats, of any window."""
    return FileInfo(
        path=Path(name),
        format="clipmap",
        width=layer.width,
        height=layer.height,
        channels=1,
        dtype=np.dtype(np.float32),
        file_bytes=layer.levels[0].stored_bytes,
        layout="tiled",
        chunk_rows=1,
    )
