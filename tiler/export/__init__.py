"""Datasets in other people's forms. One file per form, imported when it is used; this is the registry.

Our levels become the other form's levels: nothing that is stored is filtered again.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from time import perf_counter
from typing import Final, Protocol

from schemas.errors import NotFoundError, UsageError
from schemas.manifest import LayerKind
from tiler.export.staging import require_free
from tiler.stores.dataset import Dataset

Progress = Callable[[int, int], None]
"""Called with (tiles written, tiles in all)."""


@dataclass(frozen=True, slots=True)
class Form:
    """A form to export to: where its writer is, file suffixes, and which layers it can hold; ``instead`` says what else to do."""

    module: str
    writer: str
    suffixes: tuple[str, ...]
    kinds: tuple[LayerKind, ...]
    instead: str = ""


FORMS: Final = {
    "pmtiles": Form("tiler.export.pmtiles", "write_pmtiles", (".pmtiles",), ("imagery", "height", "light", "normal")),
    "cog": Form("tiler.export.cog", "write_cog", (".tif", ".tiff"), ("imagery", "height", "light", "normal")),
    "dzi": Form(
        "tiler.export.dzi", "write_dzi", (".dzi",), ("imagery", "light"), "heights and normals are no pictures; export them as cog or exr"
    ),
    "exr": Form("tiler.export.exr", "write_exr", (".exr",), ("imagery", "height", "light", "normal")),
}


@dataclass(frozen=True, slots=True)
class ExportSettings:
    """What ``clipmap export`` is told.

    ``layer``: its name, None if there is one that fits; ``workers``: threads, None for all processors; ``overwrite``: replace what
    is there; ``half``: 16-bit floats in EXR, None for 8-bit imagery only; ``codes``: keep sRGB codes in EXR.
    """

    layer: str | None = None
    workers: int | None = None
    overwrite: bool = False
    half: bool | None = None
    codes: bool = False


@dataclass(frozen=True, slots=True)
class Job:
    """What a writer is told besides dataset, layer and target."""

    workers: int
    on_progress: Progress
    settings: ExportSettings


@dataclass(slots=True)
class Exported:
    """What a writer did: levels, tiles that are stored blocks byte for byte, tiles that were encoded, bytes written."""

    levels: int
    copied: int = 0
    encoded: int = 0
    stored_bytes: int = 0


@dataclass(frozen=True, slots=True)
class ExportReport:
    """What an export did, and how long it took [s]."""

    layer: str
    form: str
    target: Path
    done: Exported
    wall_s: float


class Writer(Protocol):
    """Writes one layer in one form; what it writes appears under ``target`` when it is whole, not before."""

    def __call__(self, dataset: Dataset, name: str, target: Path, job: Job) -> Exported:
        """Write layer ``name``; raises InputError, NotFoundError, StorageError, or UsageError if the form cannot hold the layer."""
        ...


def export(
    dataset: Dataset, form: str, target: Path, settings: ExportSettings, on_progress: Progress = lambda done, total: None
) -> ExportReport:
    """Write a layer of ``dataset`` as ``form``, one of FORMS, to ``target``, whose suffix is added where it is missing.

    Raises UsageError if the form or the layer does not fit or the target exists, and what the writer raises.
    """
    if form not in FORMS:
        raise UsageError(f"no form {form!r}: use one of {', '.join(FORMS)}")
    if form != "exr" and (settings.half is not None or settings.codes):
        raise UsageError(f"--half, --float and --codes are for exr; leave them out for {form}")
    name = _choose_layer(dataset, form, settings.layer)
    if target.suffix.lower() not in FORMS[form].suffixes:
        target = target.with_name(target.name + FORMS[form].suffixes[0])
    require_free(target, settings.overwrite)
    started = perf_counter()
    writer: Writer = getattr(import_module(FORMS[form].module), FORMS[form].writer)
    workers = settings.workers or len(os.sched_getaffinity(0))
    done = writer(dataset, name, target, Job(workers, on_progress, settings))
    return ExportReport(name, form, target, done, perf_counter() - started)


def _choose_layer(dataset: Dataset, form: str, asked: str | None) -> str:
    layers, kinds = dataset.manifest.layers, FORMS[form].kinds
    if asked is not None:
        if asked not in layers:
            raise NotFoundError(f"no layer {asked!r} in {dataset.store.location}; it has {', '.join(layers)}")
        if layers[asked].kind not in kinds:
            raise UsageError(f"layer {asked!r} cannot become {form}: {FORMS[form].instead}")
        return asked
    fitting = [name for name, layer in layers.items() if layer.kind in kinds]
    if not fitting:
        raise UsageError(f"{dataset.store.location}: no layer that can become {form}: {FORMS[form].instead}")
    if len(fitting) > 1:
        raise UsageError(f"{dataset.store.location}: has {' and '.join(fitting)}; say which one with --layer")
    return fitting[0]
