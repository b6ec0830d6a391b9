"""From a file's pixels to samples: channel choice, voids, alpha, heights hidden in colour, units, bits.

Samples are float32 with a coverage between 0 (void) and 1. Void samples are set to 0, so that what lay under them cannot
reach any result.
"""

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray
from xxhash import xxh3_128

from schemas.errors import InputError, UsageError
from schemas.manifest import LayerKind, SampleType, digest
from schemas.region import Rect
from schemas.settings import BuildSettings, HeightEncoding
from tiler.sources import FileInfo, Pixels, Reader
from tiler.sources.whole import take_whole

_HASHED_BYTES: Final = 256 << 10
"""Digested at once: half of what a second-level cache holds at least."""
_EXACT_INTEGERS: Final = 2**24
"""Whole numbers up to here survive the conversion to float32."""
_HIGHEST: Final = 1e30
"""No height in any unit, but what programs write that have no value: 3.4e38, 1.7e38, -1e32."""


@dataclass(frozen=True, slots=True)
class Conversion:
    """How pixels of one file become samples of one layer; ``colours`` are the channels taken, from 0, ``alpha`` one more or None.

    ``dtype`` is the type that samples are stored in. ``stretch`` is the range (min, max) of every colour channel that became 0 to 255.
    """

    kind: LayerKind
    colours: tuple[int, ...]
    alpha: int | None
    premultiplied: bool
    nodata: float | None
    decode: HeightEncoding | None
    scale: float
    offset: float
    dtype: SampleType
    stretch: tuple[tuple[float, float], ...] | None = None

    @property
    def channels(self) -> int:
        """Channels of a sample, alpha not counted."""
        return 1 if self.decode else len(self.colours)


class SampleSource(Protocol):
    """Windows of the samples of one layer, from any thread; wrappers change samples on their way."""

    @property
    def info(self) -> FileInfo:
        """What the file declares."""
        ...

    @property
    def conversion(self) -> Conversion:
        """How the file becomes a layer."""
        ...

    @property
    def masked(self) -> bool:
        """Whether samples may be void or transparent."""
        ...

    def read(self, window: Rect) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """Return samples (rows, columns, channels) and coverage (rows, columns), None unless ``masked``."""
        ...

    def read_lean(self, window: Rect) -> tuple[Pixels, NDArray[np.float32] | None]:
        """Return the same with less work: samples in the type they are stored in if the file has them so, no coverage if it is all 1.

        Which type, is the same for all windows.
        """
        ...

    def begin(self) -> None:
        """Start anew what ``digest`` covers, for this thread; nothing that was read before is held any more."""
        ...

    def digest(self) -> str:
        """Return the digest of all pixels and masks that this thread has read from the file since ``begin``."""
        ...

    def close(self) -> None:
        """Close the file."""
        ...


class BakedSource(SampleSource, Protocol):
    """Samples that are computed: ``bake`` once before they are read. ``stages_s`` are the seconds that its parts took."""

    stages_s: dict[str, float]

    def bake(self, on_stage: Callable[[str], None] = ...) -> None:
        """Compute what all samples need; ``on_stage`` is told what begins."""
        ...


class DerivedSource(ABC):
    """Base of the sources that change the samples of another one: passes on what they leave as it is."""

    def __init__(self, source: SampleSource) -> None:
        self._source = source
        self.info: FileInfo = source.info
        self.conversion: Conversion = source.conversion
        self.masked: bool = source.masked

    @abstractmethod
    def read(self, window: Rect) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """Return samples (rows, columns, channels) and coverage (rows, columns), None unless ``masked``."""

    def read_lean(self, window: Rect) -> tuple[Pixels, NDArray[np.float32] | None]:
        """Return the same, without a coverage that is all 1."""
        return _lean(*self.read(window))

    def begin(self) -> None:
        """Start anew what ``digest`` covers, for this thread."""
        self._source.begin()

    def digest(self) -> str:
        """Return the digest of what this thread has read since ``begin``."""
        return self._source.digest()

    def close(self) -> None:
        """Close the source."""
        self._source.close()


class Source:
    """A file seen as samples of one layer: windows as float32 (rows, columns, channels) and coverage, from any thread."""

    def __init__(self, reader: Reader, conversion: Conversion) -> None:
        self.info: FileInfo = reader.info
        self.conversion = conversion
        self._reader = reader
        self._local = threading.local()

    @property
    def masked(self) -> bool:
        """Whether samples may be void or transparent; decided by the header, so that all windows agree."""
        info, conversion = self.info, self.conversion
        return conversion.alpha is not None or conversion.nodata is not None or info.has_mask or info.dtype.kind == "f"

    def read(self, window: Rect) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """Return samples and coverage (rows, columns), None unless ``masked``; raises InputError if the file cannot be read."""
        return self._converted(*self._pixels(window))

    def read_lean(self, window: Rect) -> tuple[Pixels, NDArray[np.float32] | None]:
        """Return the same with less work: imagery of 8 or 16 bits as the file has it, no coverage if it is all 1."""
        pixels, mask = self._pixels(window)
        if self._is_stored_as_read:
            return _chosen(pixels, self.conversion.colours), None
        if self._is_float_height and mask is None:
            heights = take_whole(pixels[..., self.conversion.colours[0]], self.conversion.nodata, _HIGHEST)
            if heights is not None:
                return heights[..., np.newaxis], None
        return _lean(*self._converted(pixels, mask))

    @property
    def _is_stored_as_read(self) -> bool:
        """Whether a sample is stored as the number it is in the file."""
        conversion = self.conversion
        exact = conversion.decode is None and (conversion.scale, conversion.offset) == (1.0, 0.0)
        return conversion.kind == "imagery" and exact and not self.masked and self.info.dtype == conversion.dtype

    @property
    def _is_float_height(self) -> bool:
        conversion = self.conversion
        exact = conversion.decode is None and (conversion.scale, conversion.offset) == (1.0, 0.0)
        return conversion.kind == "height" and exact and conversion.alpha is None and self.info.dtype == np.float32

    def _pixels(self, window: Rect) -> tuple[Pixels, NDArray[np.uint8] | None]:
        pixels, mask = self._reader.read(window)
        for part, hasher in zip((pixels, mask), getattr(self._local, "hashers", ()), strict=False):
            if part is not None:
                # As the file has them: a quarter of the bytes that the same samples take as float32. Some rows at a time: their copy
                # stays in the cache; by single rows, which would need no copy, threads get into each other's way, as each row frees
                # Python's lock and takes it again.
                rows = max(1, _HASHED_BYTES // max(1, part[0].nbytes))
                for y in range(0, len(part), rows):
                    hasher.update(np.ascontiguousarray(part[y : y + rows]))
        return pixels, mask

    def _converted(self, pixels: Pixels, mask: NDArray[np.uint8] | None) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        colours = _chosen(pixels, self.conversion.colours)
        coverage = self._coverage(pixels, colours, mask) if self.masked else None
        return self._values(colours, coverage), coverage

    def begin(self) -> None:
        """Start anew what ``digest`` covers, for this thread."""
        self._local.hashers = xxh3_128(), xxh3_128()

    def digest(self) -> str:
        """Return the digest of what this thread has read since ``begin``: a stretch of rows has one, however it was read in portions.

        It only has to tell one state of a file from another, nobody gains by forging it; XXH3 takes 1/20 of the time of BLAKE2.
        """
        pixels, masks = self._local.hashers
        return digest(pixels.digest() + masks.digest())

    def close(self) -> None:
        """Close the file."""
        self._reader.close()

    def _coverage(self, pixels: Pixels, colours: Pixels, mask: NDArray[np.uint8] | None) -> NDArray[np.float32]:
        coverage = np.ones(pixels.shape[:2], np.float32)
        if self.conversion.alpha is not None:
            alpha = pixels[..., self.conversion.alpha]
            coverage = alpha.astype(np.float32)
            if alpha.dtype.kind == "u":
                coverage /= np.float32(self.info.largest)
            coverage = np.clip(np.nan_to_num(coverage, nan=0.0), 0, 1)
        if mask is not None:
            coverage *= mask.astype(np.float32) / np.float32(255)
        if self.conversion.nodata is not None:
            # Compared in the file's own type, before any conversion: -32768 or 1.7e38 would not survive one.
            coverage[(colours == _in_dtype(self.conversion.nodata, colours.dtype)).all(axis=-1)] = 0
        if colours.dtype.kind == "f":
            coverage[~np.isfinite(colours).all(axis=-1)] = 0
        return coverage

    def _values(self, colours: Pixels, coverage: NDArray[np.float32] | None) -> NDArray[np.float32]:
        conversion = self.conversion
        if coverage is not None:
            colours = np.where(coverage[..., np.newaxis] > 0, colours, colours.dtype.type(0))
        if (
            colours.dtype.kind in "iu"
            and colours.dtype.itemsize > 2
            and np.abs(colours.astype(np.float64)).max(initial=0) > _EXACT_INTEGERS
        ):
            raise InputError(f"{self.info.path}: whole numbers beyond {_EXACT_INTEGERS} would be rounded; scale the file down first")
        if colours.dtype.kind == "f":
            self._refuse_absurd(colours)
        exact = conversion.decode is None and (conversion.scale, conversion.offset) == (1.0, 0.0)
        with np.errstate(over="ignore", under="ignore"):
            values = np.ascontiguousarray(colours, np.float32) if exact else _scaled(colours, conversion)
            if conversion.premultiplied and coverage is not None:
                np.divide(values, coverage[..., np.newaxis], out=values, where=coverage[..., np.newaxis] > 0)
        if not exact and coverage is not None:
            values[coverage == 0] = 0
        if (not exact or colours.dtype == np.float64 or conversion.premultiplied) and not np.isfinite(values).all():
            raise InputError(f"{self.info.path}: values beyond the range of float32; if they mark voids, say so with --nodata")
        if colours.dtype.kind == "f":
            values += np.float32(0)  # -0 becomes 0: equal heights have equal bytes
        return values

    def _refuse_absurd(self, heights: Pixels) -> None:
        """Raise InputError if valid floats are beyond all heights: a mark for voids that the file does not declare."""
        low, high = heights.min(initial=0), heights.max(initial=0)
        extreme = high if high >= -low else low
        if abs(float(extreme)) > _HIGHEST:
            raise InputError(f"{self.info.path}: {extreme!s} is no height; if it marks voids, give --nodata {extreme!s}")


def _lean(values: NDArray[np.float32], coverage: NDArray[np.float32] | None) -> tuple[Pixels, NDArray[np.float32] | None]:
    return values, None if coverage is None or (coverage == 1).all() else coverage


def _chosen(pixels: Pixels, channels: tuple[int, ...]) -> Pixels:
    if channels == tuple(range(channels[0], channels[0] + len(channels))):
        return pixels[..., channels[0] : channels[0] + len(channels)]
    return pixels[..., list(channels)]


def _in_dtype(value: float, dtype: np.dtype[Any]) -> float:
    with np.errstate(under="ignore"):
        return float(dtype.type(value)) if dtype.kind == "f" else value


def _scaled(colours: Pixels, conversion: Conversion) -> NDArray[np.float32]:
    units = _decoded(colours, conversion.decode) if conversion.decode else colours.astype(np.float64)
    return (units * conversion.scale + conversion.offset).astype(np.float32)


def _decoded(colours: Pixels, encoding: HeightEncoding) -> NDArray[np.float64]:
    """Return heights from colour: terrarium R*256 + G + B/256 - 32768, terrain-RGB -10000 + (R*65536 + G*256 + B) / 10 [m]."""
    red, green, blue = (colours[..., channel].astype(np.float64) for channel in range(3))
    if encoding == "terrarium":
        return (red * 256 + green + blue / 256 - 32768)[..., np.newaxis]
    return ((red * 65536 + green * 256 + blue) / 10 - 10000)[..., np.newaxis]


def choose_conversion(info: FileInfo, settings: BuildSettings) -> Conversion:
    """Return how the file becomes a layer, as ``settings`` say or the file suggests.

    Raises UsageError or InputError with what to do if file and settings do not go together.
    """
    chosen = tuple(range(info.channels)) if settings.bands is None else tuple(band - 1 for band in settings.bands)
    if max(chosen) >= info.channels:
        raise UsageError(f"{info.path}: no channel {max(chosen) + 1}, it has {info.channels}; correct --bands")
    alpha = info.alpha if settings.bands is None or info.alpha in chosen else None
    colours = tuple(channel for channel in chosen if channel != alpha)
    decode = None if settings.decode == "none" else settings.decode
    kind = settings.layer or ("height" if decode else _guessed_kind(info, colours))
    if kind == "height":
        _check_height(info, colours, decode)
    else:
        _check_imagery(info, colours, settings)
    _check_stretch(info, kind, settings)
    # With --stretch the numbers of the file are stretched, not those scaled to its type.
    full = np.iinfo(info.dtype).max / info.largest if kind == "imagery" and settings.stretch is None else 1.0
    return Conversion(
        kind=kind,
        colours=colours,
        alpha=alpha,
        premultiplied=info.premultiplied and alpha is not None,
        nodata=void_value(info, settings.nodata),
        decode=decode,
        scale=settings.height_scale if kind == "height" else full,
        offset=settings.height_offset if kind == "height" else 0.0,
        dtype="float32" if kind == "height" else "uint8" if info.dtype == np.uint8 or settings.stretch is not None else "uint16",
    )


def _guessed_kind(info: FileInfo, colours: tuple[int, ...]) -> LayerKind:
    if len(colours) == 1 and info.dtype.kind in "if":
        return "height"
    if len(colours) == 3 and info.dtype.kind == "u":
        return "imagery"
    if len(colours) not in (1, 3):
        raise UsageError(f"{info.path}: has {len(colours)} channels; choose 1 or 3 with --bands, e.g. --bands 1,2,3")
    raise UsageError(
        f"{info.path}: {len(colours)} channel(s) of {info.dtype} could be imagery or heights; say --layer imagery or --layer height"
    )


def _check_height(info: FileInfo, colours: tuple[int, ...], decode: HeightEncoding | None) -> None:
    if decode:
        if len(colours) != 3 or info.dtype != np.uint8:
            raise InputError(f"{info.path}: --decode {decode} needs 3 channels of uint8, not {len(colours)} of {info.dtype}")
    elif len(colours) != 1:
        raise InputError(
            f"{info.path}: heights have one channel, this has {len(colours)}; give --decode terrain-rgb or --decode terrarium "
            "if its colours encode heights, or choose a channel with --bands"
        )
    if info.dtype.kind not in "iuf":
        raise InputError(f"{info.path}: samples of type {info.dtype} are not heights")


def _check_imagery(info: FileInfo, colours: tuple[int, ...], settings: BuildSettings) -> None:
    if settings.decode not in (None, "none") or (settings.height_scale, settings.height_offset) != (1.0, 0.0):
        raise UsageError("--decode, --height-scale and --height-offset are for heights; add --layer height or leave them out")
    if info.dtype not in (np.uint8, np.uint16):
        raise InputError(
            f"{info.path}: imagery has 8 or 16 bits without sign, this is {info.dtype}; convert it, e.g. with "
            "gdal_translate -ot Byte -scale, or build it with --layer height if its samples are heights"
        )
    if len(colours) not in (1, 3):
        raise InputError(
            f"{info.path}: imagery has 1 or 3 colour channels and perhaps alpha, this has {len(colours)}; "
            "choose with --bands, e.g. --bands 1,2,3"
        )


def _check_stretch(info: FileInfo, kind: LayerKind, settings: BuildSettings) -> None:
    if settings.stretch is None:
        return
    if kind != "imagery":
        raise UsageError(f"{info.path}: --stretch is for imagery, stretched heights would be false; leave it out")
    if info.dtype == np.uint8:
        raise UsageError(f"{info.path}: has 8 bits already, and --stretch makes 8 bits of 16; leave it out")


def void_value(info: FileInfo, given: float | None) -> float | None:
    """Return the value that marks voids, ``given`` or declared, None if there is none or no sample of the file's type can have it.

    A declared value beyond a float type's range stands for the end of that range, which is what its writer was left with. Raises
    UsageError if no sample can have the ``given`` one.
    """
    value = info.nodata if given is None else given
    if value is None or not np.isfinite(value):
        return None
    if info.dtype.kind == "f":
        largest = float(np.finfo(info.dtype).max)
        return min(max(value, -largest), largest)
    limits = np.iinfo(info.dtype)
    if value == int(value) and limits.min <= value <= limits.max:
        return value
    if given is not None:
        raise UsageError(f"{info.path}: --nodata {value:g} marks nothing, no sample of {info.dtype} can have that value")
    return None
