"""Archives as stores: the contract for what is loose in a folder, and the same keys and bytes as a directory for what is archived."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from schemas.address import BlockAddress
from schemas.errors import InputError, NotFoundError, StorageError
from schemas.manifest import MANIFEST_NAME, Manifest
from tests.contract.stores import StoreContract
from tests.server.datasets import publish, write_dataset, write_layer
from tiler.archives.writing import write_archive
from tiler.stores.archive import ArchiveFileStore, ArchiveStore, unfinished
from tiler.stores.dataset import open_dataset
from tiler.stores.directory import DirectoryStore
from tiler.stores.locate import open_store

BLANK = BlockAddress(0, 1, 2)
NO_BLOCKS = [
    "height.1",
    "height.1/0",
    "height.1/0/index",
    "height.1/9/index.bin",
    "height.1/00/index.bin",
    "height.1/0/x",
    "height.1/0/a/b",
]


class TestArchiveStore(StoreContract):
    """What does not lie in an archive is as in a directory."""

    def store(self, place: Path) -> ArchiveStore:
        return ArchiveStore(place)

    def set(self, place: Path, key: str, data: bytes) -> None:
        path = place / key
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)

    def get(self, place: Path, key: str) -> bytes:
        return (place / key).read_bytes()

    def left(self, place: Path) -> list[str]:
        return sorted(path.relative_to(place).as_posix() for path in place.rglob("*") if path.is_file())


@pytest.fixture
def manifest(tmp_path: Path) -> Manifest:
    """The manifest of ``loose``, a dataset of 2 x 29 blocks, of which ``sealed`` has the same in archives."""
    manifest = write_dataset(tmp_path / "loose", blank=[BLANK])
    (tmp_path / "sealed").mkdir()
    for name, layer in manifest.layers.items():
        write_archive(open_dataset(tmp_path / "loose"), name, tmp_path / f"sealed/{layer.path}.pmtiles")
    (tmp_path / "sealed" / MANIFEST_NAME).write_bytes(manifest.to_json())
    return manifest


@pytest.fixture
def loose(manifest: Manifest, tmp_path: Path) -> DirectoryStore:
    return DirectoryStore(tmp_path / "loose")


@pytest.fixture
def sealed(manifest: Manifest, tmp_path: Path) -> ArchiveStore:
    return ArchiveStore(tmp_path / "sealed")


def test_same_keys_and_bytes_as_a_directory(loose: DirectoryStore, sealed: ArchiveStore) -> None:
    keys = loose.keys("")
    assert len(keys) == 2 * 29 - 1 + 2 * 4 + 1
    assert sealed.keys("") == keys
    assert {key: sealed.read(key) for key in keys} == {key: loose.read(key) for key in keys}
    for prefix in ("height.1", "height.1/0", "height", "nothing", MANIFEST_NAME):
        assert sealed.keys(prefix) == loose.keys(prefix)


@pytest.mark.parametrize("key", NO_BLOCKS)
def test_what_is_no_block_is_not_there(sealed: ArchiveStore, key: str) -> None:
    with pytest.raises(NotFoundError):
        sealed.read(key)


@pytest.mark.parametrize("change", [("height-0", "imagery-0"), (".lerc", ".png"), ("/0/", "/1/"), ("-0-", "-0-0"), ("-0-2", "-0-")])
def test_names_must_be_those_of_the_layer(sealed: ArchiveStore, change: tuple[str, str]) -> None:
    key = sealed.keys("height.1/0")[0]
    with pytest.raises(NotFoundError, match="no such block"):
        sealed.read(key.replace(*change))


def test_a_blank_has_no_tile(sealed: ArchiveStore, manifest: Manifest) -> None:
    with pytest.raises(NotFoundError, match="no such block"):
        sealed.read(manifest.layer("height").block_key("height", BLANK))


@pytest.mark.parametrize(
    "key", ["height.1.pmtiles", "/x", "height.1/../manifest.json", "height.1/./0", "height.1/0/", ".tmp-height.1.pmtiles"]
)
def test_archives_and_hidden_files_are_no_keys(sealed: ArchiveStore, key: str) -> None:
    with pytest.raises(NotFoundError, match="is not a key"):
        sealed.read(key)


def test_what_is_archived_is_not_written_or_deleted_one_by_one(sealed: ArchiveStore) -> None:
    before = {key: sealed.read(key) for key in sealed.keys("")}
    key = sealed.keys("height.1")[0]
    changes: list[Callable[[], None]] = [
        lambda: sealed.write(key, b"x"),
        lambda: sealed.write("height.1/tasks/record", b"x"),
        lambda: sealed.delete([MANIFEST_NAME, key]),
        lambda: sealed.delete_prefix("height.1/0"),
    ]
    for change in changes:
        with pytest.raises(StorageError, match=r"lies in the archive height\.1\.pmtiles, which is written once; change the dataset"):
            change()
    with pytest.raises(NotFoundError, match="is not a key"):
        sealed.write("height.1.pmtiles", b"x")
    assert {key: sealed.read(key) for key in sealed.keys("")} == before


def test_a_layer_may_be_added_beside_archives(sealed: ArchiveStore, manifest: Manifest, tmp_path: Path) -> None:
    added = write_layer(tmp_path / "sealed", "light", "imagery", (9, 9), seed=7)
    publish(tmp_path / "sealed", {**manifest.layers, "light": added})
    dataset = open_dataset(tmp_path / "sealed")
    assert dataset.block("light", BlockAddress(0, 0, 0))
    assert dataset.block("height", BlockAddress(0, 0, 0))
    assert len(sealed.keys("light.7")) == 9 + 4 + 1 + 3


def test_deleting_a_layer_deletes_its_archive(sealed: ArchiveStore, loose: DirectoryStore, tmp_path: Path) -> None:
    unfinished(tmp_path / "sealed/height.1.pmtiles").write_bytes(b"half")
    key = sealed.keys("height.1")[0]
    sealed.read(key)
    sealed.delete_prefix("height.1")
    sealed.delete_prefix("height.1")
    assert sorted(path.name for path in (tmp_path / "sealed").iterdir()) == ["imagery.1001.pmtiles", MANIFEST_NAME]
    assert sealed.keys("") == [key for key in loose.keys("") if not key.startswith("height.1/")]
    sealed.write(key, b"loose now")
    assert sealed.read(key) == b"loose now"


def test_an_archive_that_is_replaced_is_opened_anew(sealed: ArchiveStore, tmp_path: Path) -> None:
    key = sealed.keys("height.1/0")[0]
    before = sealed.read(key)
    write_dataset(tmp_path / "other", seed=5)
    write_archive(open_dataset(tmp_path / "other"), "height", tmp_path / "sealed/height.1.pmtiles")
    assert sealed.read(key) == DirectoryStore(tmp_path / "other").read(key.replace("height.1", "height.5")) != before


def test_many_threads_read_one_archive(loose: DirectoryStore, sealed: ArchiveStore) -> None:
    keys = loose.keys("") * 20
    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(sealed.read, keys)) == [loose.read(key) for key in keys]


def test_a_folder_with_archives_is_recognised(sealed: ArchiveStore, tmp_path: Path) -> None:
    assert isinstance(open_store(tmp_path / "sealed"), ArchiveStore)
    assert isinstance(open_store(tmp_path / "loose"), DirectoryStore)
    assert isinstance(open_store(tmp_path / "sealed/height.1.pmtiles"), ArchiveFileStore)
    assert isinstance(open_store(tmp_path / "new.pmtiles"), DirectoryStore)


def test_a_folder_or_a_strange_file_in_the_place_of_an_archive(sealed: ArchiveStore, tmp_path: Path) -> None:
    (tmp_path / "sealed/light.pmtiles").mkdir()
    (tmp_path / "sealed/light.pmtiles/a").write_bytes(b"a")
    assert sealed.read("light.pmtiles/a") == b"a"
    (tmp_path / "sealed/strange.pmtiles").write_bytes(b"not an archive")
    with pytest.raises(InputError, match=r"strange\.pmtiles: has 14 bytes, too few"):
        sealed.read("strange/0/x")


def test_one_archive_alone_is_a_dataset_of_one_layer(loose: DirectoryStore, sealed: ArchiveStore, tmp_path: Path) -> None:
    path = tmp_path / "sealed/height.1.pmtiles"
    dataset = open_dataset(path)
    assert dataset.store.location == str(path)
    assert list(dataset.manifest.layers) == ["height"]
    layer = dataset.manifest.layer("height")
    assert layer.path == "height"
    wanted = {key.replace("height.1/", "height/"): loose.read(key) for key in loose.keys("height.1")}
    assert {key: dataset.store.read(key) for key in dataset.store.keys("height")} == wanted
    assert dataset.store.keys("") == [*sorted(wanted), MANIFEST_NAME]
    assert dataset.block("height", BLANK) is None
    with pytest.raises(NotFoundError):
        dataset.store.read("imagery/0/index.bin")


def test_one_archive_alone_cannot_be_written(sealed: ArchiveStore, tmp_path: Path) -> None:
    path = tmp_path / "sealed/height.1.pmtiles"
    before = path.read_bytes()
    store = ArchiveFileStore(path)
    for change in (lambda: store.write("a", b"x"), lambda: store.delete(["a"]), lambda: store.delete_prefix("height"), store.exclusive):
        with pytest.raises(StorageError, match="is an archive, which is written once"):
            change()
    store.sync()
    assert path.read_bytes() == before
