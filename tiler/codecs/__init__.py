"""Block codecs: samples to bytes and back, each with a stated promise. One file per family; this is the registry.

A codec string is ``name`` or ``name:parameters``, e.g. ``jpeg:85`` or ``lerc:0.01``. Codecs are cheap to make, hold no
state and may be used from several threads; encoding and decoding release the GIL in their libraries.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from schemas.errors import InputError, UsageError
from schemas.manifest import LayerKind, SampleType

Samples = NDArray[Any]
"""Samples of a block, (side, side, channels), of the block's dtype."""
Mask = NDArray[np.bool_]
"""Which samples are valid, (side, side)."""


@dataclass(frozen=True, slots=True)
class BlockFormat:
    """What the decoded blocks of a layer are: ``side`` x ``side`` samples of ``channels`` channels of ``dtype``."""

    kind: LayerKind
    side: int
    channels: int
    dtype: SampleType
    alpha: bool = False

    def __str__(self) -> str:
        return f"{self.kind} of {self.channels} channel{'s' * (self.channels > 1)} of {self.dtype}{' with alpha' if self.alpha else ''}"


class Codec(Protocol):
    """The contract of a codec; every implementation passes ``tests/contract/test_codecs.py``."""

    @property
    def spec(self) -> str:
        """The codec string with all parameters filled in, as the manifest keeps it."""
        ...

    @property
    def suffix(self) -> str:
        """File suffix of block names."""
        ...

    @property
    def media_type(self) -> str:
        """Media type of the bytes."""
        ...

    @property
    def max_error(self) -> float | None:
        """Largest absolute difference between a decoded and an encoded sample; 0 for lossless, None if not bounded.

        Rounding to the block's dtype may come on top: half a unit in the last place of a float32.
        """
        ...

    @property
    def value_range(self) -> tuple[float, float] | None:
        """Smallest and largest value that can be encoded; None if the dtype's own."""
        ...

    def encode(self, samples: Samples, mask: Mask | None) -> bytes:
        """Return the bytes of a block: ``samples`` (side, side, channels), ``mask`` (side, side) or None if all are valid.

        Masks belong to heights; imagery carries its mask as the alpha channel and passes None.
        """
        ...

    def decode(self, data: bytes) -> tuple[Samples, Mask | None]:
        """Return samples (side, side, channels) and mask (None if all valid); raises InputError if ``data`` is damaged.

        Void samples decode to 0.
        """
        ...


@contextmanager
def decoding(spec: str) -> Iterator[None]:
    """Turn what a codec library raises on damaged bytes into one InputError."""
    try:
        yield
    except (RuntimeError, ValueError, KeyError, OSError, MemoryError) as error:
        raise InputError(f"a {spec} block cannot be decoded, its bytes are damaged: {error}") from error


def checked(samples: Samples, block: BlockFormat, spec: str) -> Samples:
    """Return ``samples`` if their shape and dtype are the block's, else raise InputError with expected and found."""
    expected = (block.side, block.side, block.channels)
    if samples.shape != expected or samples.dtype != block.dtype:
        raise InputError(f"a {spec} block holds {samples.shape} {samples.dtype} instead of {expected} {block.dtype}; it is damaged")
    return samples


def voids_zeroed(samples: Samples, mask: Mask | None) -> tuple[Samples, Mask | None]:
    """Return ``samples`` (side, side, channels) with 0 where ``mask`` is False, and the mask, None if all samples are valid."""
    if mask is None or mask.all():
        return samples, None
    return np.where(mask[..., np.newaxis], samples, samples.dtype.type(0)), mask


def require_picture_end(data: bytes, end: bytes, what: str) -> None:
    """Raise ValueError if ``data`` does not end in ``end``: libraries forgive a cut that spares the last pixels, or fill up with grey."""
    if not data.endswith(end):
        raise ValueError(f"the {what} is missing")


PNG_END: Final = b"\x00\x00\x00\x00IEND\xaeB`\x82"
"""The last chunk of every PNG, with its length and check sum."""


def number_text(value: float) -> str:
    """Return the shortest text of a parameter that reads back as the same number, so that a stored codec string loses nothing."""
    text = f"{value:g}"
    return text if float(text) == value else repr(value)


Factory = Callable[[BlockFormat, str], Codec]

_MODULES: Final = {
    "jpeg": "tiler.codecs.photo",
    "png": "tiler.codecs.photo",
    "webp": "tiler.codecs.photo",
    "raw": "tiler.codecs.plain",
    "rgb565": "tiler.codecs.plain",
    "png16": "tiler.codecs.elevation",
    "lerc": "tiler.codecs.elevation",
    "exr": "tiler.codecs.openexr",
}
CODEC_NAMES: Final = tuple(_MODULES)


def open_codec(spec: str, block: BlockFormat) -> Codec:
    """Return the codec that ``spec`` names for blocks of the given format; its library is imported here.

    Raises UsageError if there is no such codec, a parameter is wrong, or the codec cannot hold such blocks.
    """
    name, _, parameters = spec.partition(":")
    if name not in _MODULES:
        raise UsageError(f"no codec {name!r}: use one of {', '.join(CODEC_NAMES)}")
    factories: dict[str, Factory] = import_module(_MODULES[name]).FACTORIES
    return factories[name](block, parameters)
