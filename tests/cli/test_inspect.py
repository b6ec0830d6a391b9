"""``clipmap inspect``: what it prints, and how it fails."""

import json
import re
import shutil
from pathlib import Path

import pytest

from tests.cli.conftest import Clipmap, Golden
from tiler.stores.dataset import open_dataset

TARGETS = {
    "dataset": (),
    "layer": ("height",),
    "level": ("height/0",),
    "level-of-imagery": ("imagery/0",),
    "block": ("height/0/1/1",),
    "blank-block": ("height/0/3/2",),
    "block-by-name": ("imagery-0-21.raw",),
    "root-block": ("imagery/2/0/0",),
}


def steady(text: str, folder: Path) -> str:
    """``text`` without the path, the program's version and digests."""
    text = text.replace(str(folder), "DATASET")
    text = re.sub(r"clipmap \d[^\"]*", "clipmap VERSION", text)
    return re.sub(r"\b[0-9a-f]{32}\b", "DIGEST", text)


@pytest.mark.parametrize("name", TARGETS)
def test_tables(name: str, survey: Path, clipmap: Clipmap, golden: Golden) -> None:
    ran = clipmap("inspect", survey, *TARGETS[name])
    assert (ran.code, ran.err) == (0, "")
    golden(f"inspect-{name}.txt", steady(ran.out, survey))


@pytest.mark.parametrize("name", TARGETS)
def test_json_says_the_same(name: str, survey: Path, clipmap: Clipmap, golden: Golden) -> None:
    ran = clipmap("inspect", survey, *TARGETS[name], "--json")
    assert (ran.code, ran.err) == (0, "")
    json.loads(ran.out)
    golden(f"inspect-{name}.json", steady(ran.out, survey))


def test_what_the_tables_claim_is_true(survey: Path, clipmap: Clipmap) -> None:
    """The plane 1000 + 2 x - y of 200 x 150 vertices, of which 50 x 50 are void, at 30 m in UTM; its pixels' centres are the vertices."""
    facts = json.loads(clipmap("inspect", survey, "height", "--json").out)
    assert facts["statistics"] == {"min": [851.0], "max": [1398.0], "mean": [pytest.approx(30673750 / 27500)], "valid": 27500}
    assert facts["extent"] == [400015, 5195515, 405985, 5199985]
    assert facts["valid_share"] == pytest.approx(27500 / 30000)
    block = json.loads(clipmap("inspect", survey, "height/0/1/1", "--json").out)
    assert (block["min"], block["max"], block["valid"]) == (1000 + 2 * 64 - 127, 1000 + 2 * 127 - 64, 4096)
    assert block["stored_bytes"] == 64 * 64 * 4


def test_blocks_by_address_and_by_name_are_the_same(survey: Path, clipmap: Clipmap) -> None:
    lattice = open_dataset(survey).manifest.layer("height").lattice
    for level in range(lattice.levels):
        for address in lattice.addresses(level):
            by_address = clipmap("inspect", survey, f"height/{address}", "--json")
            assert clipmap("inspect", survey, json.loads(by_address.out)["name"], "--json") == by_address


@pytest.mark.parametrize("damage", ["flipped", "shorter", "gone"])
def test_a_damaged_block_is_reported(damage: str, survey: Path, tmp_path: Path, clipmap: Clipmap) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(survey, copy)
    path = copy / json.loads(clipmap("inspect", copy, "height/0/1/1", "--json").out)["key"]
    data = path.read_bytes()
    if damage == "gone":
        path.unlink()
    else:
        path.write_bytes(data[:-1] if damage == "shorter" else bytes([data[0] ^ 1]) + data[1:])
    ran = clipmap("inspect", copy, "height/0/1/1")
    assert ran.code == 1
    assert re.search(r"^intact +no$", ran.out, re.MULTILINE)
    assert not json.loads(clipmap("inspect", copy, "height/0/1/1", "--json").out)["intact"]
    assert clipmap("inspect", copy, "height/0/0/0").code == 0


@pytest.mark.parametrize(
    ("target", "code", "sentence"),
    [
        ("relief", 3, "no layer 'relief' in the dataset; it has height, imagery"),
        ("height/3", 3, "level 3 does not exist: levels run from 0 to 2"),
        ("height/3/0/0", 3, "level 3 does not exist"),
        ("height/0/4/0", 3, "block 0/4/0 lies outside level 0, which has 4 x 3 blocks"),
        ("height/0/0", 2, "expected LAYER, LAYER/LEVEL, LAYER/LEVEL/X/Y or the name of a block"),
        ("height/0/0/0/0", 2, "expected LAYER"),
        ("height/x", 2, "expected LAYER"),
        ("height/", 2, "expected LAYER"),
        ("height/-1", 2, "expected LAYER"),
        ("height/²", 2, "expected LAYER"),
        ("height/" + "1" * 5000, 2, "expected LAYER"),
        ("height/0/" + "9" * 19 + "/0", 3, "lies outside level 0"),
        ("/0", 2, ""),
        ("", 3, "no layer ''"),
        ("height-0-21.lerc", 3, "its blocks are called like height-0-22.raw"),
        ("height-0-2.raw", 3, "layer 'height' has 3 levels"),
        ("height-0-45.raw", None, ""),
        ("nonsense.raw", None, ""),
        ("../../etc/passwd", None, ""),
    ],
)
def test_wrong_targets(target: str, code: int | None, sentence: str, survey: Path, clipmap: Clipmap) -> None:
    ran = clipmap("inspect", survey, target)
    assert ran.code in ((2, 3) if code is None else (code, 3) if target == "/0" else (code,))
    assert ran.out == ""
    assert ran.err.startswith("clipmap: ")
    assert ran.err.count("\n") == 1
    assert sentence in ran.err


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (None, "no dataset there (no manifest.json)"),
        ({}, "no dataset there (no manifest.json)"),
        ({"notes.txt": b"x"}, "no manifest.json: not a dataset, or its build has not finished"),
        ({"manifest.json": b""}, "not a manifest"),
        ({"manifest.json": b"{}"}, "not a clipmap manifest"),
        ({"manifest.json": b"[" * 100_000}, "not a manifest"),
        ({"manifest.json": b'{"format": "clipmap", "format_version": 99}'}, "upgrade clipmap"),
        ({"manifest.json": b'{"format": "clipmap", "format_version": 1}'}, "Field required"),
    ],
)
def test_what_is_no_dataset(content: dict[str, bytes] | None, sentence: str, tmp_path: Path, clipmap: Clipmap) -> None:
    folder = tmp_path / "folder"
    if content is not None:
        folder.mkdir()
        for name, data in content.items():
            (folder / name).write_bytes(data)
    ran = clipmap("inspect", folder)
    assert (ran.code, ran.out) == (3, "")
    assert ran.err.startswith("clipmap: ")
    assert ran.err.count("\n") == 1
    assert sentence in ran.err


def test_a_file_is_no_dataset(tmp_path: Path, clipmap: Clipmap) -> None:
    (tmp_path / "file").write_bytes(b"x")
    ran = clipmap("inspect", tmp_path / "file")
    assert (ran.code, ran.err) == (3, f"clipmap: {tmp_path}/file: no dataset there (no manifest.json)\n")


@pytest.mark.parametrize(("change", "sentence"), [("flip", "differs from what the manifest says"), ("gone", "no such block or file")])
def test_a_damaged_index(change: str, sentence: str, survey: Path, tmp_path: Path, clipmap: Clipmap) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(survey, copy)
    path = copy / "height" / "0" / "index.bin"
    if change == "gone":
        path.unlink()
    else:
        path.write_bytes(bytes([path.read_bytes()[0] ^ 1]) + path.read_bytes()[1:])
    assert clipmap("inspect", copy).code == 0
    for target in ("height/0", "height/0/0/0"):
        ran = clipmap("inspect", copy, target)
        assert ran.code == 3
        assert ran.err.count("\n") == 1
        assert sentence in ran.err
