"""``clipmap diff``: what it prints and its exit status."""

import re
import shutil
from pathlib import Path

import pytest

from schemas.address import BlockAddress
from schemas.settings import BuildSettings
from tests.cli.conftest import Clipmap, Golden, Sources
from tests.cli.reports import parsed
from tests.unit.tampering import change_samples
from tiler.building.build import build_layer


@pytest.fixture
def copy(survey: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(survey, tmp_path / "copy"))


def steady(text: str, a: Path, b: Path) -> str:
    return re.sub(r"\b[0-9a-f]{32}\b", "DIGEST", text.replace(str(a), "A").replace(str(b), "B"))


def test_the_same(survey: Path, copy: Path, clipmap: Clipmap) -> None:
    ran = clipmap("diff", survey, copy)
    assert (ran.code, ran.out, ran.err) == (0, f"{survey} and {copy} are the same: 34 blocks of height, imagery\n", "")
    assert parsed(clipmap("diff", survey, copy, "--json").out, "DiffReport")["same"]


def test_one_sample(survey: Path, copy: Path, clipmap: Clipmap, golden: Golden) -> None:
    change_samples(copy, "height", BlockAddress(0, 1, 1), lambda samples, mask: samples.__setitem__((3, 3), 1133))
    ran = clipmap("diff", survey, copy)
    assert (ran.code, ran.err) == (1, "")
    golden("diff-one-sample.txt", steady(ran.out, survey, copy))


def test_everything(survey: Path, sources: Sources, tmp_path: Path, clipmap: Clipmap, golden: Golden) -> None:
    """Another codec and filter, and a layer less."""
    other = tmp_path / "other"
    settings = BuildSettings(block=64, codec="png16:1,0", filter="box", workers=1)
    build_layer(sources.dem, other, settings)
    ran = clipmap("diff", survey, other)
    assert (ran.code, ran.err) == (1, "")
    golden("diff-codecs.txt", steady(ran.out, survey, other))
    document = parsed(clipmap("diff", survey, other, "--json").out, "DiffReport")
    assert document["only_in_a"] == ["imagery"]
    assert [level["differing"] for level in document["layers"][0]["levels"]] == [11, 4, 1]


def test_other_lattices(survey: Path, sources: Sources, tmp_path: Path, clipmap: Clipmap, golden: Golden) -> None:
    other = tmp_path / "other"
    build_layer(sources.photo, other, BuildSettings(block=32, codec="raw", workers=1, spacing=30))
    ran = clipmap("diff", other, survey)
    assert (ran.code, ran.err) == (1, "")
    golden("diff-lattices.txt", steady(ran.out, other, survey))


def test_no_dataset(survey: Path, tmp_path: Path, clipmap: Clipmap) -> None:
    ran = clipmap("diff", survey, tmp_path)
    assert (ran.code, ran.out) == (3, "")
    assert ran.err.startswith(f"clipmap: {tmp_path}: no dataset there")
    assert clipmap("diff", survey).code == 2
