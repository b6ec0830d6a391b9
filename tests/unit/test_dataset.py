import json
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from schemas.address import BlockAddress
from schemas.blockindex import RECORD_BYTES
from schemas.errors import InputError, NotFoundError
from schemas.lattice import Lattice
from schemas.manifest import FORMAT_VERSION, Manifest, digest
from tests.server.datasets import block_bytes, publish, write_dataset, write_layer
from tiler.stores.dataset import Dataset, open_dataset
from tiler.stores.directory import DirectoryStore

BLANK = BlockAddress(0, 4, 3)
ADDRESS = BlockAddress(0, 2, 1)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "alps"


@pytest.fixture
def manifest(folder: Path) -> Manifest:
    return write_dataset(folder, blank=[BLANK])


def test_every_block_of_every_level(folder: Path, manifest: Manifest) -> None:
    dataset = open_dataset(folder)
    assert dataset.manifest == manifest
    lattice = Lattice(19, 13, 4)
    for name, seed in (("height", 1), ("imagery", 1001)):
        for address in (address for level in range(lattice.levels) for address in lattice.addresses(level)):
            expected = None if (name, address) == ("height", BLANK) else block_bytes(seed, address)
            assert dataset.block(name, address) == expected
            record = dataset.record(name, address)
            assert (record.blank, record.length_bytes) == (expected is None, len(expected or b""))
            assert record.digest == (digest(expected) if expected else "")


def test_what_is_not_there(folder: Path, manifest: Manifest) -> None:
    dataset = open_dataset(folder)
    for read in (dataset.block, dataset.record):
        with pytest.raises(NotFoundError, match="no layer 'light' in the dataset; it has height, imagery"):
            read("light", ADDRESS)
        for address in (
            BlockAddress(0, 5, 0),
            BlockAddress(0, 0, 4),
            BlockAddress(3, 1, 0),
            BlockAddress(4, 0, 0),
            BlockAddress(0, 2**80, 0),
        ):
            with pytest.raises(NotFoundError, match=r"outside level|does not exist"):
                read("height", address)
    with pytest.raises(NotFoundError):
        dataset.index("height", 4)


def test_the_index_is_read_once_and_blank_blocks_never(folder: Path, manifest: Manifest) -> None:
    reads: list[str] = []

    class CountingStore(DirectoryStore):
        def read(self, key: str) -> bytes:
            reads.append(key)
            return super().read(key)

    dataset = Dataset(CountingStore(folder), manifest)
    for _ in range(3):
        dataset.block("height", BLANK)
        dataset.record("height", ADDRESS)
    assert reads == [manifest.layer("height").index_key(0)]
    dataset.block("height", ADDRESS)
    assert reads[1:] == [manifest.layer("height").block_key("height", ADDRESS)]


def test_many_threads_share_one_index(folder: Path, manifest: Manifest) -> None:
    dataset = open_dataset(folder)
    with ThreadPoolExecutor(8) as pool:
        assert len({id(index) for index in pool.map(lambda _: dataset.index("height", 0), range(64))}) == 1


def test_a_held_dataset_keeps_its_version(folder: Path, manifest: Manifest) -> None:
    dataset = open_dataset(folder)
    rebuilt = write_dataset(folder, seed=2)
    assert dataset.manifest.version == manifest.version != rebuilt.version
    assert dataset.block("height", ADDRESS) == block_bytes(1, ADDRESS)
    assert open_dataset(folder).block("height", ADDRESS) == block_bytes(2, ADDRESS)


@pytest.mark.parametrize("damage", ["one byte changed", "last byte gone", "one record more", "empty"])
def test_a_damaged_index(folder: Path, manifest: Manifest, damage: str) -> None:
    path = folder / manifest.layer("height").index_key(0)
    data = path.read_bytes()
    damaged = {
        "one byte changed": data[:7] + bytes([data[7] ^ 1]) + data[8:],
        "last byte gone": data[:-1],
        "one record more": data + bytes(RECORD_BYTES),
        "empty": b"",
    }
    path.write_bytes(damaged[damage])
    dataset = open_dataset(folder)
    for _ in range(2):
        with pytest.raises(InputError, match=r"height\.1/0/index\.bin: differs from what the manifest says; .* rebuild the layer$"):
            dataset.record("height", ADDRESS)
    assert dataset.block("height", BlockAddress(1, 0, 0)) == block_bytes(1, BlockAddress(1, 0, 0))


def test_an_index_of_the_wrong_size_is_refused_although_its_digest_is_right(folder: Path) -> None:
    layer = write_layer(folder, "height", "height", (19, 13), seed=1)
    path = folder / layer.index_key(0)
    path.write_bytes(path.read_bytes() + bytes(RECORD_BYTES))
    changed = layer.levels[0].model_copy(update={"index": digest(path.read_bytes())})
    publish(folder, {"height": layer.model_copy(update={"levels": [changed, *layer.levels[1:]]})})
    with pytest.raises(InputError, match=r"index\.bin: has 672 bytes instead of 640 \(20 blocks\); rebuild the layer$"):
        open_dataset(folder).record("height", ADDRESS)


def test_a_missing_index(folder: Path, manifest: Manifest) -> None:
    (folder / manifest.layer("height").index_key(0)).unlink()
    with pytest.raises(NotFoundError, match=r"height\.1/0/index\.bin: no such"):
        open_dataset(folder).record("height", ADDRESS)


@pytest.mark.parametrize("change_bytes", [-1, 1])
def test_a_block_of_the_wrong_length_is_never_passed_on(folder: Path, manifest: Manifest, change_bytes: int) -> None:
    path = folder / manifest.layer("height").block_key("height", ADDRESS)
    length = path.stat().st_size
    with open(path, "r+b") as file:
        file.truncate(length + change_bytes)
    with pytest.raises(InputError, match=rf"{path.name}: has {length + change_bytes} bytes instead of {length}; the block is damaged$"):
        open_dataset(folder).block("height", ADDRESS)


def test_a_missing_block(folder: Path, manifest: Manifest) -> None:
    path = folder / manifest.layer("height").block_key("height", ADDRESS)
    path.unlink()
    with pytest.raises(NotFoundError, match=path.name):
        open_dataset(folder).block("height", ADDRESS)


def test_no_dataset(folder: Path) -> None:
    with pytest.raises(NotFoundError, match=r"alps: no dataset there \(no manifest\.json\)$"):
        open_dataset(folder)
    folder.mkdir()
    with pytest.raises(NotFoundError, match="no dataset there"):
        open_dataset(folder)
    (folder / "height").mkdir()
    with pytest.raises(NotFoundError, match="not a dataset, or its build has not finished"):
        open_dataset(folder)
    (folder / "file").write_bytes(b"")
    with pytest.raises(NotFoundError, match="no dataset there"):
        open_dataset(folder / "file")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a manifest: "),
        (b'{"format": "clipmap"', "not a manifest: "),
        (b"\xff\xfe\x00", "not a manifest: "),
        (b"[1, 2]", "not a clipmap manifest"),
        (b'{"format": "zarr"}', "not a clipmap manifest"),
        (b'{"format": "clipmap"}', "no whole number as 'format_version'"),
        (b'{"format": "clipmap", "format_version": 1}', "generator: Field required"),
    ],
)
def test_a_manifest_that_cannot_be_understood(folder: Path, content: bytes, message: str) -> None:
    folder.mkdir()
    (folder / "manifest.json").write_bytes(content)
    with pytest.raises(InputError) as caught:
        open_dataset(folder)
    assert str(caught.value).startswith(f"{folder / 'manifest.json'}: {message}")
    assert "\n" not in str(caught.value)


def test_a_newer_format_is_refused_whatever_else_it_holds(folder: Path) -> None:
    folder.mkdir()
    (folder / "manifest.json").write_text(json.dumps({"format": "clipmap", "format_version": FORMAT_VERSION + 1, "unheard": "of"}))
    with pytest.raises(InputError, match=rf"format version {FORMAT_VERSION + 1} is newer than this clipmap reads .*; upgrade clipmap$"):
        open_dataset(folder)


def test_an_edited_manifest_is_refused(folder: Path, manifest: Manifest) -> None:
    path = folder / "manifest.json"
    content = json.loads(path.read_bytes())
    content["layers"]["height"]["levels"][0]["index"] = "0" * 32
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"version does not match the content; the file was edited or damaged$"):
        open_dataset(folder)


def test_deep_nesting_is_no_way_to_crash_a_reader(folder: Path) -> None:
    folder.mkdir()
    (folder / "manifest.json").write_bytes(b"[" * 200_000)
    with pytest.raises(InputError, match="not a manifest"):
        open_dataset(folder)


def test_a_path_with_characters_that_are_no_text(tmp_path: Path) -> None:
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff"))
    write_dataset(folder)
    assert open_dataset(folder).block("height", ADDRESS) == block_bytes(1, ADDRESS)
