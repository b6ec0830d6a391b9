"""The float32 samples of a level that lies between two tiers: every task hands on one piece of it, the next tier reads windows."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.region import Rect
from tiler.filters.cascade import Coverage, Values
from tiler.tasks.partition import Task

Pixels = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class PieceRef:
    """A piece of the tier below: the task that made it, and the digest of its bytes."""

    task: Task
    digest: str


class PieceWriter:
    """Collects the rows of a task's piece; coverage, if samples may be void, is one more channel."""

    def __init__(self, task: Task, channels: int, masked: bool) -> None:
        self._rect = task.piece
        self._channels = channels
        self._pixels = np.empty((self._rect.height, self._rect.width, channels + masked), np.float32)

    def take(self, first: int, values: Values, coverage: Coverage | None, left: int) -> None:
        """Take rows ``first`` and following, whose first column is ``left``; what lies outside the piece is dropped."""
        rows = Rect(left, first, left + values.shape[1], first + len(values)) & self._rect
        if not rows.area:
            return
        given = np.s_[rows.y0 - first : rows.y1 - first, rows.x0 - left : rows.x1 - left]
        place = np.s_[rows.y0 - self._rect.y0 : rows.y1 - self._rect.y0, rows.x0 - self._rect.x0 : rows.x1 - self._rect.x0]
        self._pixels[place][..., : self._channels] = values[given]
        if self._pixels.shape[2] > self._channels:
            self._pixels[place][..., self._channels] = 1 if coverage is None else coverage[given]

    def data(self) -> bytes:
        """Return the piece: little-endian float32 samples in row order."""
        return self._pixels.astype("<f4", copy=False).tobytes()


class PieceReader:
    """Windows of a level that ``pieces`` cover, for one task, top to bottom; ``load`` returns the bytes of pieces."""

    def __init__(
        self, pieces: Sequence[PieceRef], load: Callable[[Sequence[PieceRef]], Sequence[bytes]], channels: int, masked: bool
    ) -> None:
        self._pieces, self._load = pieces, load
        self._channels, self._masked = channels, masked
        self._held: dict[Rect, Pixels] = {}

    def read_lean(self, window: Rect) -> tuple[Values, Coverage | None]:
        """Return values (rows, columns, channels) and coverage, None if it is 1, of a window; pieces that end above it are forgotten."""
        pixels = np.empty((window.height, window.width, self._channels + self._masked), np.float32)
        self._held = {rect: held for rect, held in self._held.items() if rect.y1 > window.y0}
        seen = [piece for piece in self._pieces if piece.task.piece & window]
        missing = [piece for piece in seen if piece.task.piece not in self._held]
        for piece, data in zip(missing, self._load(missing), strict=True):
            rect = piece.task.piece
            self._held[rect] = np.frombuffer(data, "<f4").reshape(rect.height, rect.width, pixels.shape[2])
        for piece in seen:
            rect = piece.task.piece
            part = rect & window
            source = self._held[rect][part.y0 - rect.y0 : part.y1 - rect.y0, part.x0 - rect.x0 : part.x1 - rect.x0]
            pixels[part.y0 - window.y0 : part.y1 - window.y0, part.x0 - window.x0 : part.x1 - window.x0] = source
        if not self._masked:
            return pixels, None
        if (pixels[..., self._channels] == 1).all():
            return np.ascontiguousarray(pixels[..., : self._channels]), None
        return np.ascontiguousarray(pixels[..., : self._channels]), np.ascontiguousarray(pixels[..., self._channels])
