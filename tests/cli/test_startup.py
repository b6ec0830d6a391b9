"""How a command begins and ends: what it imports, and that ending at once loses nothing. Times are in docs/PERFORMANCE.md."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rasterio.transform import Affine

from tests.contract.picture_files import write_with_rasterio

ROOT = Path(__file__).parents[2]
AS_INSTALLED = "import sys; from cli.main import main; main()"
LOADED = """
import atexit, json, sys
names = lambda: print(json.dumps(sorted(name.split(".")[0] for name, module in sys.modules.items() if module is not None)), file=sys.stderr)
from cli.startup import QuickEnd, start_lean
start_lean()
end = QuickEnd()
atexit.register(names)
from cli.main import run
sys.exit(end.with_code(run()))
"""
FOR_OTHER_WORK = {
    "boto3",
    "botocore",
    "distributed",
    "dask",
    "matplotlib",
    "moderngl",
    "fastapi",
    "uvicorn",
    "obstore",
    "rich",
    "pywt",
    "rio_cogeo",
}


def python(code: str, *arguments: object, **environment: str) -> "subprocess.CompletedProcess[str]":
    program = [sys.executable, "-W", "error", "-c", code, *map(str, arguments)]
    return subprocess.run(program, capture_output=True, text=True, check=False, cwd=ROOT, env={**os.environ, **environment})


def loaded(*arguments: object) -> set[str]:
    """Top-level modules that a command has loaded when it ends."""
    done = python(LOADED, *arguments)
    assert done.returncode == 0, done.stderr
    return set(json.loads(done.stderr.splitlines()[-1]))


@pytest.fixture(scope="module")
def photo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A georeferenced RGB photograph."""
    path = tmp_path_factory.mktemp("photo") / "photo.tif"
    pixels = np.random.default_rng(1).integers(0, 256, (64, 64, 3), np.uint8)
    write_with_rasterio(path, pixels, crs="EPSG:32633", transform=Affine(10, 0, 500000, 0, -10, 5000000))
    return path


@pytest.fixture(scope="module")
def dataset(photo: Path) -> Path:
    """The photograph as a dataset."""
    path = photo.parent / "dataset"
    done = python(AS_INSTALLED, "build", photo, "-o", path, "--block", 32, "--json")
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout)["blocks_written"] == 5
    return path


def test_help_is_shown_without_the_libraries() -> None:
    assert not loaded("--help") & {"numpy", "numba", "pydantic", "rasterio", "OpenImageIO", "imagecodecs", *FOR_OTHER_WORK}


def test_a_build_loads_nothing_for_other_work(photo: Path, tmp_path: Path) -> None:
    modules = loaded("build", photo, "-o", tmp_path / "dataset")
    assert {"numba", "rasterio", "OpenImageIO"} <= modules
    assert not modules & FOR_OTHER_WORK


def test_checking_loads_no_readers_of_sources(dataset: Path) -> None:
    modules = loaded("verify", dataset)
    assert "imagecodecs" in modules
    assert not modules & {"rasterio", "OpenImageIO", *FOR_OTHER_WORK}


def test_the_compiler_waits_for_the_first_call() -> None:
    """numba takes as long to get ready as all else before the first pixel."""
    done = python("import sys, tiler.samples.enhance, tiler.codecs.pngrows; print('tiler.kernelcache' in sys.modules)")
    assert (done.stdout, done.stderr) == ("False\n", "")


def test_output_through_a_pipe_is_whole(dataset: Path) -> None:
    shown = python(AS_INSTALLED, "inspect", dataset, "--json")
    assert (shown.returncode, shown.stderr) == (0, "")
    assert json.loads(shown.stdout)


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [(["--version"], 0, ""), (["nonsense"], 2, "clipmap: "), (["build", "missing.tif", "-o", "nowhere"], 3, "clipmap: missing.tif: ")],
)
def test_the_exit_code_is_that_of_the_command(arguments: list[str], code: int, said: str) -> None:
    done = python(AS_INSTALLED, *arguments)
    assert done.returncode == code
    assert done.stderr.startswith(said)
    assert done.stderr.count("\n") == bool(said)


def test_what_libraries_do_at_exit_is_done_and_threads_end_first() -> None:
    code = """
import atexit, sys, threading, time
from cli.startup import QuickEnd
end = QuickEnd()
atexit.register(print, "at exit")
def work():
    time.sleep(0.2)
    print("thread")
threading.Thread(target=work).start()
class Never:
    def __del__(self):
        print("taken apart")
kept = Never()
print("unflushed", end="\\n")
sys.exit(end.with_code(7))
"""
    done = python(code)
    assert (done.returncode, done.stdout, done.stderr) == (7, "unflushed\nthread\nat exit\n", "")


def test_a_mistake_of_ours_ends_as_ever() -> None:
    done = python("from cli.startup import QuickEnd\nend = QuickEnd()\nend.with_code(int('x'))")
    assert done.returncode == 1
    assert done.stderr.endswith("ValueError: invalid literal for int() with base 10: 'x'\n")


def test_a_full_standard_output_is_not_success() -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("no /dev/full here")
    with full.open("w") as stdout:
        done = subprocess.run(
            [sys.executable, "-c", AS_INSTALLED, "--help"], stdout=stdout, stderr=subprocess.PIPE, text=True, check=False, cwd=ROOT
        )
    assert done.returncode != 0


def test_who_imports_clipmap_finds_nothing_changed() -> None:
    code = """
import gc, os, sys
before = gc.get_threshold(), dict(os.environ)
import cli.main
cli.main.run(["--version"])
assert (gc.get_threshold(), dict(os.environ)) == before
assert "boto3" not in sys.modules
"""
    assert python(code).returncode == 0
