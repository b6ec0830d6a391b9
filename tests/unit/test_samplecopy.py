"""The copy of samples that workers read: every bit of the original and its digests, and never a damaged piece."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from schemas.errors import StorageError
from schemas.region import Rect
from schemas.settings import LightSettings
from tests.integration.lighting import rough, store_heights
from tiler.building.light import open_light
from tiler.cluster.samplecopy import CopiedSamples, SampleCopy, copy_folder, delete_copy
from tiler.light.lightsource import LightSource
from tiler.sources import FileInfo
from tiler.sources.convert import Conversion, SampleSource
from tiler.stores.dataset import open_dataset
from tiler.stores.directory import DirectoryStore


class Made(LightSource):
    """Light that was made up, digested as light is."""

    def __init__(self, values: NDArray[np.float32], masked: bool) -> None:
        height, width, channels = values.shape
        self.info = FileInfo(Path("made"), "made", width, height, channels, np.dtype(np.float32), 0, "tiled", 1)
        self.conversion = Conversion("light", tuple(range(channels)), None, False, None, None, 1.0, 0.0, "float32")
        self.masked, self.values = masked, values
        self.reads = 0

    def read(self, window: Rect) -> tuple[NDArray[np.float32], Any]:
        self.reads += 1
        values = self.values[window.y0 : window.y1, window.x0 : window.x1]
        valid = ~np.isnan(values[..., 0])
        return np.where(valid[..., np.newaxis], values, np.float32(0)), valid.astype(np.float32) if self.masked else None

    def close(self) -> None:
        pass


def made(height: int, width: int, channels: int = 1, masked: bool = True, seed: int = 3) -> Made:
    random = np.random.default_rng(seed)
    values = random.integers(0, 1 << 32, (height, width, channels), np.uint32).view(np.float32)
    values = np.where(np.isnan(values), np.float32(-0.0), values)
    values[random.random((height, width)) < 0.1 * masked] = np.nan
    return Made(values, masked)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 5), (257, 1025), (512, 40), (600, 2100)])
@pytest.mark.parametrize(("channels", "masked"), [(1, True), (1, False), (2, True)])
def test_every_bit_comes_back(height: int, width: int, channels: int, masked: bool, tmp_path: Path) -> None:
    """Any bits at all, denormals, infinities and -0 among them; windows across pieces; nothing is held that was not made whole."""
    store, source = DirectoryStore(tmp_path), made(height, width, channels, masked)
    copy = SampleCopy(store, "light", "of these", 2)
    assert not copy.holds(source)
    copy.make(source)
    assert copy.holds(source)
    copied = CopiedSamples(source, store, "light")
    random = np.random.default_rng(1)
    windows = [source.info.rect]
    for _ in range(5):
        x, y = int(random.integers(width)), int(random.integers(height))
        windows.append(Rect(x, y, int(random.integers(x, width)) + 1, int(random.integers(y, height)) + 1))
    for window in windows:
        values, coverage = copied.read(window)
        expected, covered = source.read(window)
        assert values.tobytes() == expected.tobytes()
        assert (coverage is None) == (not masked)
        assert coverage is None or coverage.tobytes() == covered.tobytes()


@pytest.mark.parametrize("seed", [1, 2])
def test_digests_are_those_of_light(seed: int, tmp_path: Path) -> None:
    """A record that a worker wrote is taken for good by a local build, and the other way round."""
    heights = rough(70, seed)
    heights[10:20, 30:40] = np.nan
    dataset = open_dataset(store_heights(tmp_path, heights))
    _, source, _ = open_light(dataset, LightSettings(azimuth_deg=200, elevation_deg=20))
    source.bake()
    SampleCopy(dataset.store, "light", "", 1).make(source)
    readers: list[SampleSource] = [source, CopiedSamples(source, dataset.store, "light")]
    found = []
    for reader in readers:
        reader.begin()
        reader.read_lean(Rect(3, 4, 60, 50))
        reader.read(Rect(0, 0, 70, 70))
        found.append(reader.digest())
    assert found[0] == found[1]
    source.close()


def test_another_copy_is_not_taken(tmp_path: Path) -> None:
    """Of other samples, with a piece that is damaged or gone, or one that was never made whole."""
    store, source = DirectoryStore(tmp_path), made(300, 40)
    SampleCopy(store, "light", "of these", 1).make(source)
    assert not SampleCopy(store, "light", "of those", 1).holds(source)
    assert not SampleCopy(store, "light.2", "of these", 1).holds(source)
    key = f"{copy_folder('light')}/256/0"
    whole = store.read(key)
    for damaged in (whole[:-1], whole[:20] + bytes([whole[20] ^ 1]) + whole[21:], b""):
        store.write(key, damaged)
        assert not SampleCopy(store, "light", "of these", 1).holds(source)
        with pytest.raises(StorageError, match=r"tasks/samples/256/0 is damaged or gone"):
            CopiedSamples(source, store, "light").read(source.info.rect)
        CopiedSamples(source, store, "light").read(Rect(0, 0, 40, 256))
    store.delete([key])
    with pytest.raises(StorageError, match="is damaged or gone"):
        CopiedSamples(source, store, "light").read(source.info.rect)
    store.write(key, whole)
    assert SampleCopy(store, "light", "of these", 1).holds(source)
    delete_copy(store, "light")
    assert store.keys("") == []
