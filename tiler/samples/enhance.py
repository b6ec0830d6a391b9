"""Wavelet enhancement of imagery before the pyramid is built (Tian et al., section IV), streamed.

Tian et al. enhance the texture "before preprocess", as coarser levels lose detail; they name a wavelet method and leave its
details to their reference 11. Here the picture is split by the undecimated transform with the cubic B-spline filter
(1, 4, 6, 4, 1) / 16 (Starck, Fadili and Murtagh, "The Undecimated Wavelet Decomposition and its Reconstruction", IEEE
Transactions on Image Processing 16(2), 2007): smoothing by holes of 1, 2, 4 samples gives c1, c2, c3, and the details of scale
j are w_j = c_(j-1) - c_j, so that x = w1 + w2 + w3 + c3. Details between noise and strong edges are amplified (after Starck,
Donoho and Candes, "Astronomical image representation by the curvelet transform", A&A 398, 2003, section 4):

    y = x + (gain - 1) * sum over j of w_j * m**2 / (m**2 + T**2) * S / (S + m)

with m the root mean square of w_j over the channels, so that a detail keeps its hue, T the noise and S the edge strength, both
relative to the local brightness c3. What m becomes grows with m, and a scale adds less than (gain - 1) * S to it.

No sample depends on how the picture is cut: the transform is shift-invariant, windows are grown by its whole support, and
samples are taken on a grid of 1/16 while weights are 1/16 too, so every sum of at most 16 + 4 + 8 + 24 bits is exact in
float64, in whatever order it is taken.
"""

import math
import threading
from dataclasses import dataclass
from importlib import import_module
from itertools import product
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from schemas.errors import MissingExtraError, UsageError
from schemas.region import Rect
from tiler.compiled import compiled
from tiler.sources.convert import DerivedSource, SampleSource

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Indices = NDArray[np.intp]

DEFAULT_GAIN: Final = 1.5
MAX_GAIN: Final = 4.0
SCALES: Final = 3
"""Details up to 8 samples across, so that the next two levels gain as well."""
REACH: Final = 2 * (2**SCALES - 1)
"""Samples to each side that a result depends on: two taps at distances 1, 2 and 4."""
NOISE_STEP: Final = 1.0
"""Details as weak as the rounding of the source [units of a sample] are amplified by half."""
NOISE_SHARE: Final = 0.01
"""So are details this weak relative to the local brightness; both add up as variances."""
EDGE_SHARE: Final = 0.25
"""Details this strong relative to the local brightness are amplified by half, stronger ones less."""

GRID: Final = 16.0
"""Samples are smoothed in steps of 1/16; whole numbers, as most files have them, are not changed by that."""
FULL: Final = 255.0
"""Coverage is weighed in steps of 1/255; what is covered at all weighs at least one."""

_PIECE: Final = 256
"""Rows and columns enhanced at once: so little that their float64 copies (7 MiB in all) do not count."""
_MAX_AHEAD_ROWS: Final = 1024
_NO_MASK = np.empty((0, 0), np.float32)


@dataclass(frozen=True, slots=True)
class Enhancement:
    """How imagery is enhanced: details are amplified by up to ``gain``; 1 changes nothing."""

    gain: float

    @property
    def spec(self) -> str:
        """The form that ``parse_enhancement`` reads, with the gain spelled out."""
        return f"wavelet:{self.gain!r}".removesuffix(".0")


def parse_enhancement(spec: str) -> Enhancement:
    """Return the enhancement that ``wavelet`` or ``wavelet:GAIN`` asks for; raises UsageError for anything else."""
    name, colon, number = spec.partition(":")
    try:
        gain = float(number) if colon else DEFAULT_GAIN
    except ValueError:
        gain = math.nan
    if name != "wavelet" or not 1 <= gain <= MAX_GAIN:
        raise UsageError(f"--enhance {spec!r}: expected wavelet or wavelet:GAIN with a gain from 1 to {MAX_GAIN:g}, e.g. wavelet:1.5")
    return Enhancement(gain)


class _Starlet:
    """The B-spline smoothing of the undecimated transform, by PyWavelets; raises MissingExtraError if that is not installed."""

    def __init__(self) -> None:
        try:
            pywt: Any = import_module("pywt")
        except ImportError as error:
            raise MissingExtraError("--enhance needs PyWavelets: pip install 'clipmap[enhance]'") from error
        # Six taps, of which the fourth is the centre: so PyWavelets shifts nothing at any scale.
        identity = np.array([0, 0, 0, 1, 0, 0], np.float64)
        smooth = np.array([0, 1, 4, 6, 4, 1], np.float64) / 16
        self._wavelet: Any = pywt.Wavelet("starlet", filter_bank=[smooth, identity - smooth, identity, identity])
        self._transform: Any = pywt.swt

    def smoothed(self, planes: Float64) -> list[Float64]:
        """Return ``planes`` (n, rows, columns; both multiples of 8) smoothed by every scale; periodic, so wrong near the edges."""
        result = []
        for scale in range(SCALES):
            for axis in (1, 2):
                planes = self._transform(planes, self._wavelet, level=1, start_level=scale, axis=axis)[0][0]
            result.append(planes)
        return result


@dataclass(frozen=True, slots=True)
class _Held:
    """Rows read ahead by one thread: samples and coverage from (x0, y0) on."""

    window: Rect
    values: Float32
    coverage: Float32 | None


class EnhancedSource(DerivedSource):
    """A source of imagery whose samples are enhanced; the coverage is that of the file.

    Beyond the edge of the file it is mirrored. Smoothing is weighed by coverage, so nothing that is void takes part; near voids,
    where smoothing is one-sided, the amplification fades. Results stay within the range of the stored type. Raises MissingExtraError
    without PyWavelets, UsageError for heights.
    """

    def __init__(self, source: SampleSource, enhancement: Enhancement) -> None:
        if source.conversion.kind != "imagery":
            raise UsageError(f"{source.info.path}: --enhance is for imagery, enhanced heights would be false; leave it out")
        super().__init__(source)
        self._gain = enhancement.gain
        self._starlet = _Starlet()
        self._top = float(np.iinfo(source.conversion.dtype).max)
        self._local = threading.local()

    def read(self, window: Rect) -> tuple[Float32, Float32 | None]:
        """Return enhanced samples (rows, columns, channels) and coverage (rows, columns), None unless ``masked``."""
        if self._gain == 1:
            return self._source.read(window)
        rows = _mirrored(window.y0 - REACH, window.y1 + REACH, self.info.height)
        columns = _mirrored(window.x0 - REACH, window.x1 + REACH, self.info.width)
        held = Rect(int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1)
        values, coverage = self._rows(held)
        rows, columns = rows - held.y0, columns - held.x0
        enhanced = np.empty((window.height, window.width, values.shape[2]), np.float32)
        for y, x in product(range(0, window.height, _PIECE), range(0, window.width, _PIECE)):
            piece = enhanced[y : y + _PIECE, x : x + _PIECE]
            seen = rows[y : y + len(piece) + 2 * REACH], columns[x : x + piece.shape[1] + 2 * REACH]
            self._enhance(values, coverage, seen, piece)
        return enhanced, None if coverage is None else coverage[np.ix_(rows[REACH:-REACH], columns[REACH:-REACH])]

    def begin(self) -> None:
        """Start anew what ``digest`` covers, for this thread, and forget the rows held."""
        self._local.held = None
        super().begin()

    def _rows(self, window: Rect) -> tuple[Float32, Float32 | None]:
        """Read a window of the file, and keep what the next window below shares with it: no tile is decoded twice."""
        held: _Held | None = getattr(self._local, "held", None)
        chunk = self.info.chunk_rows
        end = min(-(-window.y1 // chunk) * chunk, self.info.height) if chunk <= _MAX_AHEAD_ROWS else window.y1
        if held and (held.window.x0, held.window.x1) == (window.x0, window.x1) and held.window.y0 <= window.y0 < held.window.y1:
            above = window.y0 - held.window.y0
            values, coverage = held.values[above:], None if held.coverage is None else held.coverage[above:]
            if end > held.window.y1:
                more, more_covered = self._source.read(Rect(window.x0, held.window.y1, window.x1, end))
                values = np.concatenate([values, more])
                coverage = None if coverage is None or more_covered is None else np.concatenate([coverage, more_covered])
            end = max(end, held.window.y1)
        else:
            values, coverage = self._source.read(Rect(window.x0, window.y0, window.x1, end))
        self._local.held = _Held(Rect(window.x0, window.y0, window.x1, end), values, coverage)
        return values[: window.height], None if coverage is None else coverage[: window.height]

    def _enhance(self, values: Float32, coverage: Float32 | None, seen: tuple[Indices, Indices], out: Float32) -> None:
        """Put into ``out`` (rows, columns, channels) what the rows and columns ``seen`` around it make of it."""
        rows, columns = (-(-len(axis) // 2**SCALES) * 2**SCALES for axis in seen)
        planes = np.zeros((values.shape[2] + 1, rows, columns))
        weigh(values, _NO_MASK if coverage is None else coverage, coverage is not None, *seen, self._top, planes)
        smooth = self._starlet.smoothed(planes if coverage is not None else planes[:-1])
        amplify(values, *seen, planes, smooth[0], smooth[1], smooth[2], coverage is not None, self._gain - 1, self._top, out)


@compiled
def weigh(values: Float32, coverage: Float32, masked: bool, rows: Indices, columns: Indices, top: float, planes: Float64) -> None:
    """Put samples times weight, and the weight, into ``planes`` (channels + 1, rows, columns): both so coarse that sums are exact."""
    for v in range(rows.size):
        for u in range(columns.size):
            y, x = rows[v], columns[u]
            weight = 1.0
            if masked:
                weight = np.rint(np.float64(coverage[y, x]) * FULL)
                if weight == 0.0 and coverage[y, x] > 0:
                    weight = 1.0
            planes[-1, v, u] = weight
            for channel in range(values.shape[2]):
                value = min(max(np.float64(values[y, x, channel]), 0.0), top)
                planes[channel, v, u] = weight * (np.rint(value * GRID) / GRID)


@compiled
def amplify(
    values: Float32,
    rows: Indices,
    columns: Indices,
    planes: Float64,
    first: Float64,
    second: Float64,
    third: Float64,
    masked: bool,
    excess: float,
    top: float,
    out: Float32,
) -> None:
    """Put the samples with their details amplified by up to 1 + ``excess`` into ``out``, which lies ``REACH`` inside ``planes``.

    ``first``, ``second`` and ``third`` are ``planes`` smoothed by the three scales; their last plane is the smoothed weight, if
    ``masked``. Normalised smoothing is the ratio of a plane and the weight.
    """
    channels = out.shape[2]
    detail, total = np.empty(channels), np.empty(channels)
    for j in range(out.shape[0]):
        for i in range(out.shape[1]):
            v, u = j + REACH, i + REACH
            own = planes[channels, v, u]
            if own == 0.0:
                out[j, i] = np.float32(0)
                continue
            brightness = 0.0
            for channel in range(channels):
                brightness += third[channel, v, u]
                total[channel] = 0.0
            brightness /= channels * (third[channels, v, u] if masked else 1.0)
            noise = NOISE_STEP**2 + (NOISE_SHARE * brightness) ** 2
            edge = NOISE_STEP + EDGE_SHARE * brightness
            fine, fine_weight = planes, own
            for coarse in (first, second, third):
                weight = coarse[channels, v, u] if masked else 1.0
                energy = 0.0
                for channel in range(channels):
                    detail[channel] = fine[channel, v, u] / fine_weight - coarse[channel, v, u] / weight
                    energy += detail[channel] * detail[channel]
                energy /= channels
                trust = min(max(2.0 * (weight / own) - 1.0, 0.0), 1.0)
                share = trust * trust * (energy / (energy + noise)) * (edge / (edge + np.sqrt(energy)))
                for channel in range(channels):
                    total[channel] += share * detail[channel]
                fine, fine_weight = coarse, weight
            for channel in range(channels):
                value = np.float64(values[rows[v], columns[u], channel]) + excess * total[channel]
                out[j, i, channel] = np.float32(min(max(value, 0.0), top))


def _mirrored(first: int, last: int, size: int) -> Indices:
    """Return the indices ``first`` to ``last`` of an axis of ``size`` samples, with those beyond its ends reflected about them."""
    place = np.arange(first, last) % (2 * size)
    return np.minimum(place, 2 * size - 1 - place)
