"""``clipmap accuracy`` from the outside: the report it leaves, what it prints, and how it refuses."""

import csv
import json
import re
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import rasterio

from tests.cli.conftest import Clipmap
from tests.reference.terrain import photo

SMALL = ("--crop", 96, "--runs", 1)


@pytest.fixture
def plots() -> None:
    pytest.importorskip("matplotlib")


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    path = tmp_path / "picture.tif"
    pixels = np.moveaxis(photo(120, 130), -1, 0)
    profile = {"driver": "GTiff", "width": 130, "height": 120, "count": 3, "dtype": "uint8"}
    with rasterio.open(path, "w", transform=rasterio.Affine(1, 0, 1, 0, -1, 1), **profile) as file:
        file.write(pixels)
    return path


@pytest.mark.usefixtures("plots")
def test_report_of_the_built_in_terrain(clipmap: Clipmap, tmp_path: Path) -> None:
    folder = tmp_path / "reports" / "island"
    ran = clipmap("accuracy", "-o", folder, *SMALL)
    assert ran.code == 0
    assert "97 x 97 x 1, as height" in ran.out
    assert f"report  {folder / 'index.html'}" in ran.out
    assert re.search(r"Radius 6 \(the default\) takes \d+\.\d\d times the time of radius 3 and removes \d+ % of its error", ran.out)
    content = json.loads((folder / "accuracy.json").read_text())
    assert content["findings"]
    assert all(f"- {sentence}" in ran.out for sentence in content["findings"])
    assert {"processor", "numpy", "OpenImageIO", "GDAL"} <= set(content["machine"])
    with (folder / "kernels.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["name"] for row in rows} == {one["name"] for one in content["candidates"]} >= {"box", "blackman-sinc 6", "OpenImageIO box"}
    assert float(rows[0]["rms"]) == content["candidates"][0]["errors"][0]["rms"]
    page = (folder / "index.html").read_text()
    for name in re.findall(r'(?:src|href)="([^"]+)"', page):
        assert (folder / name).stat().st_size > 100, name
    assert len(re.findall("<img", page)) == 4
    assert page.count("<table") == 5
    for plot in folder.glob("*.svg"):
        assert ElementTree.parse(plot).getroot().tag.endswith("svg")
    assert "http" not in re.sub(r'xmlns[^"]*="[^"]*"', "", page), "the page needs nothing from elsewhere"


@pytest.mark.usefixtures("plots")
def test_a_report_takes_the_place_of_an_older_one_and_of_nothing_else(clipmap: Clipmap, picture: Path, tmp_path: Path) -> None:
    folder = tmp_path / "report"
    folder.mkdir()
    ran = clipmap("accuracy", picture, "-o", folder, *SMALL, "--json")
    assert ran.code == 0, "an empty folder will do"
    first = json.loads(ran.out)
    assert first["sample"]["kind"] == "imagery"
    assert first["default"] == "blackman-sinc 3"
    assert first["default"] not in first["frontier"] or not first["default_dominated_by"]
    assert clipmap("accuracy", "-o", folder, *SMALL).code == 0
    assert json.loads((folder / "accuracy.json").read_text())["sample"]["kind"] == "height"

    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "accuracy.json").write_text('{"report": "mine"}')
    ran = clipmap("accuracy", "-o", foreign, *SMALL)
    assert ran.code == 2
    assert ran.err == f"clipmap: {foreign}: holds something else than an accuracy report; choose another folder for -o\n"
    assert [entry.name for entry in foreign.iterdir()] == ["accuracy.json"]


@pytest.mark.usefixtures("plots")
@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["missing.tif"], 3, "missing.tif: no such file"),
        (["--layer", "height"], 2, "describe a source; name one"),
        (["--height-scale", "2"], 2, "describe a source; name one"),
        (["{picture}", "--layer", "height"], 3, "heights have one channel, this has 3"),
        (["{picture}", "--bands", "1,x"], 2, "channel numbers from 1"),
        (["{picture}", "--bands", "1", "--layer", "height", "--height-scale", "0"], 2, "height_scale must not be 0"),
        (["{picture}", "--crop", "95"], 2, "95 is not in the range"),
    ],
)
def test_mistakes_end_in_one_sentence(clipmap: Clipmap, picture: Path, tmp_path: Path, arguments: list[str], code: int, words: str) -> None:
    ran = clipmap("accuracy", *(argument.format(picture=picture) for argument in arguments), "-o", tmp_path / "report")
    assert ran.code == code
    assert words in ran.err
    assert ran.err.count("\n") == 1
    assert ran.out == ""


@pytest.mark.usefixtures("plots")
def test_a_file_is_no_folder(clipmap: Clipmap, picture: Path) -> None:
    ran = clipmap("accuracy", "-o", picture)
    assert (ran.code, ran.err) == (2, f"clipmap: {picture}: is a file; choose another folder for -o\n")
    ran = clipmap("accuracy", "-o", picture / "report")
    assert ran.code == 4
    assert ran.err.startswith(f"clipmap: {picture / 'report'}: cannot be made: ")


def test_without_matplotlib_the_extra_is_named(clipmap: Clipmap, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    ran = clipmap("accuracy", "-o", tmp_path / "report")
    assert (ran.code, ran.out) == (2, "")
    assert "clipmap[report]" in ran.err
    assert not (tmp_path / "report").exists()
