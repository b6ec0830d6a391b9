"""``clipmap verify``: one line per finding, one summary if there is none, and its exit status."""

import shutil
from pathlib import Path

import pytest

from schemas.address import BlockAddress
from schemas.settings import BuildSettings
from tests.cli.conftest import Clipmap, Golden, Sources
from tests.cli.reports import parsed
from tests.unit.tampering import block_path, change_samples
from tiler.building.build import build_layer


@pytest.fixture
def copy(survey: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(survey, tmp_path / "copy"))


@pytest.fixture
def padded(sources: Sources, tmp_path: Path) -> Path:
    """Both layers with a pad, heights lossless, the picture as JPEG."""
    build_layer(sources.dem, tmp_path / "padded", BuildSettings(block=64, pad=2, codec="raw", workers=1))
    build_layer(sources.photo, tmp_path / "padded", BuildSettings(block=64, pad=2, codec="jpeg:50", workers=1))
    return tmp_path / "padded"


def damage(folder: Path) -> None:
    """One fault of every common kind."""
    path = block_path(folder, "height", BlockAddress(0, 1, 1))
    data = path.read_bytes()
    path.write_bytes(data[:99] + bytes([data[99] ^ 1]) + data[100:])
    path = block_path(folder, "height", BlockAddress(0, 2, 0))
    path.write_bytes(path.read_bytes()[:-1])
    block_path(folder, "imagery", BlockAddress(1, 0, 0)).unlink()
    (folder / "imagery" / "notes.txt").write_bytes(b"x")
    index = folder / "height" / "1" / "index.bin"
    index.write_bytes(index.read_bytes()[:-1])


def test_nothing_wrong_is_one_line(survey: Path, clipmap: Clipmap) -> None:
    ran = clipmap("verify", survey)
    assert (ran.code, ran.err) == (0, "")
    assert ran.out == f"{survey}: nothing wrong in 34 blocks of height, imagery, 465.0 KiB, decoded\n"
    assert clipmap("verify", survey, "--quick", "--layer", "height").out == (
        f"{survey}: nothing wrong in 17 blocks of height, 261.0 KiB, digests only\n"
    )


def test_every_finding_is_one_line(copy: Path, clipmap: Clipmap, golden: Golden) -> None:
    damage(copy)
    ran = clipmap("verify", copy)
    assert ran.code == 1
    golden("verify-damaged.txt", ran.out)
    assert ran.err == f"{copy}: 5 findings; checked 30 blocks of height, imagery, 355.5 KiB, decoded\n"
    assert clipmap("verify", copy, "--quick").out == ran.out
    ran = clipmap("verify", copy, "--layer", "imagery", "--layer", "height", "--workers", 3)
    assert ran.code == 1
    assert len(ran.out.splitlines()) == 5


def test_json_says_the_same(copy: Path, clipmap: Clipmap) -> None:
    document = parsed(clipmap("verify", copy, "--json").out, "VerifyReport")
    assert document["findings"] == []
    damage(copy)
    lines = clipmap("verify", copy).out.splitlines()
    ran = clipmap("verify", copy, "--json")
    assert (ran.code, ran.err) == (1, "")
    for line, found in zip(lines, parsed(ran.out, "VerifyReport")["findings"], strict=True):
        place = "/".join(str(found[part]) for part in ("layer", "level", "x", "y") if found[part] is not None)
        assert line == f"{place}  {found['file']}: {found['what']}; {found['remedy']}"


def test_seams(padded: Path, clipmap: Clipmap) -> None:
    ran = clipmap("verify", padded, "--seams")
    assert ran.code == 0
    assert ran.out.startswith(f"{padded}: nothing wrong in 34 blocks of height, imagery, ")
    assert ran.out.endswith(", decoded, 137 borders\n")
    assert ran.err.startswith("note: imagery: borders are not bounded by the codec: largest difference ")
    change_samples(padded, "height", BlockAddress(0, 1, 1), lambda samples, mask: samples.__setitem__((0, 9), 1100.5))
    ran = clipmap("verify", padded, "--seams", "--layer", "height")
    assert ran.code == 1
    assert ran.out == (
        "height/0/1/1  height/0/height-0-21.raw: the border differs from the core of 0/1/0 in 1 of 128 samples, by up to 20.5, "
        "first at sample 71,62; rebuild the layer (clipmap build --overwrite)\n"
    )
    assert clipmap("verify", padded).code == 0


def test_seams_of_a_layer_without_a_pad(survey: Path, clipmap: Clipmap) -> None:
    ran = clipmap("verify", survey, "--seams", "--layer", "height")
    assert (ran.code, ran.err) == (0, "note: height: no pad is stored, so there are no borders to compare\n")


@pytest.mark.parametrize(
    ("options", "code", "sentence"),
    [
        (["--layer", "relief"], 3, "clipmap: no layer 'relief' in the dataset; it has height, imagery"),
        (["--quick", "--seams"], 2, "clipmap: --seams compares decoded samples, and --quick decodes nothing; leave out one of them"),
        (["--workers", "0"], 2, "clipmap: Invalid value for '--workers'"),
    ],
)
def test_mistakes(options: list[str], code: int, sentence: str, survey: Path, clipmap: Clipmap) -> None:
    ran = clipmap("verify", survey, *options)
    assert (ran.code, ran.out) == (code, "")
    assert ran.err.startswith(sentence)
    assert ran.err.count("\n") == 1


def test_a_damaged_manifest_is_bad_input(copy: Path, clipmap: Clipmap) -> None:
    path = copy / "manifest.json"
    path.write_bytes(path.read_bytes().replace(b'"stored": 11', b'"stored": 12'))
    ran = clipmap("verify", copy)
    assert (ran.code, ran.out) == (3, "")
    assert "version does not match the content" in ran.err
    assert clipmap("verify", copy / "nowhere").code == 3


@pytest.mark.parametrize("command", ["verify", "diff", "inspect"])
def test_help(command: str, clipmap: Clipmap, golden: Golden) -> None:
    ran = clipmap(command, "--help")
    assert (ran.code, ran.err) == (0, "")
    golden(f"help-{command}.txt", ran.out)
    assert all(len(line) <= 110 for line in ran.out.splitlines())
