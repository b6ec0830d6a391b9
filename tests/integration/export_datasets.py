"""Datasets of every kind of layer to export, built once per session and only when a test asks for them."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np

from tests.integration.files import Picture, assemble, settings, write_tiff
from tests.reference.terrain import photo, terrain
from tiler.building.build import build_layer
from tiler.export import ExportReport, ExportSettings, export
from tiler.stores.dataset import Dataset, open_dataset


@dataclass(frozen=True)
class Kind:
    """How to make a dataset: its source's pixels and the settings of the build."""

    pixels: Callable[[], Picture]
    options: dict[str, Any]
    placed: bool = True


def rgba(dtype: str = "uint8") -> Picture:
    """A photo of 150 x 215 whose left part is transparent and whose middle is half so: blank, opaque and mixed blocks of 32."""
    top = np.iinfo(dtype).max
    pixels = np.concatenate([photo(150, 215, seed=5), np.full((150, 215, 1), 255, np.uint8)], axis=-1).astype(dtype) * (top // 255)
    pixels[:, :70, 3] = 0
    pixels[40:90, 100:170, 3] = top // 3
    return pixels


def heights() -> Picture:
    """A terrain of 173 x 261 with a large hole and two single voids."""
    pixels = terrain(173, 261, seed=3).astype(np.float32)
    pixels[20:120, 30:140] = np.nan
    pixels[150, 200] = pixels[172, 260] = np.nan
    return pixels


def colours(rows: int = 150, columns: int = 215) -> Picture:
    return photo(rows, columns, seed=5)


KINDS = {
    "jpeg": Kind(colours, {"codec": "jpeg:80"}),
    "jpeg444": Kind(lambda: colours(128, 192), {"codec": "jpeg:92"}),
    "jpeg_grey": Kind(lambda: colours()[..., :1], {"codec": "jpeg:85", "layer": "imagery"}, placed=False),
    "jpeg_pad": Kind(colours, {"codec": "jpeg:80", "pad": 3}),
    "webp": Kind(colours, {"codec": "webp:80"}),
    "webp_rgba": Kind(rgba, {"codec": "webp:80"}, placed=False),
    "png_rgba": Kind(rgba, {"codec": "png"}, placed=False),
    "png_rgba_pad": Kind(rgba, {"codec": "png", "pad": 2}, placed=False),
    "png_rgba16": Kind(lambda: rgba("uint16"), {"codec": "png"}, placed=False),
    "light": Kind(colours, {"codec": "png", "linear_light": True}),
    "raw_small": Kind(lambda: colours(40, 70), {"codec": "raw", "block": 4}),
    "rgb565": Kind(colours, {"codec": "rgb565"}),
    "lerc": Kind(heights, {"codec": "lerc:0.01"}),
    "raw_heights_pad": Kind(heights, {"codec": "raw", "pad": 4, "block": 64}),
    "full_heights": Kind(lambda: terrain(65, 129, seed=1).astype(np.float32), {"codec": "exr:float"}, placed=False),
    "one_block": Kind(lambda: colours(300, 700), {"codec": "png", "block": 1024}),
    "column": Kind(lambda: colours(150, 1), {"codec": "png"}),
}
IMAGERY = [name for name, kind in KINDS.items() if kind.options["codec"].split(":")[0] not in ("lerc", "exr") and "heights" not in name]
HEIGHTS = [name for name in KINDS if name not in IMAGERY]


def build(kind: str, folder: Path) -> Path:
    """Build the dataset ``kind`` in a new folder below ``folder`` and return its path."""
    folder /= kind
    if (folder / "out" / "manifest.json").exists():
        return folder / "out"
    folder.mkdir(exist_ok=True)
    pixels, spec = KINDS[kind].pixels(), KINDS[kind]
    if spec.placed:
        source = write_tiff(folder / "source.tif", pixels)
    elif pixels.dtype == np.float32:
        source = write_tiff(folder / "source.tif", pixels, crs=None)
    else:
        source = folder / "source.png"
        source.write_bytes(imagecodecs.png_encode(np.ascontiguousarray(pixels.squeeze(axis=-1) if pixels.shape[-1] == 1 else pixels)))
    build_layer([source], folder / "out", settings(workers=2, **spec.options))
    return folder / "out"


def the_layer(dataset: Dataset) -> str:
    (name,) = dataset.manifest.layers
    return name


def exported(dataset: Path, form: str, target: Path, **options: Any) -> ExportReport:
    return export(open_dataset(dataset), form, target, ExportSettings(**options))


def level_samples(dataset: Dataset, level: int) -> tuple[Picture, Picture]:
    """Decode all blocks of a level, cut to its size; (rows, columns, channels) and validity."""
    layer = dataset.manifest.layer(the_layer(dataset))
    samples, valid = assemble(dataset, the_layer(dataset), level)
    size = np.s_[: layer.levels[level].height, : layer.levels[level].width]
    return samples[size], valid[size]
