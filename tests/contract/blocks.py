"""The cases of the codec contract: every codec with every format of blocks it accepts, and blocks to try it on."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.manifest import SampleType
from tests.reference.terrain import photo, terrain
from tiler.codecs import BlockFormat, Codec, Mask, Samples, open_codec

LOSSLESS = ("lerc:0", "raw", "exr:float", "png")
BOUNDED = ("lerc:0.01", "lerc:1", "png16:0.1,-500", "png16:0.25,-1000", "rgb565")
UNBOUNDED = ("exr:half", "jpeg:85", "jpeg:95", "webp:85")


def heights(side: int, offset: float = 1000.0) -> NDArray[np.float32]:
    """Mountains (side, side, 1) of about 200 m around ``offset`` [m]."""
    return terrain(max(side, 8), max(side, 8), rms_m=200, mean_m=offset)[:side, :side].astype(np.float32)


def imagery(side: int, channels: int, dtype: SampleType) -> NDArray[Any]:
    """A photograph (side, side, channels); an even number of channels ends in an alpha that covers the whole range."""
    colours = photo(max(side, 8), max(side, 8))[:side, :side, : channels - (channels % 2 == 0)]
    if channels in (2, 4):
        alpha = np.random.default_rng(channels).choice(np.array([0, 1, 127, 254, 255], np.uint8), (side, side, 1))
        colours = np.concatenate([colours, alpha], axis=-1)
    return colours if dtype == "uint8" else colours.astype(np.uint16) * 257 - (colours > 100)


def ulp(samples: Samples) -> NDArray[np.float64]:
    """The distance from each sample to the next float32."""
    return np.spacing(np.abs(samples)).astype(np.float64)


@dataclass(frozen=True)
class Case:
    """A codec and a format of blocks."""

    spec: str
    block: BlockFormat

    def __str__(self) -> str:
        return f"{self.spec}-{self.block.dtype}x{self.block.channels}-{self.block.side}"

    @property
    def rounds_twice(self) -> bool:
        """Whether the decoded sample is rounded to float32 beyond the bound."""
        return self.spec.startswith("png16")

    def open(self) -> Codec:
        return open_codec(self.spec, self.block)

    def blocks(self) -> list[tuple[Samples, Mask | None]]:
        """Blocks to encode: two ordinary ones first, then constant, noisy, steep and extreme ones; heights also with voids."""
        if self.block.dtype != "float32":
            return _imagery_blocks(self.block)
        found = _height_blocks(self.block.side, self.spec)
        return (
            [(np.concatenate([samples, -samples[::-1]], axis=-1), mask) for samples, mask in found] if self.block.channels == 2 else found
        )


def _height_blocks(side: int, spec: str) -> list[tuple[Samples, Mask | None]]:
    rng = np.random.default_rng(side)
    shape = (side, side, 1)
    cliff = np.where(np.arange(side)[np.newaxis, :, np.newaxis] * 2 < side, np.float32(0), np.float32(5000)) + np.zeros(shape, np.float32)
    plain: list[Samples] = [
        heights(side, 2000),
        np.full(shape, 8.1, np.float32),
        np.zeros(shape, np.float32),
        rng.uniform(-400, 6000, shape).astype(np.float32),
        cliff,
    ]
    if not spec.startswith("png16"):
        signed_zero = np.zeros(shape, np.float32)
        signed_zero[::2] = -0.0
        plain += [signed_zero, heights(side, 8848), heights(side, -10898)]
    if not spec.startswith(("png16", "exr:half")):
        extreme = np.zeros(shape, np.float32)
        limits = np.finfo(np.float32)
        extreme.flat[:4] = limits.max, limits.min, limits.tiny, limits.smallest_subnormal
        plain += [heights(side, 1e5), extreme]
    ragged = rng.random((side, side)) < 0.6
    ragged.flat[:2] = True, False
    lonely = np.zeros((side, side), np.bool_)
    lonely[-1, 0] = True
    corner = np.zeros((side, side), np.bool_)
    corner[: side // 2 + 1, :1] = True
    voids: list[tuple[Samples, Mask | None]] = [(plain[number % len(plain)], mask) for number, mask in enumerate((ragged, lonely, corner))]
    # Voids hold whatever lay there, such as the padding of a block, which repeats its edge.
    voids += [(np.where(mask[..., np.newaxis], plain[3], np.float32(77)), mask) for mask in (ragged, lonely, ~lonely)]
    return [(plain[0], ragged), *((samples, None) for samples in plain), *voids, (plain[0], np.ones((side, side), np.bool_))]


def _imagery_blocks(block: BlockFormat) -> list[tuple[Samples, Mask | None]]:
    shape = (block.side, block.side, block.channels)
    top = np.iinfo(block.dtype).max
    noise = np.random.default_rng(block.side).integers(0, top + 1, shape).astype(block.dtype)
    samples = [imagery(block.side, block.channels, block.dtype), noise, np.zeros(shape, block.dtype), np.full(shape, top, block.dtype)]
    if block.alpha:
        opaque = samples[0].copy()
        opaque[..., -1] = top
        samples.append(opaque)
    return [(array, None) for array in samples]


def _formats(spec: str, side: int) -> list[BlockFormat]:
    def pictures(channels: tuple[int, ...], *dtypes: SampleType) -> list[BlockFormat]:
        return [BlockFormat("imagery", side, count, dtype, count in (2, 4)) for count in channels for dtype in dtypes]

    name = spec.partition(":")[0]
    height = [BlockFormat("height", side, 1, "float32")]
    normals = [BlockFormat("normal", side, 2, "float32")]
    return {
        "jpeg": pictures((1, 3), "uint8"),
        "png": pictures((1, 2, 3, 4), "uint8", "uint16"),
        "webp": pictures((3, 4), "uint8") + [BlockFormat("light", side, count, "uint8", count == 2) for count in (1, 2)],
        "rgb565": pictures((3,), "uint8"),
        "raw": pictures((1, 2, 3, 4), "uint8", "uint16") + height,
        "exr": height + normals,
    }.get(name, height)


CASES = [
    Case(spec, block)
    for spec in LOSSLESS + BOUNDED + UNBOUNDED
    for side in (2, 16, 32, 256)
    for block in _formats(spec, side)
    if side == 32 or (block.channels, block.dtype) in ((1, "float32"), (4, "uint8"), (3, "uint8"))
]
