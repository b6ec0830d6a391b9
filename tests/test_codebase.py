"""Rules that hold for the whole tree: who imports whom, what loads without extras, sizes, names, versions."""

import json
import re
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from cli.main import COMMANDS

ROOT = Path(__file__).parents[1]
PACKAGES = ("schemas", "tiler", "server", "cli")
MAX_LINES = 400
LONGER: dict[str, str] = {}
"""Files that may be longer, and why."""
VAGUE_NAMES = {"utils", "util", "helpers", "helper", "manager", "managers", "common", "misc"}
HEAVY = {
    "numba",
    "obstore",
    "numpy",
    "OpenImageIO",
    "OpenEXR",
    "rasterio",
    "imagecodecs",
    "fastapi",
    "uvicorn",
    "pydantic_settings",
    "moderngl",
}
BUILT = {".venv", ".git", "__pycache__", ".mypy_cache", ".ruff_cache", ".pytest_cache", ".hypothesis", ".import_linter_cache"}


@cache
def project_files() -> tuple[Path, ...]:
    """Files that are, or would be, under version control; without git all that no tool made."""
    listed = subprocess.run(["git", "-C", ROOT, "ls-files", "-coz", "--exclude-standard"], capture_output=True, check=False)
    if listed.returncode == 0:
        paths = [ROOT / name for name in listed.stdout.decode().split("\0") if name]
    else:
        paths = [path for path in ROOT.rglob("*") if not BUILT & set(path.relative_to(ROOT).parts)]
    return tuple(sorted(path for path in paths if path.is_file()))


def names_of(paths: list[Path]) -> list[str]:
    return [path.relative_to(ROOT).as_posix() for path in paths]


def python_files() -> list[Path]:
    return [path for path in project_files() if path.suffix == ".py"]


def run_python(code: str) -> Any:
    """Run ``code`` in a new interpreter and return the JSON on its last line."""
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_there_are_files_to_check() -> None:
    assert {"schemas/lattice.py", "cli/main.py", "tests/test_codebase.py"} <= set(names_of(python_files()))


def test_imports_go_one_way() -> None:
    lint_imports = Path(sys.executable).with_name("lint-imports")
    done = subprocess.run([lint_imports, "--no-cache"], capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stdout


def test_everything_imports_without_extras() -> None:
    """An installation without the extras can import every module but the viewer's."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    optional = {re.split(r"[<>=\[]", line)[0].replace("-", "_") for name in ("view", "dask", "report", "cloud") for line in extras[name]}
    optional.add("pywt")  # of PyWavelets
    assert "moderngl" in optional
    code = f"""
import importlib, json, pkgutil, sys
sys.modules.update(dict.fromkeys({sorted(optional)!r}))
imported = []
for package in {PACKAGES!r}:
    path = importlib.import_module(package).__path__
    for module in pkgutil.walk_packages(path, package + "."):
        importlib.import_module(module.name)
        imported.append(module.name)
print(json.dumps(imported))
"""
    imported = run_python(code)
    assert {"schemas.manifest", "tiler.stores.dataset", "cli.main"} <= set(imported)


def modules_after(code: str) -> set[str]:
    """Top-level modules that are loaded after ``code`` has run."""
    return set(run_python(f"{code}\nimport json, sys\nprint(json.dumps(sorted({{name.split('.')[0] for name in sys.modules}})))"))


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["nonsense"]])
def test_the_command_line_starts_light(arguments: list[str]) -> None:
    loaded = modules_after(f"from cli.main import run\nrun({arguments!r})")
    assert "click" in loaded
    assert not loaded & HEAVY


@pytest.mark.parametrize(
    ("module", "banned"),
    [
        ("schemas.manifest", HEAVY),
        ("schemas.region", HEAVY | {"pydantic"}),
        ("tiler.stores.dataset", HEAVY),
        ("server.app", HEAVY - {"fastapi", "uvicorn"}),
    ],
)
def test_light_modules_stay_light(module: str, banned: set[str]) -> None:
    if not (ROOT / f"{module.replace('.', '/')}.py").is_file():
        pytest.fail(f"{module} is gone: change this test")
    assert not modules_after(f"import {module}") & banned


def test_every_command_has_a_module_and_every_module_a_command() -> None:
    modules = {path.stem for path in (ROOT / "cli" / "commands").glob("*.py")} - {"__init__"}
    assert modules == set(COMMANDS)


@pytest.mark.parametrize("path", python_files(), ids=lambda path: path.relative_to(ROOT).as_posix())
def test_files_are_short_and_well_named(path: Path) -> None:
    name = path.relative_to(ROOT).as_posix()
    lines = len(path.read_text(encoding="utf-8").splitlines())
    if name not in LONGER:
        assert lines <= MAX_LINES, f"{name} has {lines} lines; split it, or say in LONGER why it is one piece"
    assert not VAGUE_NAMES & set(path.relative_to(ROOT).with_suffix("").parts), f"{name} says nothing about its content"


def test_exceptions_to_the_length_rule_are_needed() -> None:
    assert all(len((ROOT / name).read_text().splitlines()) > MAX_LINES for name in LONGER)


def test_the_version_is_the_changelogs_newest_entry() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    newest = re.search(r"^## \[(\S+)\]", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert newest is not None
    assert newest[1] == version


def test_no_package_index_is_named() -> None:
    """Where packages come from is the machine's business, not the project's."""
    hosts = re.compile(r"pypi\." + r"org|python" + r"hosted|artifact" + r"ory|--(extra-)?index-" + r"url|find-" + r"links", re.IGNORECASE)
    found = [name for path, name in zip(project_files(), names_of([*project_files()]), strict=True) if hosts.search(read_text(path))]
    assert not found


def read_text(path: Path) -> str:
    return path.read_bytes().decode("utf-8", errors="replace")


MARKDOWN = [path for path in project_files() if path.suffix == ".md"]
_LINK = re.compile(r"\]\((?!https?:|mailto:)([^)#\s]*)(?:#([^)\s]+))?\)")


def anchors(text: str) -> set[str]:
    """The anchors that GitHub makes of a document's headings."""
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("path", MARKDOWN, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_links_between_documents_lead_somewhere(path: Path) -> None:
    for target, anchor in _LINK.findall(read_text(path)):
        linked = path.parent / target if target else path
        assert linked.exists(), f"{target} does not exist"
        if anchor and linked.suffix == ".md":
            assert anchor in anchors(read_text(linked)), f"{target or path.name} has no heading #{anchor}"
