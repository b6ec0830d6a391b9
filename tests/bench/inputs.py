"""The sources of all measurements: pictures and heights of a known spectrum, as TIFF in the layouts that are met in practice."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Literal

import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray

Kind = Literal["rgb", "height"]

PERIOD: Final = 4096
"""A source repeats after so many samples, without a seam: longer waves would cost memory and add nothing to the work."""
BAND_ROWS: Final = 512
"""Written at once: a multiple of every tile and strip below, so that none is compressed twice."""
PLAIN: Final = "tiles of 512"


def _tiles(side: int, **more: object) -> dict[str, Any]:
    return {"tiled": True, "blockxsize": side, "blockysize": side, **more}


LAYOUTS: Final[Mapping[str, Mapping[str, Any]]] = MappingProxyType(
    {
        PLAIN: _tiles(512),
        "tiles of 256": _tiles(256),
        "strips of 16 rows": {"tiled": False, "blockysize": 16},
        "strips of 1 row": {"tiled": False, "blockysize": 1},
        "DEFLATE, tiles of 512": _tiles(512, compress="deflate", predictor=2, zlevel=6),
        "LZW, tiles of 256": _tiles(256, compress="lzw", predictor=2),
        "ZSTD, tiles of 512": _tiles(512, compress="zstd", predictor=2),
    }
)
"""What each layout means to GDAL's TIFF driver. One row per strip is what GDAL itself makes of rows longer than 8 kB."""


@dataclass(frozen=True, slots=True)
class Source:
    """A file of ``side`` by ``side`` samples: RGB of 8 bit or float32 heights, in one of ``LAYOUTS``."""

    kind: Kind
    side: int
    layout: str = PLAIN

    @property
    def sample_bytes(self) -> int:
        """Bytes of a sample, all channels, before compression."""
        return 3 if self.kind == "rgb" else 4

    @property
    def file_name(self) -> str:
        """A name that no other source has."""
        return f"{self.kind}-{self.side}-{self.layout.replace(', ', '-').replace(' ', '-')}.tif"


def natural_picture(side: int, seed: int = 1) -> NDArray[np.uint8]:
    """Return (side, side, 3) with amplitudes that fall as 1/f (Field 1987) and channels that share most of their detail."""
    random = np.random.default_rng(seed)
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None, :]).astype(np.float32)
    frequency[0, 0] = np.inf

    def field() -> NDArray[np.float32]:
        noise = np.fft.rfft2(random.standard_normal((side, side), np.float32)) / frequency
        values: NDArray[np.float32] = np.fft.irfft2(noise, s=(side, side)).astype(np.float32)
        values /= values.std()
        return values

    grey = field()
    picture = np.empty((side, side, 3), np.uint8)
    for channel, mean in enumerate((105, 110, 95)):
        picture[..., channel] = np.clip(np.rint(mean + 38 * grey + 9 * field()), 0, 255)
    return picture


def terrain(side: int, seed: int = 2) -> NDArray[np.float32]:
    """Return heights (side, side, 1) in metres, float32, without a seam; amplitudes fall as 1/f^2, deviation 400 m."""
    random = np.random.default_rng(seed)
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None, :])
    frequency[0, 0] = np.inf
    heights = np.fft.irfft2(np.fft.rfft2(random.standard_normal((side, side))) / frequency**2, s=(side, side))
    return np.asarray(1000 + heights * (400 / heights.std()), np.float32)[..., np.newaxis]


def samples_of(source: Source) -> NDArray[Any]:
    """Return one period of the source's samples, (n, n, channels)."""
    side = min(PERIOD, source.side)
    return natural_picture(side) if source.kind == "rgb" else terrain(side)


def write_source(path: Path, source: Source) -> None:
    """Write a source as a georeferenced TIFF, of pixels with interleaved channels."""
    period = samples_of(source)
    side = source.side
    profile: dict[str, Any] = {"driver": "GTiff", "width": side, "height": side, "count": period.shape[2], "dtype": period.dtype.name}
    profile |= {"interleave": "pixel", "bigtiff": "if_safer", "num_threads": "all_cpus", **LAYOUTS[source.layout]}
    if source.kind == "rgb":
        profile["photometric"] = "rgb"
    with rasterio.open(path, "w", crs="EPSG:32633", transform=Affine(1, 0, 500000, 0, -1, 5000000), **profile) as file:
        for row in range(0, side, BAND_ROWS):
            height = min(BAND_ROWS, side - row)
            band = np.moveaxis(np.take(period, range(row, row + height), axis=0, mode="wrap"), -1, 0)
            repeated = np.tile(band, (1, 1, -(-side // period.shape[1])))[..., :side]
            file.write(repeated, window=rasterio.windows.Window(0, row, side, height))
