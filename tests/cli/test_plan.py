"""``clipmap build --plan``: what it says of a build, and of what lies where that would go."""

import json
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from schemas.errors import InputError
from tests.cli.conftest import Clipmap, Sources
from tests.cli.reports import parsed
from tests.integration.files import write_tiff
from tests.reference.terrain import photo
from tests.s3 import S3Server
from tiler.estimate import build as estimate
from tiler.stores.directory import DirectoryStore

REAL = (
    "world/world_land_and_sea_8192_int16.tif",
    "bluemarble/world_topo_bathy_200411_3x5400x2700.jpg",
    "imagery/landsat7_utm18n_uint16_nodata.tif",
    "imagery/naip_rgba_3857.tif",
    "dem/slovenia_lidar_nan.tif",
)


def plan(clipmap: Clipmap, *arguments: object) -> Any:
    """The document that a plan prints."""
    ran = clipmap("build", *arguments, "--plan", "--json")
    assert (ran.code, ran.err) == (0, "")
    return parsed(ran.out, "BuildEstimate")


def state(folder: Path) -> dict[str, tuple[int, int]]:
    return {str(path): (path.stat().st_size, path.stat().st_mtime_ns) for path in [folder, *folder.rglob("*")]}


def test_text(sources: Sources, tmp_path: Path, clipmap: Clipmap) -> None:
    ran = clipmap("build", sources.dem, "-o", tmp_path / "out", "--block", "64", "--codec", "raw", "--workers", "1", "--plan")
    assert (ran.code, ran.err) == (0, "")
    levels, pairs = ran.out.split("\n\n")
    assert levels.splitlines()[0].split() == ["level", "samples", "blocks", "in", "all", "bytes", "tried"]
    assert [line.split()[0] for line in levels.splitlines()[1:]] == ["0", "1", "2"]
    told = dict(re.split(r"  +", line, maxsplit=1) for line in pairs.splitlines())
    assert told["layer"] == f"height in {tmp_path / 'out'}"
    assert told["standing"] == "begin"
    assert told["blocks"] == "17, about 1 of them blank, raw"
    assert told["bytes"] == "261.0 KiB; all of the source was tried"
    assert told["files"] == "22 and 8 folders"
    assert re.fullmatch(r"about \d+\.\d MiB of \d+\.\d [MG]iB to be had", told["memory"])
    assert re.fullmatch(r"about \d+\.\d s with 1 worker", told["time"])
    assert not (tmp_path / "out").exists()


def test_a_plan_agrees_with_the_build_it_is_of(sources: Sources, tmp_path: Path, clipmap: Clipmap) -> None:
    arguments = [sources.dem, "-o", tmp_path / "out", "--block", "64"]
    told = plan(clipmap, *arguments)
    done = json.loads(clipmap("build", *arguments, "--json").out)
    assert told["space"]["stored_bytes"] == done["stored_bytes"]
    assert sum(level["stored"] for level in told["levels"]) == done["blocks_stored"]
    assert (told["standing"]["tasks"], told["layer"], told["codec"]) == (done["tasks"], done["layer"], done["codec"])


@pytest.fixture
def cut(tmp_path: Path) -> tuple[Path, bytes, list[object]]:
    """A file whose last quarter is missing, its bytes, and the arguments of a build in 86 tasks."""
    source = write_tiff(tmp_path / "cut.tif", photo(512, 512), compress="deflate")
    whole = source.read_bytes()
    source.write_bytes(whole[: len(whole) * 3 // 4])
    return source, whole, [source, "-o", tmp_path / "out", "--block", "32", "--task", "64", "--codec", "raw", "--workers", "1"]


def test_standing_of_what_was_begun_and_ended(cut: tuple[Path, bytes, list[object]], tmp_path: Path, clipmap: Clipmap) -> None:
    source, whole, arguments = cut
    assert clipmap("build", *arguments).code == 3
    source.write_bytes(whole)
    before = state(tmp_path)
    told = plan(clipmap, *arguments)
    standing = told["standing"]
    assert (standing["act"], standing["tasks"]) == ("continue", 86)
    assert 32 <= standing["tasks_finished"] < 86
    assert f"{standing['tasks_finished']} of 86 tasks are finished" in standing["sentence"]
    assert 0 < told["remaining_s"] < told["time_s"]
    assert plan(clipmap, *arguments, "--block", "64", "--task", "128")["standing"]["act"] == "refuse"
    assert plan(clipmap, *arguments, "--overwrite")["standing"]["act"] == "continue"
    assert state(tmp_path) == before

    report = json.loads(clipmap("build", *arguments, "--json").out)
    assert (report["outcome"], report["tasks_kept"]) == ("continued", standing["tasks_finished"])
    told = plan(clipmap, *arguments)
    assert (told["standing"]["act"], told["remaining_s"], told["warnings"]) == ("nothing", 0, [])
    os.utime(source, (1, 1))
    before = state(tmp_path)
    refused = plan(clipmap, *arguments)["standing"]
    assert refused["act"] == "refuse"
    assert "the source has changed since, or is another file; add --update" in refused["sentence"]
    assert plan(clipmap, *arguments, "--update")["standing"]["act"] == "update"
    assert plan(clipmap, *arguments, "--overwrite")["standing"]["sentence"] == "begin anew, replace the layer"
    assert state(tmp_path) == before


def test_a_build_at_work_is_seen_and_not_disturbed(sources: Sources, tmp_path: Path, clipmap: Clipmap) -> None:
    with DirectoryStore(tmp_path / "out").exclusive() as claim:
        claim.announce("height")
        before = state(tmp_path)
        standing = plan(clipmap, sources.dem, "-o", tmp_path / "out")["standing"]
        assert standing["act"] == "refuse"
        assert f"another build is writing there (process {os.getpid()} " in standing["sentence"]
        assert state(tmp_path) == before
    standing = plan(clipmap, sources.dem, "-o", tmp_path / "out")["standing"]
    assert standing["act"] == "begin"


@pytest.mark.parametrize("what", ["file", "folder"])
def test_what_is_in_the_way(what: str, sources: Sources, tmp_path: Path, clipmap: Clipmap) -> None:
    if what == "file":
        (tmp_path / "out").write_text("mine")
        expected = "a file is in the way"
    else:
        (tmp_path / "out").mkdir()
        (tmp_path / "out/mine.txt").write_text("mine")
        expected = "not a dataset, and not empty"
    before = state(tmp_path)
    standing = plan(clipmap, sources.dem, "-o", tmp_path / "out")["standing"]
    assert standing["act"] == "refuse"
    assert expected in standing["sentence"]
    assert state(tmp_path) == before


def test_shortages_are_warnings(sources: Sources, tmp_path: Path, clipmap: Clipmap, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimate._Room, "at", classmethod(lambda cls, folder: cls(10_000, 7, 4096)))
    monkeypatch.setattr(estimate, "available_bytes", lambda: 1 << 20)
    warnings = plan(clipmap, sources.dem, "-o", tmp_path / "out", "--block", "64")["warnings"]
    assert [warning.split(":")[0] for warning in warnings[:2]] == ["does not fit", "does not fit"]
    assert "1e-05 GB are free there" in warnings[0]
    assert "the file system has room for 7" in warnings[1]
    assert "fewer --workers" in warnings[2]
    ran = clipmap("build", sources.dem, "-o", tmp_path / "out", "--block", "64", "--plan")
    assert len(ran.err.splitlines()) == 3
    assert all(line.startswith("note: ") for line in ran.err.splitlines())


def test_a_stretch_is_not_sought_again(tmp_path: Path, clipmap: Clipmap, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cut reads the whole source; what the build found is in its records."""
    source = write_tiff(tmp_path / "scene.tif", np.arange(64 * 64 * 3, dtype=np.uint16).reshape(64, 64, 3) * 5)
    arguments = [source, "-o", tmp_path / "out", "--stretch", "2%"]
    assert plan(clipmap, *arguments)["codec"] == "jpeg:85"
    assert clipmap("build", *arguments).code == 0

    def refuse(*arguments: object) -> None:
        raise InputError("sought")

    monkeypatch.setattr("tiler.samples.opening.find_ranges", refuse)
    assert plan(clipmap, *arguments)["standing"]["act"] == "nothing"


@pytest.mark.parametrize("name", REAL)
def test_real_files(name: str, data_dir: Path, tmp_path: Path, clipmap: Clipmap) -> None:
    arguments = [data_dir / name, "-o", tmp_path / "out"]
    told = plan(clipmap, *arguments)
    assert not (tmp_path / "out").exists()
    if (data_dir / name).stat().st_size > 10e6:
        return  # its build takes too long for a test; the estimate is held against it in docs/BATCH.md
    done = json.loads(clipmap("build", *arguments, "--json").out)
    assert told["space"]["stored_bytes_low"] <= done["stored_bytes"] <= told["space"]["stored_bytes_high"]
    assert abs(told["space"]["stored_bytes"] / done["stored_bytes"] - 1) < 0.1


def test_an_object_store_has_no_file_system(sources: Sources, tmp_path: Path, clipmap: Clipmap, s3: S3Server) -> None:
    arguments = [sources.dem, "-o", s3.url(tmp_path)]
    told = json.loads(clipmap("build", *arguments, "--plan", "--json").out)
    assert (told["space"]["free_bytes"], told["space"]["folders"], told["standing"]["act"]) == (None, 0, "begin")
    assert "30 ms per object" in told["warnings"][0]
    assert s3.names(tmp_path) == []
    assert clipmap("build", *arguments).code == 0
    assert json.loads(clipmap("build", *arguments, "--plan", "--json").out)["standing"]["act"] == "nothing"
    assert len(s3.names(tmp_path)) == told["space"]["files"]
