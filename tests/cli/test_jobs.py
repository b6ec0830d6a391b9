"""Jobs of a batch: which sources become which datasets with which settings, and what is refused before anything runs."""

import os
from pathlib import Path
from typing import Any

import click
import pytest

from cli.commands.batch import parse_memory
from cli.jobs import read_jobs
from schemas.errors import ClipmapError, InputError, NotFoundError, UsageError
from tiler.batch.jobs import Job

FILES = ("a.tif", "b.tif", "b.tif.aux.xml", "b.tif.ovr", "lone.ovr", "deep/c.tif", "deep/er/a.png", ".hidden.tif")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Empty files: nothing is opened."""
    for name in FILES:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    return tmp_path


def jobs(folder: Path, text: str, **given: Any) -> list[Job]:
    """Jobs of a file that lies in ``folder``, into ``out``."""
    (folder / "jobs.toml").write_text(text)
    return read_jobs([str(folder / "jobs.toml")], "out", given)


def pairs(found: list[Job], folder: Path) -> list[tuple[str, str]]:
    return [(" ".join(str(path.relative_to(folder)) for path in job.sources), job.output) for job in found]


def test_one_dataset_per_file(folder: Path) -> None:
    found = read_jobs([str(folder / "*.tif"), str(folder / "deep/c.tif"), str(folder / "b.tif")], "out", {"codec": "png"})
    assert pairs(found, folder) == [("a.tif", "out/a"), ("b.tif", "out/b"), ("deep/c.tif", "out/c")]
    assert {job.settings.codec for job in found} == {"png"}


def test_patterns_reach_deep_and_leave_side_files_out(folder: Path) -> None:
    found = read_jobs([str(folder / "b*"), str(folder / "*.ovr"), str(folder / "**/c.*")], "s3://bucket/x/", {})
    assert pairs(found, folder) == [("b.tif", "s3://bucket/x/b"), ("lone.ovr", "s3://bucket/x/lone"), ("deep/c.tif", "s3://bucket/x/c")]


def test_names_with_brackets_are_names_first(folder: Path) -> None:
    (folder / "[b].tif").touch()
    assert pairs(read_jobs([str(folder / "[b].tif")], "out", {}), folder) == [("[b].tif", "out/[b]")]


def test_the_relative_stays_relative(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    assert [(str(job.sources[0]), job.output) for job in read_jobs(["*.tif"], "../out", {})] == [
        ("a.tif", "../out/a"),
        ("b.tif", "../out/b"),
    ]


@pytest.mark.parametrize(
    ("patterns", "error", "match"),
    [
        (["*.jp2"], NotFoundError, r"\*\.jp2: no file has such a name"),
        (["none.tif"], NotFoundError, r"none\.tif: no such file"),
        (["deep"], UsageError, r"deep: is a folder; name its files, e\.g\. '.*deep/\*\.tif'"),
        (["a.tif", "deep/er/a.png"], UsageError, r"a\.tif and .*a\.png would both become out/a; rename one"),
        (["a.tif", "x.toml"], UsageError, "a file of jobs goes alone"),
        (["x.toml"], InputError, r"x\.toml: cannot be read: No such file"),
    ],
)
def test_patterns_that_mean_nothing(patterns: list[str], error: type[ClipmapError], match: str, folder: Path) -> None:
    with pytest.raises(error, match=match):
        read_jobs([str(folder / pattern) for pattern in patterns], "out", {})


def test_a_file_of_jobs(folder: Path) -> None:
    text = """
    [defaults]
    codec = "png"
    block = 128
    [[job]]
    sources = ["a.tif", "b.*"]
    [[job]]
    sources = "deep/**/*.*"
    output = "far/{stem}-1"
    block = 64
    height-scale = 0.5
    bands = [1, 2, 3]
    [[job]]
    sources = ["a.tif", "b.tif"]
    output = "/abs/all"
    mosaic = true
    """
    found = jobs(folder, text, overwrite=True, codec="webp")
    assert pairs(found, folder) == [
        ("a.tif", "out/a"),
        ("b.tif", "out/b"),
        ("deep/c.tif", "out/far/c-1"),
        ("deep/er/a.png", "out/far/a-1"),
        ("a.tif b.tif", "/abs/all"),
    ]
    assert [job.settings.block for job in found] == [128, 128, 64, 64, 128]
    assert {(job.settings.codec, job.settings.overwrite) for job in found} == {("webp", True)}
    assert [job.settings.height_scale for job in found] == [1, 1, 0.5, 0.5, 1]
    assert found[2].settings.bands == (1, 2, 3)
    assert [job.settings.mosaic for job in found] == [False] * 4 + [True]


def test_patterns_are_relative_to_the_file(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir("/")
    name = os.path.relpath(folder / "deep/jobs.toml")
    (folder / "deep/jobs.toml").write_text('[[job]]\nsources = "*.tif"\n')
    assert [job.sources[0].resolve() for job in read_jobs([name], "out", {})] == [(folder / "deep/c.tif").resolve()]


def test_two_layers_of_one_dataset(folder: Path) -> None:
    text = '[[job]]\nsources = "a.tif"\noutput = "alps"\nlayer = "height"\n[[job]]\nsources = "b.tif"\noutput = "alps"'
    assert pairs(jobs(folder, text), folder) == [("a.tif", "out/alps"), ("b.tif", "out/alps")]


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("[[job]\n", r"jobs\.toml: is no TOML: .*line 1"),
        ("", r"jobs\.toml: has no jobs; each begins with \[\[job\]\]"),
        ("job = 3", "has no jobs"),
        ('[job]\nsources = "a.tif"', "has no jobs"),
        ('[[jobs]]\nsources = "a.tif"', r"jobs\.toml: unknown key 'jobs'; did you mean 'job'\?"),
        ("defaults = 1\n[[job]]\nsources = 'a.tif'", "'defaults' is a table"),
        ("[defaults]\ncodek = 'png'\n[[job]]\nsources = 'a.tif'", r"\[defaults\]: unknown key 'codek'; did you mean 'codec'\?"),
        ("[defaults]\nsources = 'a.tif'\n[[job]]\nsources = 'a.tif'", r"\[defaults\]: unknown key 'sources'"),
        ("[defaults]\nheight_scale = 2\n[[job]]\nsources = 'a.tif'", "did you mean 'height-scale'"),
        ("[defaults]\nblock = 'big'\n[[job]]\nsources = 'a.tif'", r"\[defaults\]: block: .*integer"),
        ("[[job]]\nsources = 'a.tif'\n[[job]]\nsources = 'b.tif'\npad = -1", r"jobs\.toml: job 2: pad: .*greater than or equal"),
        ("[[job]]\noutput = 'x'", "job 1: 'sources' names files or patterns"),
        ("[[job]]\nsources = []", "job 1: 'sources' names"),
        ("[[job]]\nsources = [1]", "job 1: 'sources' names"),
        ("[[job]]\nsources = 'a.tif'\noutput = 7", "job 1: 'output' is the name"),
        ("[[job]]\nsources = '*.jp2'", r"\*\.jp2: no file has such a name"),
        ("[[job]]\nsources = '*.tif'\noutput = 'x'", r"job 1: 2 sources and one output; say mosaic = true"),
        ("[[job]]\nsources = '*.tif'\nmosaic = true", "job 1: a mosaic needs a name"),
        ("[[job]]\nsources = ['a.tif', 'deep/er/a.png']", r"a\.tif and .*a\.png would both become out/a"),
    ],
)
def test_files_of_jobs_that_mean_nothing(text: str, match: str, folder: Path) -> None:
    with pytest.raises((UsageError, InputError, NotFoundError), match=match):
        jobs(folder, text)


def test_a_file_that_is_no_text(folder: Path) -> None:
    (folder / "jobs.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match="not UTF-8"):
        read_jobs([str(folder / "jobs.toml")], "out", {})


@pytest.mark.parametrize(
    ("text", "size"), [("1", 1), ("4G", 4 << 30), ("500m", 500 << 20), ("1.5 GiB", 3 << 29), ("2KB", 2048), ("1T", 1 << 40)]
)
def test_memory(text: str, size: int) -> None:
    assert parse_memory(click.Context(click.Command("x")), click.Option(["--memory"]), text) == size


@pytest.mark.parametrize("text", ["", "0", "0G", "much", "-1", "4 P", "1e9", "4GG"])
def test_memory_that_is_none(text: str) -> None:
    with pytest.raises(click.BadParameter, match="a size like 4G"):
        parse_memory(click.Context(click.Command("x")), click.Option(["--memory"]), text)
