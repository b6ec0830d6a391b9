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
import rasterio
from numpy.typing import NDArray

from tiler.codecs import BlockFormat, open_codec
from tiler.filters.decimate import coarsen_columns, coarsen_rows
from tiler.filters.kernels import Kernel, blackman_sinc, box

MEMORY_BYTES: Final = 1 << 28
"""Copied at once by each thread: far more than the last-level cache holds."""
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
    side, rows = 1024, 64
    low, high = np.array(kernel.low, np.int64), np.array(kernel.high, np.int64)
    weights = np.array(kernel.weights, np.float32)
    width = side + before + after
    fine = np.random.default_rng(1).random((rows + before + after, width * channels), np.float32)
    halved = np.empty((rows // 2, width * channels), np.float32)
    coarse = np.empty((rows // 2, side // 2, channels), np.float32)

    def halve() -> None:
        for _ in range(20):
            coarsen_rows(fine, before, low, high, weights, 1, halved)
            coarsen_columns(halved.reshape(rows // 2, width, channels), before, low, high, weights, 1, coarse)

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


def read_samples_per_s(source: Path) -> float:
    """Return pixels per second of one thread that copies the bytes of ``source`` out of the page cache, decoding nothing."""
    with rasterio.open(source) as file:
        area = file.width * file.height
    buffer = bytearray(1 << 22)

    def read() -> None:
        with open(source, "rb", buffering=0) as file:
            while file.readinto(buffer):
                pass

    return float(area / _seconds(read, 3))


def files_per_s(folder: Path, size: int, count: int = 2000) -> float:
    """Return how many files of ``size`` bytes one thread creates per second in one folder, without waiting for the disk."""
    data, taken = os.urandom(size), []
    for _ in range(3):
        with tempfile.TemporaryDirectory(dir=folder) as name:
            started = perf_counter()
            for number in range(count):
                (Path(name) / str(number)).write_bytes(data)
            taken.append(perf_counter() - started)
    return count / median(taken)


def disk_bytes_per_s(folder: Path, size: int = 1 << 28) -> float:
    """Return bytes per second of one large file until the disk has it."""
    data = os.urandom(size)

    def write() -> None:
        with tempfile.NamedTemporaryFile(dir=folder) as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())

    return size / _seconds(write, 3)


def limits(folder: Path, picture: NDArray[np.uint8], heights: NDArray[np.float32], source: Path) -> dict[str, float]:
    """Return all rates, measured on parts of the sources: ``picture`` (n, n, 3) and ``heights`` (n, n, 1); rates are per second."""
    rgb = BlockFormat("imagery", 256, 3, "uint8")
    height = BlockFormat("height", 256, 1, "float32")
    return {
        "copy_bytes_1_thread": copy_bytes_per_s(1),
        "copy_bytes_all_threads": copy_bytes_per_s(len(os.sched_getaffinity(0))),
        "read_rgb": read_samples_per_s(source),
        "filter_rgb_blackman_sinc_3": filter_samples_per_s(blackman_sinc(3, "area"), 3),
        "filter_rgb_box": filter_samples_per_s(box(1, "area"), 3),
        "filter_height_blackman_sinc_6": filter_samples_per_s(blackman_sinc(6, "area"), 1),
        "encode_jpeg_85": encode_samples_per_s("jpeg:85", rgb, picture),
        "encode_png": encode_samples_per_s("png", rgb, picture),
        "encode_lerc_0.1": encode_samples_per_s("lerc:0.1", height, heights),
        "files_of_8_kB": files_per_s(folder, 8000),
        "disk_bytes": disk_bytes_per_s(folder),
    }
