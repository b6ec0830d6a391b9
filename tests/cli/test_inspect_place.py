"""``clipmap inspect``: values at a place, maps of levels, pictures of blocks."""

import re
from pathlib import Path

import imagecodecs
import numpy as np
import pytest

from cli.facts_text import coverage_lines, source_text
from schemas.facts import CoverageMap, LayerFacts, LevelSummary
from schemas.manifest import Layer, Level, Source
from tests.cli.conftest import Clipmap, Golden, Sources
from tests.cli.reports import parsed
from tests.cli.test_inspect import TARGETS

REPORTS = {
    "dataset": "DatasetFacts",
    "layer": "LayerFacts",
    "level": "LevelFacts",
    "level-of-imagery": "LevelFacts",
    "block": "BlockFacts",
    "blank-block": "BlockFacts",
    "block-by-name": "BlockFacts",
    "root-block": "BlockFacts",
}


@pytest.mark.parametrize("name", TARGETS)
def test_json_is_valid_under_the_published_schema(name: str, survey: Path, clipmap: Clipmap) -> None:
    parsed(clipmap("inspect", survey, *TARGETS[name], "--json").out, REPORTS[name])


def test_no_field_of_the_manifest_is_left_out() -> None:
    """But for where the blocks lie; the unit has another name there, because a dataset has one as well."""
    elsewhere = {"path", "suffix", "media_type", "unit"}
    assert set(Layer.model_fields) - elsewhere <= set(LayerFacts.model_fields)
    assert set(Level.model_fields) - {"availability", "index"} <= set(LevelSummary.model_fields)


def test_what_is_not_usual_is_shown(sources: Sources, tmp_path: Path, clipmap: Clipmap) -> None:
    clipmap("build", sources.dem, "-o", tmp_path / "out", "--pad", 2, "--clamp", "local", "--fill", 3)
    clipmap("build", sources.photo, "-o", tmp_path / "out", "--linear-light")
    height, imagery = (clipmap("inspect", tmp_path / "out", name).out for name in ("height", "imagery"))
    assert ", 256 x 256 with a pad of 2, lerc:0.01, error at most 0.01 m\n" in height
    assert "guarded-normalised voids, clamped to the range under the taps\n" in height
    assert re.search(r"\nfilled +voids up to 3 samples across\n", height)
    assert "guarded-normalised voids, in linear light\n" in imagery
    assert "filled" not in imagery


def test_stretched_imagery_says_from_what() -> None:
    fields = {"name": "a.tif", "format": "tiff", "width": 1, "height": 1, "channels": 3, "dtype": "uint16", "file_bytes": 1, "nodata": None}
    rest = {"decode": None, "scale": 1.0, "offset": 0.0, "placement": "georeferenced"}
    for ranges, text in (([(5, 900), (7, 800.5), (5, 900)], "5 to 900 and 7 to 800.5"), ([(5, 900)] * 3, "5 to 900")):
        source = Source.model_validate({**fields, **rest, "stretch": ranges})
        assert source_text(source) == f"a.tif, tiff, 3 x uint16, stretched from {text}, georeferenced"


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("at-world", ["--at-world", "402415,5198005"]),
        ("at-void", ["height", "--at-world", "405500,5196000"]),
        ("at-pixel", ["imagery", "--at-pixel", "80,66"]),
    ],
)
def test_values_at_a_place(name: str, arguments: list[str], survey: Path, clipmap: Clipmap, golden: Golden) -> None:
    """402415, 5198005 is the centre of pixel (80, 66): 1000 + 2 * 80 - 66 m, and the colours 80, 66, 73."""
    ran = clipmap("inspect", survey, *arguments)
    assert (ran.code, ran.err) == (0, "")
    golden(f"inspect-{name}.txt", ran.out.replace(str(survey), "DATASET"))
    document = parsed(clipmap("inspect", survey, *arguments, "--json").out, "PointFacts")
    finest = {layer["layer"]: layer["levels"][0]["value"] for layer in document["layers"]}
    expected = {"at-world": {"height": [1094], "imagery": [80, 66, 73]}, "at-void": {"height": None}, "at-pixel": {"imagery": [80, 66, 73]}}
    assert finest == expected[name]


def test_geographic_coordinates_lead_to_the_same_sample(survey: Path, clipmap: Clipmap) -> None:
    by_world = parsed(clipmap("inspect", survey, "--at-world", "402420,5198000", "--json").out, "PointFacts")
    longitude, latitude = by_world["longitude_latitude"]
    by_place = parsed(clipmap("inspect", survey, "--at", f"{longitude},{latitude}", "--json").out, "PointFacts")
    assert by_place["world"] == pytest.approx(by_world["world"], abs=1e-6)
    assert [layer["levels"] for layer in by_place["layers"]] == [layer["levels"] for layer in by_world["layers"]]


@pytest.mark.parametrize(
    ("arguments", "code", "sentence"),
    [
        (["--at", "20,47"], 3, "lies outside"),
        (["--at", "-20.5,-47"], 3, "lies outside"),
        (["--at-world", "0,0"], 3, "0 0 lies outside"),
        (["height", "--at-pixel", "200,0"], 3, "sample 200,0 lies outside layer 'height', which has 200 x 150 samples"),
        (["--at-pixel", "0,0"], 2, "name the layer meant, e.g. height"),
        (["--at", "9"], 2, "two numbers with a comma between them"),
        (["--at", "nan,0"], 2, "two numbers with a comma between them"),
        (["--at-pixel", "1.5,0"], 2, "two whole numbers"),
        (["--at", "9,95"], 2, "latitude from -90 to 90"),
        (["--at", "9,47", "--at-pixel", "1,1"], 2, "--at and --at-pixel: give only one of them"),
        (["--at", "9,47", "--png", "x.png"], 2, "--at and --png: give only one of them"),
        (["height/0", "--at-pixel", "1,1"], 3, "no layer 'height/0' in the dataset; it has height, imagery"),
        (["height/0", "--png", "x.png"], 2, "--png draws one block: name it, e.g. clipmap inspect"),
        (["height/0/3/2", "--png", "x.png"], 3, "height-0-13.raw: is blank, so there is no picture to write"),
        (["height/0/0/0", "--png", "nowhere/x.png"], 4, "nowhere/x.png: cannot be written: No such file or directory"),
    ],
)
def test_mistakes(
    arguments: list[str], code: int, sentence: str, survey: Path, tmp_path: Path, clipmap: Clipmap, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    ran = clipmap("inspect", survey, *arguments)
    assert (ran.code, ran.out) == (code, "")
    assert ran.err.startswith("clipmap: ")
    assert ran.err.count("\n") == 1
    assert sentence in ran.err
    assert list(tmp_path.iterdir()) == []


def test_a_dataset_without_a_reference_system(sources_without_place: Path, clipmap: Clipmap) -> None:
    ran = clipmap("inspect", sources_without_place, "--at", "9,47")
    assert (ran.code, ran.out) == (2, "")
    assert "has no coordinate reference system; use --at-world X,Y or --at-pixel X,Y instead" in ran.err


@pytest.fixture
def sources_without_place(clipmap: Clipmap, tmp_path: Path) -> Path:
    (tmp_path / "photo.png").write_bytes(imagecodecs.png_encode(np.zeros((40, 50, 3), np.uint8)))
    assert clipmap("build", tmp_path / "photo.png", "--layer", "imagery", "-o", tmp_path / "out").code == 0
    return tmp_path / "out"


def test_a_picture_of_a_block(survey: Path, tmp_path: Path, clipmap: Clipmap) -> None:
    plain = clipmap("inspect", survey, "imagery/0/3/2")
    ran = clipmap("inspect", survey, "imagery/0/3/2", "--png", tmp_path / "block.png")
    assert ran == plain
    rows, columns = np.mgrid[128:150, 192:200]
    expected = np.stack([columns, rows, columns // 2 + rows // 2], axis=-1)
    assert (imagecodecs.png_decode((tmp_path / "block.png").read_bytes()) == expected).all()


def test_a_map_fits_the_terminal(clipmap: Clipmap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "photo.png").write_bytes(imagecodecs.png_encode(np.zeros((100, 1200, 3), np.uint8)))
    clipmap("build", tmp_path / "photo.png", "--layer", "imagery", "--block", 8, "-o", tmp_path / "out")
    widths = {}
    for columns in (400, 110, 30):
        monkeypatch.setenv("COLUMNS", str(columns))
        lines = clipmap("inspect", tmp_path / "out", "imagery/0").out.split("\n\n")[1].splitlines()
        widths[columns] = max(len(line) for line in lines[:-1]), len(lines) - 1, lines[-1].rpartition("; ")[2]
    assert widths == {
        400: (300, 13, widths[400][2]),
        110: (100, 5, "a mark is 3 x 3 blocks"),
        30: (30, 2, "a mark is 10 x 10 blocks"),
    }
    assert "mark" not in widths[400][2]


def test_a_map_without_unicode() -> None:
    coverage = CoverageMap(blocks_per_cell=4, valid_share=[[1.0, 0.999], [0.4, 0.001], [0.0, 0.5]])
    key = "partly  .. blank; a mark is 4 x 4 blocks"
    assert coverage_lines(coverage, "ANSI_X3.4-1968") == ["##**", "++--", "..++", f"## all valid  **++-- {key}"]
    assert coverage_lines(coverage, "UTF-8")[:3] == ["██▓▓", "▒▒░░", "··▒▒"]
