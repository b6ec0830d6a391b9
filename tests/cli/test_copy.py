"""``clipmap copy`` as a user meets it."""

import json
from pathlib import Path

import pytest
from pmtiles.tile import deserialize_header

from cli.stored_source import open_block_source
from schemas.address import BlockAddress
from schemas.errors import InputError
from schemas.manifest import MANIFEST_NAME
from tests.cli.conftest import Clipmap
from tests.s3 import S3Server
from tiler.checking.diff import diff
from tiler.stores.dataset import open_dataset
from viewer.source import DirectorySource


def test_into_archives_and_back(clipmap: Clipmap, survey: Path, tmp_path: Path) -> None:
    ran = clipmap("copy", survey, tmp_path / "archives", "--store", "archive")
    assert (ran.code, ran.err) == (0, "")
    assert [line.split()[0] for line in ran.out.splitlines()] == ["dataset", "layers", "blocks", "written", "time"]
    assert sorted(path.name for path in (tmp_path / "archives").iterdir()) == ["height.pmtiles", "imagery.pmtiles", MANIFEST_NAME]
    ran = clipmap("copy", tmp_path / "archives", tmp_path / "back", "--json")
    report = json.loads(ran.out)
    assert (report["blocks"], report["blocks_already_there"], report["layers"]) == (report["blocks"], 0, ["height", "imagery"])
    for place in ("archives", "back"):
        ran = clipmap("diff", survey, tmp_path / place)
        assert (ran.code, "are the same" in ran.out) == (0, True)
        assert clipmap("verify", tmp_path / place).code == 0
        assert json.loads(clipmap("inspect", tmp_path / place, "--json").out)["version"] == report["version"]


def test_one_file_is_inspected_and_viewed_alone(clipmap: Clipmap, survey: Path, tmp_path: Path) -> None:
    clipmap("copy", survey, tmp_path / "archives", "--store", "archive", "--layer", "height")
    file = tmp_path / "archives/height.pmtiles"
    assert clipmap("verify", file, "--seams").code == 0
    ran = clipmap("inspect", file, "height/0/1/1", "--json")
    assert (ran.code, json.loads(ran.out)["intact"]) == (0, True)
    ran = clipmap("build", survey.parent / "none.tif", "-o", file)
    assert ran.code != 0
    assert ran.err.count("\n") == 1


def test_the_viewer_is_given_the_same_blocks(clipmap: Clipmap, survey: Path, tmp_path: Path) -> None:
    place = tmp_path / "archives"
    clipmap("copy", survey, place, "--store", "archive")
    folder, archives, alone = (open_block_source(str(path), 2) for path in (survey, place, place / "height.pmtiles"))
    assert isinstance(folder, DirectorySource)
    lattice = folder.manifest.layer("height").lattice
    for address in (address for level in range(lattice.levels) for address in lattice.addresses(level)):
        assert folder.read("height", address) == archives.read("height", address) == alone.read("height", address)
    file = place / "height.pmtiles"
    data = bytearray(file.read_bytes())
    header = deserialize_header(data[:127])
    data[header["tile_data_offset"]] ^= 1
    file.write_bytes(data)
    root = BlockAddress(lattice.levels - 1, 0, 0)
    with pytest.raises(InputError, match=r"block 2/0/0 of 'height' differs from its digest"):
        archives.read("height", root)
    clipmap("copy", survey, place, "--store", "archive", "--layer", "imagery", "--overwrite")
    with pytest.raises(InputError, match="was rebuilt meanwhile"):
        archives.read("height", root)
    for source in (folder, archives, alone):
        source.close()


def test_a_repeated_copy_has_nothing_to_do(clipmap: Clipmap, survey: Path, tmp_path: Path) -> None:
    for form in ("directory", "archive"):
        first, again = (json.loads(clipmap("copy", survey, tmp_path / form, "--store", form, "--json").out) for _ in range(2))
        assert (first["blocks_already_there"], first["written_bytes"] > 0) == (0, True)
        assert (again["blocks_already_there"], again["written_bytes"]) == (first["blocks"], 0)


def test_a_damaged_block_is_named(clipmap: Clipmap, survey: Path, tmp_path: Path) -> None:
    clipmap("copy", survey, tmp_path / "damaged")
    block = next((tmp_path / "damaged/height/1").glob("*.raw"))
    data = block.read_bytes()
    block.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    for form in ("directory", "archive"):
        ran = clipmap("copy", tmp_path / "damaged", tmp_path / form, "--store", form)
        assert ran.code == 3
        sentence, note = ran.err.splitlines()
        assert sentence.startswith(f"clipmap: {block}: differs from the digest in the index, so nothing was published; ")
        assert note.startswith(f"note: what was copied is kept in {tmp_path / form}")
        assert clipmap("inspect", tmp_path / form).code == 3


def test_mistakes_are_sentences(clipmap: Clipmap, survey: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/file").touch()
    cases: list[tuple[list[object], int, str]] = [
        ([tmp_path / "none", tmp_path / "copy"], 3, "no dataset there"),
        ([survey, survey], 2, "is the dataset to be copied"),
        ([survey, tmp_path / "mine"], 2, "not empty (it holds file)"),
        ([survey, tmp_path / "mine/file"], 4, "a file is in the way"),
        ([survey, tmp_path / "copy", "--layer", "light"], 3, "no layer 'light'"),
        ([survey, tmp_path / "copy.pmtiles"], 2, "clipmap export"),
        ([survey, "s3://bucket/copy", "--store", "archive"], 2, "archives are written into a folder"),
        ([survey, "ftp://host/copy"], 2, "ftp://host/copy"),
    ]
    for arguments, code, sentence in cases:
        ran = clipmap("copy", *arguments)
        assert (ran.code, ran.out) == (code, "")
        assert ran.err.startswith("clipmap: ")
        assert sentence in ran.err
        assert ran.err.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine"]


def test_through_an_object_store(clipmap: Clipmap, survey: Path, tmp_path: Path, s3: S3Server) -> None:
    """Folder, bucket, archives; a copy into the bucket that has a damaged block there restores it."""
    url = s3.url(tmp_path / "bucket")
    first = json.loads(clipmap("copy", survey, url, "--json").out)
    assert s3.names(tmp_path / "bucket") == sorted(
        path.relative_to(survey).as_posix() for path in survey.rglob("*") if path.is_file() and "tasks" not in path.parts
    )
    assert diff(open_dataset(survey), open_dataset(url)).same
    name = next(name for name in s3.names(tmp_path / "bucket") if name.startswith("imagery/0/"))
    s3.put(tmp_path / "bucket", name, b"damaged")
    ran = clipmap("copy", url, tmp_path / "archives", "--store", "archive")
    assert (ran.code, f"{url}/{name}: has 7 bytes" in ran.err) == (3, True)
    again = json.loads(clipmap("copy", survey, url, "--json").out)
    assert again["blocks_already_there"] == first["blocks"] - 1
    assert clipmap("copy", url, tmp_path / "archives", "--store", "archive").code == 0
    assert clipmap("diff", survey, tmp_path / "archives").code == 0
