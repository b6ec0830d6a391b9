"""What this machine can do at most: the rates that a build's stages are set against."""

import os
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tests.bench.inputs import Source, natural_picture, terrain
from tests.bench.peers_room import Room, read_through
from tiler.codecs import BlockFormat, open_codec
from tiler.filters.decimate import coarsen_columns, coarsen_rows
from tiler.filters.kernels import Kernel, blackman_sinc, box

MEMORY_BYTES: Final = 1 << 28
"""Copied at once by each thread: far more than the last-level cache holds."""
FILE_BYTES: Final = 25_000
"""Of each new file: a JPEG block of 256 x 256 at quality 85."""
REPEATS: Final = 5


def _seconds(work: Callable[[], object], repeats: int = REPEATS) -> float:
    """Return the median of ``repeats`` runs, after one that is not counted."""
    work()
    taken = []
    for _ in range(repeats):
        started = perf_counter()
        work()
        taken.append(perf_counter() - started)
    return median(taken)


def copy_bytes_per_s(threads: int) -> float:
    """Return bytes read and written per second by ``threads`` copies of memory at the same time."""
    pairs = [(np.ones(MEMORY_BYTES, np.uint8), np.zeros(MEMORY_BYTES, np.uint8)) for _ in range(threads)]
    with ThreadPoolExecutor(threads) as pool:
        seconds = _seconds(lambda: list(pool.map(lambda pair: np.copyto(pair[1], pair[0]), pairs)))
    return 2 * MEMORY_BYTES * threads / seconds


def filter_samples_per_s(kernel: Kernel, channels: int) -> float:
    """Return fine pixels per second of one halving on one thread, float32 samples that fit the second-level cache."""
    before, after = kernel.reach
    side, rows, twin = 1024, 64, int(kernel.registration == "area")
    low, high = np.array(kernel.low, np.int64), np.array(kernel.high, np.int64)
    weights = np.array(kernel.weights, np.float32)
    width = side + before + after
    fine = np.random.default_rng(1).random((rows + before + after, width * channels), np.float32)
    halved = np.empty((rows // 2, width * channels), np.float32)
    coarse = np.empty((rows // 2, side // 2, channels), np.float32)

    def halve() -> None:
        for _ in range(20):
            coarsen_rows(fine, before, low, high, weights, twin, halved)
            coarsen_columns(halved.reshape(rows // 2, width, channels), before, low, high, weights, twin, coarse)

    return 20 * rows * side / _seconds(halve)


def encode_samples_per_s(spec: str, block: BlockFormat, samples: NDArray[np.generic]) -> float:
    """Return pixels per second of one thread that encodes 256 x 256 blocks out of ``samples`` and does nothing else."""
    codec = open_codec(spec, block)
    blocks = [
        np.ascontiguousarray(samples[row : row + 256, column : column + 256])
        for row in range(0, samples.shape[0], 256)
        for column in range(0, samples.shape[1], 256)
    ]
    return len(blocks) * 65536 / _seconds(lambda: [codec.encode(part, None) for part in blocks])


def read_bytes_per_s(source: Path) -> float:
    """Return bytes per second of one thread that copies a file out of the page cache, decoding nothing."""
    return float(source.stat().st_size / _seconds(lambda: read_through(source), 3))


def files_per_s(folder: Path, size: int, threads: int = 1, count: int = 2000) -> float:
    """Return how many files of ``size`` bytes ``threads`` threads create per second, each in a fresh folder that stays.

    The disk is not waited for. ``count`` files per thread are made, three times.
    """
    data, taken = os.urandom(size), []

    def fill(place: Path) -> None:
        for number in range(count):
            (place / str(number)).write_bytes(data)

    with ThreadPoolExecutor(threads) as pool:
        for _ in range(3):
            places = [Path(tempfile.mkdtemp(dir=folder)) for _ in range(threads)]
            started = perf_counter()
            list(pool.map(fill, places))
            taken.append(perf_counter() - started)
    return threads * count / median(taken)


def disk_bytes_per_s(folder: Path, size: int = 1 << 28) -> float:
    """Return bytes per second of one large file until the disk has it."""
    data = os.urandom(size)

    def write() -> None:
        with tempfile.NamedTemporaryFile(dir=folder) as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())

    return size / _seconds(write, 3)


def limits(room: Room, side: int) -> dict[str, float]:
    """Return all rates per second, on parts of the sources; ``side`` is that of the source that is read."""
    picture, heights = natural_picture(1024), terrain(1024)
    rgb = BlockFormat("imagery", 256, 3, "uint8")
    height = BlockFormat("height", 256, 1, "float32")
    processors = len(os.sched_getaffinity(0))
    return {
        "copy_bytes_1_thread": copy_bytes_per_s(1),
        "copy_bytes_all_threads": copy_bytes_per_s(processors),
        "read_bytes": read_bytes_per_s(room.source(Source("rgb", side))),
        "filter_rgb_blackman_sinc_3": filter_samples_per_s(blackman_sinc(3, "area"), 3),
        "filter_rgb_box": filter_samples_per_s(box(1, "area"), 3),
        "filter_height_blackman_sinc_6": filter_samples_per_s(blackman_sinc(6, "point"), 1),
        "filter_height_box": filter_samples_per_s(box(1, "point"), 1),
        "encode_jpeg_85": encode_samples_per_s("jpeg:85", rgb, picture),
        "encode_png": encode_samples_per_s("png", rgb, picture),
        "encode_lerc_0.1": encode_samples_per_s("lerc:0.1", height, heights),
        "encode_exr_float": encode_samples_per_s("exr:float", height, heights),
        "encode_png16": encode_samples_per_s("png16:0.1,-1000", height, heights),
        "files_1_thread": files_per_s(room.output(), FILE_BYTES),
        "files_all_threads": files_per_s(room.output(), FILE_BYTES, processors),
        "disk_bytes": disk_bytes_per_s(room.output()),
    }
