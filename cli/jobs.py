"""From the arguments of ``clipmap batch`` to jobs: patterns of file names, and the file of jobs in TOML."""

import tomllib
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from glob import glob, has_magic
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pydantic import ValidationError

from schemas.errors import InputError, NotFoundError, UsageError
from schemas.settings import BuildSettings

if TYPE_CHECKING:
    from tiler.batch.jobs import Job

_SIDECARS: Final = (".aux.xml", ".msk", ".ovr")
"""Files that GDAL keeps beside a raster; they belong to it."""
_TOP_KEYS: Final = ("defaults", "job")
_JOB_KEYS: Final = ("sources", "output")
_STEM: Final = "{stem}"


def read_jobs(arguments: Sequence[str], folder: str, given: Mapping[str, Any]) -> list["Job"]:
    """Return the jobs that the arguments name, a file of jobs or sources; ``given`` are settings that hold whatever a file says.

    Raises UsageError, InputError or NotFoundError for whatever cannot be meant; no source is opened.
    """
    files = [argument for argument in arguments if argument.lower().endswith(".toml")]
    if files and len(arguments) > 1:
        raise UsageError(f"{files[0]}: a file of jobs goes alone; name the other sources in it")
    jobs = _from_toml(Path(files[0]), folder, given) if files else _from_sources(arguments, folder, given)
    _refuse_collisions(jobs)
    return [job for job, _ in jobs]


def _from_sources(arguments: Sequence[str], folder: str, given: Mapping[str, Any]) -> list[tuple["Job", str]]:
    from tiler.batch.jobs import Job

    settings = _settings(given, "the command line")
    return [(Job((path,), _joined(folder, path.stem), settings), "") for path in _matches(arguments, Path())]


def _matches(patterns: Sequence[str], base: Path) -> list[Path]:
    """Return the files that names and patterns stand for, each once, in the order of the patterns and then by name."""
    found: dict[Path, None] = {}
    for pattern in patterns:
        path = base / pattern
        if path.is_dir():
            raise UsageError(f"{path}: is a folder; name its files, e.g. '{path / '*.tif'}'")
        if path.exists() or not has_magic(pattern):
            matches = [path]
        else:
            names = sorted(glob(pattern, root_dir=base, recursive=True))
            matches = [each for each in (base / name for name in names) if not each.is_dir()]
        if not matches or not (path.exists() or has_magic(pattern)):
            raise NotFoundError(f"{path}: no such file" if not has_magic(pattern) else f"{path}: no file has such a name")
        found |= dict.fromkeys(matches)
    return [path for path in found if not _is_sidecar(path)]


def _is_sidecar(path: Path) -> bool:
    return any(path.name.endswith(suffix) and path.with_name(path.name.removesuffix(suffix)).exists() for suffix in _SIDECARS)


def _from_toml(path: Path, folder: str, given: Mapping[str, Any]) -> list[tuple["Job", str]]:
    try:
        text = path.read_bytes().decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or 'not UTF-8'}") from error
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: is no TOML: {error}") from error
    _check_keys(content, _TOP_KEYS, str(path))
    defaults, tables = content.get("defaults", {}), content.get("job", [])
    if not isinstance(defaults, dict):
        raise UsageError(f"{path}: 'defaults' is a table of settings: [defaults]")
    if not isinstance(tables, list) or not tables or not all(isinstance(table, dict) for table in tables):
        raise UsageError(f"{path}: has no jobs; each begins with [[job]] and names its sources")
    common = _named(defaults, (), f"{path}: [defaults]")
    _settings(common, f"{path}: [defaults]")
    jobs: list[tuple[Job, str]] = []
    for number, table in enumerate(tables, start=1):
        jobs += _jobs_of(table, path, f"{path}: job {number}", folder, (common, given))
    return jobs


def _jobs_of(
    table: Mapping[str, Any], path: Path, where: str, folder: str, around: tuple[Mapping[str, Any], Mapping[str, Any]]
) -> list[tuple["Job", str]]:
    from tiler.batch.jobs import Job

    named = _named(table, _JOB_KEYS, where)
    patterns, output = _sources(named.pop("sources", None), where), named.pop("output", None)
    if output is not None and (not isinstance(output, str) or not output):
        raise UsageError(f"{where}: 'output' is the name of a dataset, e.g. output = \"alps\"")
    settings = _settings({**around[0], **named, **around[1]}, where)
    sources = _matches(patterns, path.parent)
    if settings.mosaic:
        if output is None:
            raise UsageError(f'{where}: a mosaic needs a name, e.g. output = "alps"')
        return [(Job(tuple(sources), _joined(folder, output), settings), where)]
    if output is not None and _STEM not in output and len(sources) > 1:
        raise UsageError(
            f"{where}: {len(sources)} sources and one output; say mosaic = true to put them on one lattice, "
            f'or output = "{output}-{_STEM}" to make a dataset of each'
        )
    return [(Job((each,), _joined(folder, (output or _STEM).replace(_STEM, each.stem)), settings), where) for each in sources]


def _sources(value: Any, where: str) -> list[str]:  # noqa: ANN401 - any TOML value
    patterns = [value] if isinstance(value, str) else value
    if not isinstance(patterns, list) or not patterns or not all(isinstance(each, str) and each for each in patterns):
        raise UsageError(f'{where}: \'sources\' names files or patterns, e.g. sources = ["north.tif", "tiles/*.tif"]')
    return patterns


def _named(table: Mapping[str, Any], more: Sequence[str], where: str) -> dict[str, Any]:
    """Return a table under the names of settings; on the command line and here they are written with '-'."""
    _check_keys(table, [*more, *(name.replace("_", "-") for name in BuildSettings.model_fields)], where)
    return {key.replace("-", "_"): value for key, value in table.items()}


def _check_keys(table: Mapping[str, Any], known: Sequence[str], where: str) -> None:
    for key in table:
        if key not in known:
            close = get_close_matches(key, known, 1)
            hint = f"did you mean {close[0]!r}?" if close else f"known are {', '.join(known)}"
            raise UsageError(f"{where}: unknown key {key!r}; {hint}")


def _settings(named: Mapping[str, Any], where: str) -> BuildSettings:
    try:
        return BuildSettings(**named)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = str(first["loc"][0]).replace("_", "-") if first["loc"] else "settings"
        raise UsageError(f"{where}: {key}: {first['msg'].removeprefix('Value error, ')}") from error


def _joined(folder: str, output: str) -> str:
    from tiler.stores.locate import is_url

    if is_url(output) or Path(output).is_absolute():
        return output
    return f"{folder.rstrip('/')}/{output}" if is_url(folder) else str(Path(folder) / output)


def _refuse_collisions(jobs: Sequence[tuple["Job", str]]) -> None:
    """Refuse sources that would get the same dataset by their names; two jobs of a file may name the same one."""
    first: dict[str, tuple[Job, str]] = {}
    for job, where in jobs:
        other, elsewhere = first.setdefault(job.output, (job, where))
        if other is not job and where == elsewhere:
            raise UsageError(
                f"{other.sources[0]} and {job.sources[0]} would both become {job.output}; rename one, or give each an output of its own in "
                "a file of jobs"
            )
