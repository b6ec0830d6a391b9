"""Compiled kernels between runs: kept where that is possible, right in every case, silent in every case.

Kernels of a module in a temporary folder stand for ours: loading the module anew is to its kernels what a new process is.
"""

import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
LOOPS = """
from tiler.compiled import compiled
{imports}

@compiled
def scaled(value):
    return value * {factor}

@compiled
def result(value):
    return scaled(value) + 1
"""
COUNTS = """
import json, sys
import numpy as np
import loops
found = [loops.result(np.dtype(name).type(10)) for name in sys.argv[1:]]
made = loops.result.dispatcher().stats
print(json.dumps([[float(each) for each in found], sum(made.cache_hits.values()), sum(made.cache_misses.values())]))
"""
OURS = """
import json
import numpy as np
from tiler.codecs.pngrows import copy, subtract
row, difference, again = np.arange(5, dtype=np.uint8), np.zeros(5, np.uint8), np.zeros(5, np.uint8)
subtract(row, np.full(5, 2, np.uint8), difference)
copy(difference, again)
print(json.dumps(again.tolist()))
"""


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A home of the test's own, with its own folder for temporary files, and no configuration of numba."""
    for name in ("home", "temporary"):
        (tmp_path / name).mkdir()
    for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return tmp_path / "home"


@pytest.fixture
def folder(tmp_path: Path, home: Path) -> Path:
    """A folder with a module of two kernels."""
    folder = tmp_path / "installed"
    folder.mkdir()
    write_loops(folder)
    return folder


def write_loops(folder: Path, factor: str = "2", imports: str = "") -> None:
    (folder / "loops.py").write_text(LOOPS.format(factor=factor, imports=imports))


def make_read_only(folder: Path) -> None:
    """No folder can be made where a file is: permissions would not stop root, as whom tests may run."""
    shutil.rmtree(folder / "__pycache__", ignore_errors=True)
    (folder / "__pycache__").touch()


def load(folder: Path, name: str = "loops") -> ModuleType:
    spec = spec_from_file_location(name, folder / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    source = (folder / f"{name}.py").read_text()
    exec(compile(source, folder / f"{name}.py", "exec"), module.__dict__)  # bytecode is not read: sources change within a second here
    return module


def run(folder: Path, value: float = 6.0) -> tuple[float, bool]:
    """Return the result as a new process would find it, and whether its code came from the disk."""
    kernel = load(folder).result
    found = kernel(value)
    stats = kernel.dispatcher().stats
    return float(found), bool(stats.cache_hits) and not stats.cache_misses


def kept(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.suffix in (".kernel", ".part"))


def python(code: str, *arguments: str, path: Path, **environment: str) -> "subprocess.Popen[str]":
    """Start Python with what is importable from ``path`` and from here, and every warning an error."""
    variables = {**os.environ, "PYTHONPATH": f"{path}{os.pathsep}{ROOT}", **environment}
    program = [sys.executable, "-W", "error", "-c", code, *arguments]
    return subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=variables, cwd=path)


def answer(process: "subprocess.Popen[str]") -> Any:
    out, err = process.communicate()
    assert (process.returncode, err) == (0, "")
    return json.loads(out)


def test_the_second_process_compiles_nothing(folder: Path, home: Path) -> None:
    assert run(folder) == (13.0, False)
    assert run(folder) == (13.0, True)
    assert run(folder, 6) == (13.0, False), "other types of arguments are other code"
    assert {path.parent for path in kept(folder)} == {folder / "__pycache__"}
    assert kept(home) == []


def test_numba_cache_dir_comes_first(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path / "chosen"))
    assert [run(folder), run(folder)] == [(13.0, False), (13.0, True)]
    assert len(kept(tmp_path / "chosen")) == 2
    assert kept(folder) == []


@pytest.mark.parametrize("place", ["home", "XDG_CACHE_HOME", "temporary"])
def test_a_read_only_installation_keeps_kernels_elsewhere(
    folder: Path, home: Path, tmp_path: Path, place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_read_only(folder)
    if place == "XDG_CACHE_HOME":
        monkeypatch.setenv(place, str(tmp_path / place))
    if place == "temporary":
        (home / ".cache").touch()
    assert [run(folder), run(folder)] == [(13.0, False), (13.0, True)]
    assert len(kept(tmp_path / place)) == len(kept(tmp_path)) == 2


def test_an_installation_that_was_warmed_serves_those_who_cannot_write_to_it(folder: Path, home: Path) -> None:
    run(folder)
    before = kept(folder)
    (home / ".cache").touch()
    assert run(folder) == (13.0, True)
    assert kept(folder) == before


@pytest.mark.parametrize("hindrance", ["a file", "open to others", "a link"])
def test_nothing_is_read_from_a_folder_that_others_can_write_to(folder: Path, home: Path, tmp_path: Path, hindrance: str) -> None:
    make_read_only(folder)
    (home / ".cache").touch()
    private = tmp_path / "temporary" / f"clipmap-kernels-{os.geteuid()}"
    match hindrance:
        case "a file":
            private.touch()
        case "open to others":
            private.mkdir()
            private.chmod(0o777)
        case _:
            (tmp_path / "elsewhere").mkdir()
            private.symlink_to(tmp_path / "elsewhere")
    assert [run(folder), run(folder)] == [(13.0, False), (13.0, False)]
    assert kept(tmp_path) == []


@pytest.mark.parametrize("damage", ["empty", "cut off", "a bit", "something else"])
def test_a_damaged_file_is_compiled_anew(folder: Path, damage: str) -> None:
    run(folder)
    for path in kept(folder):
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        damaged = {"empty": b"", "cut off": bytes(content[: len(content) // 2]), "a bit": bytes(content)}
        path.write_bytes(damaged.get(damage, b"kernel" * 100))
    assert run(folder) == (13.0, False)
    assert run(folder) == (13.0, True)


def test_a_new_source_is_new_code_and_the_old_goes(folder: Path) -> None:
    run(folder)
    before = kept(folder)
    os.utime(folder / "loops.py", (1, 1))
    assert run(folder) == (13.0, True), "the text counts, not when it was written"
    write_loops(folder, "3")
    assert run(folder) == (19.0, False)
    assert run(folder) == (19.0, True)
    assert not set(before) & set(kept(folder))
    assert len(kept(folder)) == len(before)


@pytest.mark.parametrize("other", ["FACTOR = {}", "from tiler.compiled import compiled\n@compiled\ndef FACTOR():\n    return {}\n"])
def test_a_constant_and_a_kernel_of_another_module_count(folder: Path, other: str, monkeypatch: pytest.MonkeyPatch) -> None:
    factor = "FACTOR" if other.startswith("FACTOR") else "FACTOR()"
    write_loops(folder, factor, "from factors import FACTOR")
    for value, expected in ((2, 13.0), (5, 31.0)):
        (folder / "factors.py").write_text(other.format(value))
        monkeypatch.setitem(sys.modules, "factors", load(folder, "factors"))
        assert run(folder) == (expected, False)
    assert run(folder) == (31.0, True)


def test_a_full_disk_costs_the_cache_only(folder: Path) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        assert run(folder) == (13.0, False)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert kept(folder) == []


def test_four_processes_fill_an_empty_cache_at_once(folder: Path) -> None:
    """With types in another order each: numba's own index would give some the code of others."""
    orders = [("float32", "int64"), ("int64", "float32"), ("float64", "int64"), ("int64", "float64")]
    processes = [python(COUNTS, *order, path=folder) for order in orders]
    assert [answer(process)[0] for process in processes] == [[21.0, 21.0]] * 4
    assert answer(python(COUNTS, "float32", "float64", "int64", path=folder)) == [[21.0] * 3, 3, 0]
    assert {path.suffix for path in kept(folder)} == {".kernel"}


def test_another_processor_has_code_of_its_own(folder: Path) -> None:
    assert answer(python(COUNTS, "int64", path=folder)) == [[21.0], 0, 1]
    assert answer(python(COUNTS, "int64", path=folder, NUMBA_CPU_NAME="generic")) == [[21.0], 0, 1]
    assert answer(python(COUNTS, "int64", path=folder)) == [[21.0], 1, 0]


def test_our_own_kernels_run_where_nothing_can_be_written(tmp_path: Path, home: Path) -> None:
    installed = tmp_path / "installed"
    for package in ("tiler", "schemas"):
        shutil.copytree(ROOT / package, installed / package, ignore=shutil.ignore_patterns("__pycache__"))
    for folder in [installed / "tiler", *(path for path in (installed / "tiler").iterdir() if path.is_dir())]:
        make_read_only(folder)
    (home / ".cache").touch()
    (tmp_path / "temporary" / f"clipmap-kernels-{os.geteuid()}").touch()
    assert answer(python(OURS, path=installed)) == [254, 255, 0, 1, 2]
    assert kept(tmp_path) == []
