"""``clipmap copy``: the same dataset in another place or form."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cli.output import emit_json, emit_pairs, format_bytes
from cli.progress import progress_bar
from schemas.errors import UsageError

if TYPE_CHECKING:
    from tiler.archives.copying import CopyReport


@click.command(short_help="Copy a dataset to another folder or store, or into archives.")
@click.argument("source", metavar="SRC")
@click.argument("target", metavar="DST")
@click.option(
    "--store",
    "form",
    type=click.Choice(["directory", "archive"]),
    default="directory",
    show_default=True,
    help="directory: one file or object per block; archive: one PMTiles file per layer, identical blocks stored once.",
)
@click.option("--layer", "names", multiple=True, metavar="NAME", help="Copy this layer only; may be repeated.  [default: all layers]")
@click.option("--workers", type=click.IntRange(1, 256), help="Threads.  [default: all processors; 32 if SRC or DST is a URL]")
@click.option("--overwrite", is_flag=True, help="Replace another dataset at DST; it is served until the copy is complete.")
@click.option("--json", "as_json", is_flag=True, help="Print the report as JSON.")
def command(source: str, target: str, form: str, names: tuple[str, ...], workers: int | None, overwrite: bool, as_json: bool) -> None:
    """Copy the dataset SRC to DST. Both may be folders, or URLs of object stores such as s3://bucket/prefix.

    Every block is compared with its digest on the way, and a damaged one stops the copy. DST becomes a dataset when all is there;
    a copy that was interrupted goes on where it stopped when the command is repeated. clipmap diff SRC DST then says that they
    are the same.

    With --store archive every layer becomes one file, which is read in place: clipmap serve, inspect, verify and view take the folder
    as it is, and other programs that read PMTiles version 3 take the files. An archive is written once; to change it,
    change SRC and copy again.

    \b
    clipmap copy out/alps /mnt/backup/alps
    clipmap copy out/alps out/alps-archive --store archive
    clipmap copy out/alps s3://bucket/alps --workers 64
    """
    from tiler.archives.copying import copy_dataset
    from tiler.stores.archive import ArchiveStore
    from tiler.stores.dataset import open_dataset
    from tiler.stores.locate import open_store

    if target.endswith(".pmtiles"):
        raise UsageError(f"{target}: copy makes a folder; one file of one layer is made by clipmap export {source} pmtiles -o {target}")
    archive = form == "archive"
    if archive and "://" in target:
        raise UsageError(f"{target}: archives are written into a folder of this machine; copy without --store archive")
    opened = open_dataset(source)
    store = ArchiveStore(Path(target)) if archive else open_store(target)
    with progress_bar("blocks") as on_progress:
        report = copy_dataset(opened, store, names or None, archive=archive, workers=workers, overwrite=overwrite, on_progress=on_progress)
    emit_json(_facts(source, target, report)) if as_json else _show(target, report)


def _identical(report: "CopyReport") -> dict[str, int]:
    """Return how many blocks of every archive are the same as another one."""
    return {name: made.tiles - made.contents for name, made in report.archives.items()}


def _facts(source: str, target: str, report: "CopyReport") -> dict[str, Any]:
    return {
        "source": source,
        "dataset": target,
        "version": report.manifest.version,
        "layers": list(report.manifest.layers),
        "blocks": report.blocks,
        "blocks_already_there": report.kept,
        "blocks_stored_once": _identical(report),
        "written_bytes": report.written_bytes,
        "wall_s": report.wall_s,
    }


def _show(target: str, report: "CopyReport") -> None:
    there = f", {report.kept} of them were there already" if report.kept else ""
    emit_pairs(
        [
            ("dataset", f"{target}, version {report.manifest.version}"),
            ("layers", ", ".join(report.manifest.layers)),
            ("blocks", f"{report.blocks}{there}"),
            *[("identical", f"{count} of {name}, stored once") for name, count in _identical(report).items() if count],
            ("written", format_bytes(report.written_bytes)),
            ("time", f"{report.wall_s:.2f} s"),
        ]
    )
