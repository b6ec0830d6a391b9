"""Linear light: sRGB imagery is decoded before it is filtered and encoded after, so that means are means of light.

A fine black-and-white pattern then turns into code 188, which looks as bright as the pattern, instead of 128. The
transfer function is that of IEC 61966-2-1.
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from schemas.region import Rect
from tiler.sources.convert import DerivedSource, SampleSource


@cache
def light_of_codes(top: int) -> NDArray[np.float32]:
    """Return the light, 0 to 1, of every code up to ``top``."""
    code = np.arange(top + 1) / top
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4).astype(np.float32)


def encode_srgb(light: NDArray[np.float32], top: int) -> NDArray[np.float32]:
    """Return the codes, 0 to ``top`` and not yet rounded, of ``light``; what is outside 0 to 1 is clipped.

    The code of every ``light_of_codes`` rounds back to itself, for 8 and for 16 bits.
    """
    light = np.clip(light, np.float32(0), np.float32(1))
    dark = light <= np.float32(0.0031308)
    curve = np.float32(1.055) * np.power(light, np.float32(1 / 2.4)) - np.float32(0.055)
    return np.float32(top) * np.where(dark, np.float32(12.92) * light, curve)


class LinearLight(DerivedSource):
    """A source of 8- or 16-bit sRGB codes as light between 0 and 1."""

    def __init__(self, source: SampleSource) -> None:
        super().__init__(source)
        self._light = light_of_codes(int(np.iinfo(source.conversion.dtype).max))

    def read(self, window: Rect) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """Return light (rows, columns, channels) and coverage of ``window``."""
        codes, coverage = self._source.read(window)
        return self._light[np.clip(np.rint(codes), 0, len(self._light) - 1).astype(np.int32)], coverage
