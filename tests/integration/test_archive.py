"""Layers as PMTiles files: judged by the reference reader and by the rules of the specification."""

import json
import random
import resource
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pmtiles.tile import TileType
from starlette.testclient import TestClient

from schemas.address import BlockAddress
from schemas.errors import InputError, StorageError, UsageError
from schemas.manifest import MANIFEST_NAME, digest, parse_manifest
from schemas.settings import ServerSettings
from server.app import create_app
from tests.integration.memory_datasets import MemoryStore, memory_dataset
from tests.integration.pmtiles_rules import check_rules, reader_gets
from tests.server.datasets import block_bytes, write_dataset
from tiler.archives.writing import write_archive
from tiler.stores.archive import unfinished
from tiler.stores.dataset import Dataset, open_dataset


def of_seed(seed: int) -> Any:
    return lambda address: block_bytes(seed, address)


def zoomed(dataset: Dataset, name: str) -> dict[tuple[int, int, int], bytes]:
    """All blocks of a layer by (z, x, y), as the format has it: level l of L is zoom L - 1 - l."""
    layer = dataset.manifest.layer(name)
    last = len(layer.levels) - 1
    every = [address for level in range(last + 1) for address in layer.lattice.addresses(level)]
    found = {(last - address.level, address.x, address.y): dataset.block(name, address) for address in every}
    return {place: data for place, data in found.items() if data is not None}


def test_the_reference_reader_gets_our_blocks(tmp_path: Path) -> None:
    dataset = memory_dataset((57, 101), lambda address: None if address.x == address.y else block_bytes(1, address))
    report = write_archive(dataset, "imagery", tmp_path / "a.pmtiles")
    facts = check_rules(tmp_path / "a.pmtiles")
    wanted = zoomed(dataset, "imagery")
    assert facts.tiles == wanted
    assert (report.tiles, report.contents, report.leaves) == (len(wanted), len(wanted), 0)
    assert report.file_bytes == (tmp_path / "a.pmtiles").stat().st_size
    assert facts.header["tile_type"] == TileType.JPEG
    assert facts.header["max_zoom"] == 5
    for (z, x, y), data in random.Random(0).sample(sorted(wanted.items()), 20):
        assert reader_gets(tmp_path / "a.pmtiles", z, x, y) == data
    assert reader_gets(tmp_path / "a.pmtiles", 5, 3, 3) is None


def test_fifty_thousand_tiles_need_leaf_directories(tmp_path: Path) -> None:
    dataset = memory_dataset((800, 770), of_seed(2))
    report = write_archive(dataset, "imagery", tmp_path / "a.pmtiles")
    facts = check_rules(tmp_path / "a.pmtiles")
    wanted = zoomed(dataset, "imagery")
    assert report.tiles == len(wanted) > 50_000
    assert facts.leaves == report.leaves == -(-len(wanted) // 4096)
    assert facts.tiles == wanted
    (z, x, y), data = random.Random(1).choice(sorted(wanted.items()))
    assert reader_gets(tmp_path / "a.pmtiles", z, x, y) == data
    alone = open_dataset(tmp_path / "a.pmtiles")
    for (z, x, y), data in random.Random(2).sample(sorted(wanted.items()), 500):
        assert alone.block("imagery", BlockAddress(facts.header["max_zoom"] - z, x, y)) == data


def test_identical_blocks_are_stored_once(tmp_path: Path) -> None:
    """Nine of ten blocks are one of three, of which two begin alike and two are of one length."""
    water = [b"water" * 60, b"water" * 59, b"ice!!" * 60]

    def content(address: BlockAddress) -> bytes:
        draw = random.Random(str(address)).randrange(30)
        return water[draw % 3] if draw < 27 else block_bytes(3, address)

    dataset = memory_dataset((200, 200), content)
    report = write_archive(dataset, "imagery", tmp_path / "a.pmtiles")
    facts = check_rules(tmp_path / "a.pmtiles")
    wanted = zoomed(dataset, "imagery")
    assert facts.tiles == wanted
    assert report.contents == facts.header["tile_contents_count"] == len(set(wanted.values()))
    assert report.entries < report.tiles, "no two neighbours on the curve became one entry"
    indexes = 32 * sum(level.columns * level.rows for level in dataset.manifest.layer("imagery").levels)
    assert facts.header["tile_data_length"] - indexes == sum(map(len, set(wanted.values())))


@settings(max_examples=25, deadline=None)
@given(
    size=st.tuples(st.integers(1, 30), st.integers(1, 30)),
    seed=st.integers(0, 99),
    kinds=st.integers(1, 6),
    blank=st.integers(0, 4),
)
def test_any_layer_comes_back(size: tuple[int, int], seed: int, kinds: int, blank: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Any shape, few or many different blocks, few or many blanks."""

    def content(address: BlockAddress) -> bytes | None:
        draw = random.Random(f"{seed} {address}").randrange(kinds + blank)
        return bytes([draw]) * (1 + draw // 2) if draw < kinds else None

    path = tmp_path_factory.mktemp("archive") / "a.pmtiles"
    dataset = memory_dataset(size, content)
    wanted = zoomed(dataset, "imagery")
    if not wanted:
        with pytest.raises(InputError, match="every block of layer 'imagery' is blank, and an archive cannot be empty"):
            write_archive(dataset, "imagery", path)
        assert list(path.parent.iterdir()) == []
        return
    write_archive(dataset, "imagery", path)
    assert check_rules(path).tiles == wanted
    assert zoomed(open_dataset(path), "imagery") == wanted


def test_one_file_is_all_of_a_layer(tmp_path: Path) -> None:
    """Read by the text of docs/FORMAT.md alone: the manifest in the metadata, the indexes behind the tiles."""
    dataset = memory_dataset((57, 101), of_seed(4), kind="height")
    write_archive(dataset, "height", tmp_path / "a.pmtiles")
    facts = check_rules(tmp_path / "a.pmtiles")
    assert facts.header["tile_type"] == TileType.UNKNOWN
    assert facts.metadata["name"] == "height"
    assert "not of web mercator" in facts.metadata["description"]
    ours = facts.metadata["clipmap"]
    assert ours["web_mercator"] is False
    manifest = parse_manifest(json.dumps(ours["manifest"]).encode(), "metadata")
    assert manifest.version == facts.metadata["version"]
    layer, original = manifest.layer("height"), dataset.manifest.layer("height")
    assert layer.levels == original.levels
    assert (layer.block, layer.pad, layer.codec, layer.transform) == (original.block, original.pad, original.codec, original.transform)
    data = (tmp_path / "a.pmtiles").read_bytes()
    for level, offset in zip(layer.levels, ours["indexes"], strict=True):
        begin = facts.header["tile_data_offset"] + offset
        assert digest(data[begin : begin + 32 * level.columns * level.rows]) == level.index


@pytest.mark.parametrize(
    ("media_type", "tile_type"),
    [
        ("image/png", TileType.PNG),
        ("image/webp", TileType.WEBP),
        ("image/jpeg", TileType.JPEG),
        ("application/octet-stream", TileType.UNKNOWN),
    ],
)
def test_tile_types(media_type: str, tile_type: TileType, tmp_path: Path) -> None:
    write_archive(memory_dataset((9, 9), of_seed(5), media_type=media_type), "imagery", tmp_path / "a.pmtiles")
    assert check_rules(tmp_path / "a.pmtiles").header["tile_type"] == tile_type


@pytest.mark.parametrize(
    ("crs", "transform", "bounds", "centre"),
    [
        ("EPSG:4326", (0.1, 0, 10, 0, -0.1, 50), (10, 47.6, 14.8, 50), (12.4, 48.8)),
        ("EPSG:4326", (0.1, 0, 178, 0, -0.1, 50), (-180, 47.6, 180, 50), (-179.6, 48.8)),
        ("EPSG:4326", (0.1, 0, 176, 0, -0.1, 50), (-180, 47.6, 180, 50), (178.4, 48.8)),
        (None, (0.1, 0, 10, 0, -0.1, 50), (-180, -90, 180, 90), (0, 0)),
    ],
)
def test_bounds_and_centre(crs: str | None, transform: tuple[float, ...], bounds: tuple[float, ...], centre: Any, tmp_path: Path) -> None:
    """48 x 24 samples; what crosses the antimeridian has no bounds in this format, but a centre."""
    write_archive(memory_dataset((48, 24), of_seed(6), crs=crs, transform=transform), "imagery", tmp_path / "a.pmtiles")
    header = check_rules(tmp_path / "a.pmtiles").header
    found = [header[f"{name}_e7"] / 1e7 for name in ("min_lon", "min_lat", "max_lon", "max_lat", "center_lon", "center_lat")]
    assert found == pytest.approx([*bounds, *centre], abs=1e-6)


@pytest.mark.parametrize(("off_m", "true"), [(0.0, True), (1.0, True), (50_000.0, False)])
def test_web_mercator_is_recognised(off_m: float, true: bool, tmp_path: Path) -> None:
    """64 x 64 samples in blocks of 4 over the whole square: a sample is 626 km."""
    half = 20037508.342789244
    dataset = memory_dataset((64, 64), of_seed(7), crs="EPSG:3857", transform=(half / 32, 0, -half + off_m, 0, -half / 32, half))
    write_archive(dataset, "imagery", tmp_path / "a.pmtiles")
    metadata = check_rules(tmp_path / "a.pmtiles").metadata
    assert metadata["clipmap"]["web_mercator"] is true
    assert ("not of web mercator" in metadata["description"]) is not true


def test_same_layer_same_bytes(tmp_path: Path) -> None:
    """Whatever the workers, the store and the path of the layer."""
    write_dataset(tmp_path / "dataset", seed=3)
    for name, workers in (("a", 1), ("b", 4)):
        write_archive(open_dataset(tmp_path / "dataset"), "imagery", tmp_path / f"{name}.pmtiles", workers=workers)
    write_archive(open_dataset(tmp_path / "a.pmtiles"), "imagery", tmp_path / "c.pmtiles")
    assert (tmp_path / "a.pmtiles").read_bytes() == (tmp_path / "b.pmtiles").read_bytes() == (tmp_path / "c.pmtiles").read_bytes()


@pytest.mark.parametrize("resumable", [False, True])
def test_a_damaged_block_stops_it(resumable: bool, tmp_path: Path) -> None:
    dataset = memory_dataset((57, 101), of_seed(8))
    key = dataset.manifest.layer("imagery").block_key("imagery", BlockAddress(1, 2, 3))
    assert isinstance(dataset.store, MemoryStore)
    intact = dataset.store.entries[key]
    (tmp_path / "a.pmtiles").write_bytes(b"old")
    flipped = intact[:-1] + bytes([intact[-1] ^ 1])
    for damaged, what in ((intact[:-1], "has .* bytes, the index says"), (flipped, "differs from the digest")):
        dataset.store.entries[key] = damaged
        with pytest.raises(InputError, match=rf"memory/{key}: {what}.*, so nothing was published; "):
            write_archive(dataset, "imagery", tmp_path / "a.pmtiles", resumable=resumable)
        assert (tmp_path / "a.pmtiles").read_bytes() == b"old"
        assert unfinished(tmp_path / "a.pmtiles").exists() == resumable
    dataset.store.entries[key], dataset.store.reads = intact, 0
    report = write_archive(dataset, "imagery", tmp_path / "a.pmtiles")
    assert (report.reused > 0) == resumable
    assert dataset.store.reads == report.tiles - report.reused + 6
    assert check_rules(tmp_path / "a.pmtiles").tiles == zoomed(dataset, "imagery")
    assert [path.name for path in tmp_path.iterdir()] == ["a.pmtiles"]


def test_equal_digests_are_not_taken_for_equal_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A digest function that is made to collide stands in for luck or malice."""
    import tests.integration.memory_datasets as made
    import tiler.checking.contents

    same = digest(b"")
    with monkeypatch.context() as patch:
        patch.setattr(made, "digest", lambda data: same if len(data) == 5 else digest(data))
        patch.setattr(tiler.checking.contents, "digest", lambda data: same if len(data) == 5 else digest(data))
        dataset = memory_dataset((16, 4), lambda address: b"left!" if address.x else b"right")
        with pytest.raises(InputError, match="has the digest of another block, but not its bytes"):
            write_archive(dataset, "imagery", tmp_path / "a.pmtiles")
    assert list(tmp_path.iterdir()) == []


def test_where_it_cannot_be_written(tmp_path: Path) -> None:
    dataset = memory_dataset((9, 9), of_seed(9))
    with pytest.raises(StorageError, match=r"none/a\.pmtiles: cannot be written: No such file or directory$"):
        write_archive(dataset, "imagery", tmp_path / "none/a.pmtiles")
    (tmp_path / "a.pmtiles").mkdir()
    with pytest.raises(StorageError, match=r"a\.pmtiles: cannot be written: Is a directory$"):
        write_archive(dataset, "imagery", tmp_path / "a.pmtiles")
    assert [path.name for path in tmp_path.iterdir()] == ["a.pmtiles"]
    deep = memory_dataset((4, 4), of_seed(9))
    levels = deep.manifest.layer("imagery").levels * 33
    deep.manifest.layers["imagery"] = deep.manifest.layer("imagery").model_copy(update={"levels": levels})
    with pytest.raises(UsageError, match="has 33 levels, and a PMTiles archive holds 32 at most"):
        write_archive(deep, "imagery", tmp_path / "b.pmtiles")


def test_a_full_disk_is_a_sentence_and_leaves_nothing(tmp_path: Path) -> None:
    """The limit on file sizes stands in for the end of the disk; it is met before a block is read."""
    dataset = memory_dataset((57, 101), of_seed(10))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (65536, hard))
    try:
        with pytest.raises(StorageError, match=r"a\.pmtiles: cannot be written: File too large$"):
            write_archive(dataset, "imagery", tmp_path / "a.pmtiles", resumable=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(tmp_path.iterdir()) == []


def test_one_writer_at_a_time(tmp_path: Path) -> None:
    dataset = memory_dataset((57, 101), of_seed(11))
    refused = []

    def write_another(done: int, total: int) -> None:
        with pytest.raises(StorageError, match=r"a\.pmtiles: another process is writing it; wait until it has ended"):
            write_archive(dataset, "imagery", tmp_path / "a.pmtiles")
        refused.append(done)

    write_archive(dataset, "imagery", tmp_path / "a.pmtiles", write_another)
    assert len(refused) > 1
    assert check_rules(tmp_path / "a.pmtiles").tiles == zoomed(dataset, "imagery")
    assert [path.name for path in tmp_path.iterdir()] == ["a.pmtiles"]


def test_a_server_hands_out_blocks_of_an_archive(tmp_path: Path) -> None:
    manifest = write_dataset(tmp_path / "loose", blank=[BlockAddress(0, 1, 2)])
    (tmp_path / "served/alps").mkdir(parents=True)
    for name, layer in manifest.layers.items():
        write_archive(open_dataset(tmp_path / "loose"), name, tmp_path / f"served/alps/{layer.path}.pmtiles")
    (tmp_path / "served/alps" / MANIFEST_NAME).write_bytes(manifest.to_json())
    with TestClient(create_app(ServerSettings(roots=(tmp_path / "served",)))) as client:
        for address in manifest.layer("height").lattice.addresses(0):
            answer = client.get(f"/alps/height/{address}")
            wanted = b"" if address == BlockAddress(0, 1, 2) else block_bytes(1, address)
            assert (answer.status_code, answer.content) == (200 if wanted else 204, wanted)
            assert not wanted or answer.headers["etag"] == f'"{digest(wanted)}"'
        assert client.get("/alps/imagery/0/4/3").content == block_bytes(1001, BlockAddress(0, 4, 3))
        assert client.get("/alps/imagery/0/5/0").status_code == 404
