"""``clipmap build``: help, reports, every way to fail, and real files."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cli.main import COMMANDS
from tests.cli.conftest import Clipmap, Golden, Sources
from tests.contract.picture_files import KINDS, content, file_name, png_bytes, write_with_openimageio, write_with_rasterio
from tiler.stores.dataset import open_dataset


def snapshot(folder: Path) -> dict[str, bytes | None]:
    """Every file and folder below ``folder`` with its bytes."""
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None for path in sorted(folder.rglob("*"))}


@pytest.mark.parametrize("command", ["build", "inspect"])
def test_help(command: str, clipmap: Clipmap, golden: Golden) -> None:
    ran = clipmap(command, "--help")
    assert (ran.code, ran.err) == (0, "")
    golden(f"help-{command}.txt", ran.out)
    assert clipmap(command, "-h").out == ran.out
    assert all(len(line) <= 110 for line in ran.out.splitlines())


def test_help_lists_every_command(clipmap: Clipmap) -> None:
    ran = clipmap("--help")
    assert (ran.code, ran.err) == (0, "")
    for name, line in COMMANDS.items():
        assert re.search(rf"^  {name} +{re.escape(line)}$", ran.out, re.MULTILINE)
    bare = clipmap()
    assert (bare.code, bare.out + bare.err) == (2, ran.out) or (bare.code, bare.out) == (0, ran.out)


def test_report(sources: Sources, tmp_path: Path, clipmap: Clipmap) -> None:
    ran = clipmap("build", sources.dem, "-o", tmp_path / "out", "--block", "64", "--codec", "raw")
    assert (ran.code, ran.err) == (0, "")
    lines = dict(re.split(r"  +", line, maxsplit=1) for line in ran.out.splitlines())
    assert lines["layer"] == f"height in {tmp_path / 'out'}, built"
    assert lines["samples"] == "200 x 150, 3 levels"
    assert lines["blocks"] == "16 stored, 1 blank, raw"
    assert lines["stored"] == "261.0 KiB"
    assert re.fullmatch(r"\d+\.\d\d s, peak memory \d+\.\d [MG]iB", lines["time"])


def test_report_as_json(sources: Sources, tmp_path: Path, clipmap: Clipmap) -> None:
    clipmap("build", sources.dem, "-o", tmp_path / "out", "--block", "64")
    ran = clipmap("build", sources.photo, "-o", tmp_path / "out", "--block", "64", "--json")
    assert (ran.code, ran.err) == (0, "")
    report = json.loads(ran.out)
    known = {name: report[name] for name in ("dataset", "layer", "codec", "levels", "blocks_stored", "blocks_blank", "remarks")}
    assert known == {
        "dataset": str(tmp_path / "out"),
        "layer": "imagery",
        "codec": "jpeg:85",
        "levels": 3,
        "blocks_stored": 17,
        "blocks_blank": 0,
        "remarks": ["photo.tif has no georeference: spread over the dataset's extent"],
    }
    assert report["wall_s"] > 0
    assert report["peak_rss_bytes"] > 1 << 20
    assert set(report["thread_seconds_per_megasample"]) == {"read", "filter", "encode", "write"}
    assert report["version"] == open_dataset(tmp_path / "out").manifest.version


def test_remarks_go_to_stderr(sources: Sources, tmp_path: Path, clipmap: Clipmap) -> None:
    ran = clipmap("build", sources.photo, "-o", tmp_path / "out")
    assert ran.code == 0
    assert ran.err == "note: photo.tif has no georeference and no --spacing: samples lie one unit apart\n"


def test_a_stretch_is_told_by_inspect(tmp_path: Path, clipmap: Clipmap) -> None:
    write_with_rasterio(tmp_path / "scene.tif", content(3, "uint16"))
    clipmap("build", tmp_path / "scene.tif", "-o", tmp_path / "out", "--stretch", "-20.5,40000")
    source = next(line for line in clipmap("inspect", tmp_path / "out").out.splitlines() if line.startswith("source"))
    assert "3 x uint16, stretched from -20.5 to 40000, assumed" in source
    found = json.loads(clipmap("inspect", tmp_path / "out", "--json").out)
    assert found["layers"][0]["source"]["stretch"] == [[-20.5, 40000]] * 3


def damaged(folder: Path) -> dict[str, Path]:
    """Files that no build gets through, by name."""
    folder.mkdir()
    paths = {
        name: folder / f"{name}.tif"
        for name in ("empty", "text", "rgba16", "grey8", "mixed", "five", "cut", "short", "deep", "huge", "colour", "deep_colour", "turned")
    }
    paths["empty"].write_bytes(b"")
    paths["text"].write_text("not a picture\n")
    write_with_rasterio(paths["five"], content(5, "uint8"))
    write_with_rasterio(paths["grey8"], content(1, "uint8"))
    write_with_rasterio(paths["colour"], content(3, "uint8"))
    write_with_rasterio(paths["deep"], content(3, "float32"))
    write_with_rasterio(paths["huge"], np.full((64, 64, 1), 1e300))
    write_with_rasterio(paths["cut"], content(1, "int16", 500, 500), compress="DEFLATE")
    paths["cut"].write_bytes(paths["cut"].read_bytes()[: paths["cut"].stat().st_size // 2])
    write_with_rasterio(paths["short"], content(1, "int16", 500, 500))
    paths["short"].write_bytes(paths["short"].read_bytes()[:300_000])
    write_with_rasterio(paths["deep_colour"], np.full((64, 64, 3), 500, np.uint16))
    write_with_openimageio(paths["turned"], content(3, "uint8"), Orientation=6)
    paths["turned"].with_suffix(".tfw").write_text("10\n0\n0\n-10\n500005\n4999995\n")
    for kind in KINDS:
        if kind.name in (
            "png-3xuint8",
            "jpeg-colour",
            "webp",
            "exr-float32-Y-rows",
            "exr-float32-Y-64",
            "jpeg2000-int16",
            "tiff-jpeg-tiles",
        ):
            path = paths[kind.name] = folder / file_name(kind)
            kind.write(path)
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    paths["bomb"] = folder / "bomb.png"
    paths["bomb"].write_bytes(png_bytes(46340, 46340, 8, 2, b""))
    steps = np.add.outer(np.arange(256), np.arange(256)) * 4 + 100000
    write_with_rasterio(folder / "hidden.tif", np.stack([steps >> 16, steps >> 8 & 255, steps & 255], axis=-1).astype(np.uint8))
    return {**paths, "hidden": folder / "hidden.tif", "missing": folder / "missing.tif", "folder": folder}


FAILURES: list[tuple[str, list[str], int, str]] = [
    ("missing", [], 3, "missing.tif: no such file"),
    ("folder", [], 3, "is a folder"),
    ("empty", [], 3, "the file is empty"),
    ("text", [], 3, "neither OpenImageIO nor GDAL can read it"),
    ("bomb", [], 3, "the file is damaged or malicious"),
    ("cut", [], 3, "cut.tif: cannot be read at rows"),
    ("png-3xuint8", [], 3, "cannot be read at rows"),
    ("jpeg-colour", [], 3, "cannot be read at rows"),
    ("webp", [], 3, "cannot be read at rows"),
    ("exr-float32-Y-rows", [], 3, "cannot be read at rows"),
    ("exr-float32-Y-64", [], 3, "cannot be read at rows"),
    ("jpeg2000-int16", [], 3, "cannot be read at rows"),
    ("tiff-jpeg-tiles", [], 3, "cannot be read at rows"),
    ("five", [], 2, "has 5 channels; choose 1 or 3 with --bands"),
    ("five", ["--bands", "6"], 2, "no channel 6, it has 5"),
    ("five", ["--bands", "1,2,3,4,5"], 2, "--bands"),
    ("five", ["--bands", "0"], 2, "channels are counted from 1"),
    ("five", ["--bands", "one"], 2, "channel numbers from 1, separated by commas"),
    ("grey8", [], 2, "say --layer imagery or --layer height"),
    ("grey8", ["--layer", "relief"], 2, "'relief'"),
    ("deep", ["--layer", "imagery"], 3, "8 or 16 bits without sign"),
    ("deep", ["--layer", "height"], 3, "heights have one channel, this has 3"),
    ("huge", [], 3, "1e+300 is no height; if it marks voids, give --nodata 1e+300"),
    ("huge", ["--height-scale", "1e-20"], 3, "1e+300 is no height"),
    ("short", [], 3, "has 300000 bytes, but its samples alone take 500000; the file is cut off"),
    ("turned", [], 3, "has a georeference and is stored rotated or mirrored (orientation 6)"),
    ("colour", ["--max-samples", "99"], 3, "samples, more than 99; if that is what it holds, give --max-samples"),
    ("colour", ["--max-samples", "0"], 2, "--max-samples: Input should be greater than or equal to 1"),
    ("colour", ["--stretch", "2%"], 2, "has 8 bits already"),
    ("deep_colour", ["--stretch", "2"], 2, "--stretch '2': expected CUT%"),
    ("deep_colour", ["--stretch", "9,9"], 2, "MIN must be less than MAX"),
    ("deep_colour", ["--stretch", "2%"], 3, "channel 1 has no range to stretch, its samples are 500"),
    ("deep_colour", ["--stretch", "2%", "--nodata", "500"], 3, "has no valid sample, so there is no range to stretch"),
    ("deep_colour", ["--stretch", "2%", "--layer", "height", "--bands", "1"], 2, "--stretch is for imagery"),
    ("hidden", [], 2, "looks like heights hidden in colour; build it with --layer height --decode terrain-rgb"),
    ("hidden", ["--layer", "imagery"], 2, "--decode none"),
    ("colour", ["--decode", "terrarium", "--layer", "imagery"], 2, "are for heights"),
    ("colour", ["--decode", "mapbox"], 2, "'mapbox'"),
    ("colour", ["--codec", "gif"], 2, "no codec 'gif'"),
    ("colour", ["--codec", "lerc"], 2, "codec lerc holds heights"),
    ("colour", ["--codec", "jpeg:0"], 2, "from 1 to 100"),
    ("colour", ["--nodata", "0", "--codec", "jpeg"], 2, "use png"),
    ("grey8", ["--layer", "height", "--codec", "png16:0.001,0"], 3, "use another scale and offset, or lerc"),
    ("grey8", ["--layer", "height", "--nodata", "-9999"], 2, "no sample of uint8 can have that value"),
    ("grey8", ["--layer", "height", "--spacing", "0"], 2, "--spacing"),
    ("grey8", ["--layer", "height", "--height-scale", "0"], 2, "height_scale must not be 0"),
    ("grey8", ["--layer", "height", "--height-scale", "nan"], 2, "--height-scale"),
    ("colour", ["--block", "100"], 2, "must be a power of two"),
    ("colour", ["--block", "8192"], 2, "must be a power of two from 2 to 4096"),
    ("colour", ["--radius", "0"], 2, "--radius"),
    ("colour", ["--radius", "99"], 2, "--radius"),
    ("colour", ["--task", "1"], 2, "--task"),
    ("colour", ["--workers", "0"], 2, "--workers"),
    ("colour", ["--filter", "sharp"], 2, "'sharp'"),
    ("colour", ["--depth", "3"], 2, "--depth"),
    ("colour", ["more.tif"], 2, "2 sources: add --mosaic to put them on one lattice"),
]


@pytest.fixture(scope="session")
def bad_files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return damaged(tmp_path_factory.mktemp("bad") / "files")


@pytest.mark.parametrize(
    ("name", "options", "code", "sentence"), FAILURES, ids=lambda value: " ".join(value) if isinstance(value, list) else str(value)
)
def test_a_failed_build_says_one_sentence_and_leaves_nothing(
    name: str, options: list[str], code: int, sentence: str, bad_files: dict[str, Path], tmp_path: Path, clipmap: Clipmap
) -> None:
    ran = clipmap("build", bad_files[name], *options, "-o", tmp_path / "new" / "folder")
    assert (ran.code, ran.out) == (code, "")
    assert ran.err.startswith("clipmap: ")
    assert ran.err.count("\n") == 1, ran.err
    assert sentence in ran.err
    assert "Traceback" not in ran.err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["cut", "png-3xuint8", "missing", "huge", "hidden"])
def test_a_failed_build_leaves_the_dataset_as_it_was(
    name: str, bad_files: dict[str, Path], sources: Sources, tmp_path: Path, clipmap: Clipmap
) -> None:
    out = tmp_path / "out"
    clipmap("build", sources.dem, "-o", out, "--block", "64")
    before = snapshot(tmp_path)
    ran = clipmap("build", bad_files[name], "-o", out, "--overwrite")
    assert ran.code in (2, 3)
    assert snapshot(tmp_path) == before


def test_an_empty_folder_is_still_there_after_a_failed_build(bad_files: dict[str, Path], tmp_path: Path, clipmap: Clipmap) -> None:
    (tmp_path / "out").mkdir()
    assert clipmap("build", bad_files["cut"], "-o", tmp_path / "out").code == 3
    assert [path.name for path in tmp_path.rglob("*")] == ["out"]


def test_what_contradicts_the_dataset(sources: Sources, tmp_path: Path, clipmap: Clipmap) -> None:
    out = tmp_path / "out"
    clipmap("build", sources.dem, "-o", out, "--block", "64")
    before = snapshot(tmp_path)
    again = clipmap("build", sources.dem, "-o", out)
    assert (again.code, "--overwrite" in again.err) == (2, True)
    elsewhere = clipmap("build", sources.photo, "-o", out, "--spacing", "5")
    assert (elsewhere.code, "but the dataset is in EPSG:32632 (metre)" in elsewhere.err) == (2, True)
    spaced = clipmap("build", sources.dem, "-o", out, "--overwrite", "--spacing", "5")
    assert (spaced.code, "has a georeference; leave out --spacing" in spaced.err) == (2, True)
    for ran in (again, elsewhere, spaced):
        assert ran.err.count("\n") == 1
        assert ran.out == ""
    assert snapshot(tmp_path) == before


def test_output_that_is_no_dataset(sources: Sources, tmp_path: Path, clipmap: Clipmap) -> None:
    (tmp_path / "file").write_text("precious")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "thesis.txt").write_text("precious")
    (tmp_path / "damaged").mkdir()
    (tmp_path / "damaged" / "manifest.json").write_text("{")
    before = snapshot(tmp_path)
    for name, code, sentence in [
        ("file", 4, "a file is in the way"),
        ("file/below", 4, "a file is in the way"),
        ("folder", 2, "not a dataset, and not empty (it holds thesis.txt)"),
        ("damaged", 3, "not a manifest"),
    ]:
        ran = clipmap("build", sources.dem, "-o", tmp_path / name)
        assert (ran.code, ran.out) == (code, "")
        assert ran.err.startswith("clipmap: ")
        assert ran.err.count("\n") == 1
        assert sentence in ran.err
    assert snapshot(tmp_path) == before


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["build"], "Missing argument 'SOURCE...'. (see clipmap build --help)"),
        (["build", "x.tif"], "Missing option '-o' / '--output'"),
        (["nonsense"], "No such command 'nonsense'"),
        (["--nonsense"], "--nonsense"),
        (["inspect"], "Missing argument 'DATASET'"),
        (["inspect", "a", "b", "c"], "unexpected extra argument"),
    ],
)
def test_usage(arguments: list[str], sentence: str, clipmap: Clipmap) -> None:
    ran = clipmap(*arguments)
    assert (ran.code, ran.out) == (2, "")
    assert ran.err.startswith("clipmap: ")
    assert ran.err.count("\n") == 1
    assert sentence.replace(". (", " (") in ran.err


def test_hidden_heights_build_as_heights_or_as_the_picture_they_are_said_to_be(
    bad_files: dict[str, Path], tmp_path: Path, clipmap: Clipmap
) -> None:
    assert clipmap("build", bad_files["hidden"], "-o", tmp_path / "heights", "--decode", "terrain-rgb").code == 0
    assert clipmap("build", bad_files["hidden"], "-o", tmp_path / "picture", "--decode", "none").code == 0
    heights = open_dataset(tmp_path / "heights").manifest.layer("height")
    assert (heights.statistics.min, heights.statistics.max, heights.source.decode) == ([0.0], [204.0], "terrain-rgb")
    picture = open_dataset(tmp_path / "picture").manifest.layer("imagery")
    assert (picture.channels, picture.source.decode) == (3, None)


REAL: list[tuple[str, list[str], dict[str, Any]]] = [
    ("bluemarble/world_topo_bathy_200411_3x5400x2700.jpg", [], {"kind": "imagery", "size": (5400, 2700, 3), "levels": 6, "crs": None}),
    ("dem/fuji_terrain_rgb.png", [], {"refused": (2, "--decode terrain-rgb")}),
    ("dem/fuji_terrain_rgb.png", ["--decode", "terrain-rgb"], {"kind": "height", "size": (512, 512, 1), "range": (13.7, 3751.0)}),
    ("dem/st_helens_terrain_rgb.png", [], {"refused": (2, "--decode terrain-rgb")}),
    ("dem/st_helens_terrain_rgb.png", ["--decode", "terrain-rgb"], {"kind": "height", "size": (256, 256, 1), "range": (1002.0, 1164.2)}),
    ("dem/grandcanyon_terrarium.png", ["--layer", "imagery"], {"refused": (2, "--decode terrarium")}),
    ("dem/grandcanyon_terrarium.png", ["--decode", "terrarium"], {"kind": "height", "range": (715.17, 2488.95)}),
    (
        "dem/mt_everest_90m.tif",
        [],
        {"kind": "height", "size": (1201, 1201, 1), "void": 0.091, "levels": 4, "crs": "EPSG:4326", "range": (192, 8642)},
    ),
    (
        "dem/slovenia_lidar_nan.tif",
        [],
        {"kind": "height", "size": (1000, 1000, 1), "void": 0.0005, "crs": "EPSG:3794", "spacing": (1.0, 1.0)},
    ),
    ("grandcanyon/gcanyon_color.1024.png", [], {"kind": "imagery", "size": (1024, 1024, 3), "void": 0}),
    ("grandcanyon/gcanyon_elev_crop.bw.png", [], {"refused": (2, "say --layer imagery or --layer height")}),
    ("grandcanyon/gcanyon_elev_crop.bw.png", ["--layer", "height"], {"kind": "height", "size": (1200, 1200, 1), "range": (35, 187)}),
    (
        "imagery/landsat7_utm18n_uint16_nodata.tif",
        [],
        {
            "kind": "imagery",
            "size": (779, 790, 4),
            "dtype": "uint16",
            "void": 0.325,
            "levels": 3,
            "crs": "EPSG:32618",
            "spacing": (300.15, 300.15),
        },
    ),
    ("imagery/naip_rgba_3857.tif", [], {"kind": "imagery", "size": (1024, 2048, 4), "crs": "EPSG:3857", "void": 0.9805}),
    ("imagery/rgb_mask.tif", [], {"kind": "imagery", "size": (383, 232, 4), "void": 0.031, "dtype": "uint8"}),
    ("imagery/rgba_alpha.tif", [], {"kind": "imagery", "size": (383, 232, 4), "void": 0.113}),
    ("imagery/rgba_uint16.tif", [], {"kind": "imagery", "size": (634, 411, 4), "dtype": "uint16", "void": 0.511}),
    ("imagery/utm60n_dateline_uint16.tif", [], {"refused": (2, "say --layer imagery or --layer height")}),
    (
        "imagery/utm60n_dateline_uint16.tif",
        ["--layer", "imagery"],
        {"kind": "imagery", "size": (2325, 2355, 1), "crs": "EPSG:32660", "spacing": (100.01, 100.01), "levels": 5},
    ),
    ("nasty/all_nodata.tif", [], {"refused": (2, "has 4 channels")}),
    ("nasty/all_nodata.tif", ["--bands", "1,2,3"], {"kind": "imagery", "size": (71, 2475, 4), "void": 1, "stored": 0}),
    ("nasty/bomb-65500x65500.jpg", [], {"refused": (3, "damaged or malicious")}),
    ("nasty/bomb.png", [], {"refused": (3, "damaged or malicious")}),
    ("nasty/float_57pct_nan.tif", [], {"kind": "height", "size": (316, 341, 1), "void": 0.5688}),
    ("nasty/truncated.jpg", [], {"refused": (3, "Premature end of JPEG file")}),
    ("nasty/truncated_image.png", [], {"refused": (3, "cannot be read at rows")}),
    ("puget/ps_height_1k.png", [], {"refused": (2, "say --layer imagery or --layer height")}),
    (
        "puget/ps_height_1k.png",
        ["--layer", "height", "--height-scale", "0.1", "--spacing", "160"],
        {"kind": "height", "size": (1025, 1025, 1), "range": (0, 4379.8), "spacing": (160, 160), "levels": 4},
    ),
    ("puget/ps_texture_1k.png", [], {"kind": "imagery", "size": (1024, 1024, 3), "levels": 3}),
    (
        "world/world_land_and_sea_8192_int16.tif",
        ["--task", "4096"],
        {"kind": "height", "size": (8192, 8192, 1), "void": 0.0079, "levels": 6, "crs": "EPSG:3857", "range": (-10872, 7295)},
    ),
]


@pytest.mark.parametrize(("name", "options", "expected"), REAL, ids=lambda value: " ".join(value) if isinstance(value, list) else None)
def test_real_files(name: str, options: list[str], expected: dict[str, Any], data_dir: Path, tmp_path: Path, clipmap: Clipmap) -> None:
    ran = clipmap("build", data_dir / name, "-o", tmp_path / "out", *options)
    if "refused" in expected:
        code, sentence = expected["refused"]
        assert (ran.code, ran.out, ran.err.count("\n")) == (code, "", 1)
        assert ran.err.startswith(f"clipmap: {data_dir / name}: ")
        assert sentence in ran.err
        assert not list(tmp_path.iterdir())
        return
    assert ran.code == 0, ran.err
    manifest = open_dataset(tmp_path / "out").manifest
    (layer,) = manifest.layers.values()
    tolerances = {"void": 6e-4, "spacing": 0.005, "range": 0.05}
    found = {
        "kind": layer.kind,
        "size": (layer.width, layer.height, layer.channels),
        "dtype": layer.dtype,
        "levels": len(layer.levels),
        "crs": manifest.world.crs,
        "stored": sum(level.stored for level in layer.levels),
        "void": 1 - layer.statistics.valid / (layer.width * layer.height),
        "spacing": layer.ground_spacing_m,
        "range": (*layer.statistics.min, *layer.statistics.max),
    }
    for fact, value in expected.items():
        assert found[fact] == (pytest.approx(value, abs=tolerances[fact]) if fact in tolerances else value), fact


def test_every_real_file_is_in_the_table(data_dir: Path) -> None:
    files = {str(path.relative_to(data_dir)) for path in data_dir.rglob("*") if path.is_file() and path.suffix != ".md"}
    assert files == {name for name, _, _ in REAL}
