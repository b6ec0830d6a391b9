"""``clipmap verify``: whether a dataset holds what it claims."""

import click

from cli.exit_codes import DONE, FOUND
from cli.output import emit_json, format_bytes
from cli.progress import progress_bar
from schemas.findings import Finding, LayerCheck, VerifyReport


@click.command(short_help="Check a dataset: files, digests, samples, seams.")
@click.argument("dataset")
@click.option("--layer", "layers", metavar="NAME", multiple=True, help="Check this layer only; may be repeated.  [default: all]")
@click.option("--seams", is_flag=True, help="Compare the stored borders of blocks with their neighbours; needs a layer built with --pad.")
@click.option("--quick", is_flag=True, help="Decode nothing: compare files with their digests only.")
@click.option("--repair", is_flag=True, help="Make what is damaged again, from the source that the layer was built from.")
@click.option("--workers", type=click.IntRange(1, 256), help="Threads.  [default: all processors]")
@click.option("--json", "as_json", is_flag=True, help="Print the report as JSON.")
def command(dataset: str, layers: tuple[str, ...], seams: bool, quick: bool, repair: bool, workers: int | None, as_json: bool) -> int:
    """Check that DATASET, a folder or the URL of an object store, holds what it claims, and name everything that is wrong.

    The manifest against its version; every index against the manifest: length, digest, counts, availability; every block
    against the index: its file, length and digest, that it can be decoded, and the number and the range of its valid samples,
    exactly for lossless codecs, within their bound for lerc, png16 and rgb565, and not at all for jpeg and webp. Blank blocks must
    have no file, and the layers' folders no file that belongs to no block.

    --seams compares the border that a layer with a pad stores around every block with what the neighbours hold there: equal
    for lossless codecs, within twice the bound for bounded ones. For jpeg, webp and exr:half, which promise no bound, the
    largest difference is told, and is no finding. In a layer without a pad there is nothing to compare.

    --repair makes damaged indexes and blocks again, byte for byte, by running the tasks that made them: the source must be where it
    was, as it was, and the dataset must have been built with records (the default). Then everything is checked again.

    Every finding is one line on standard output: layer/level/x/y, file, what is wrong, what to do. The exit status is 1 if there
    is any (left), 0 if there is none, and 3 if the manifest itself cannot be understood.

    \b
    clipmap verify out/alps
    clipmap verify out/alps --layer height --seams
    clipmap verify out/alps --repair
    """
    from tiler.checking.verify import Checks, verify
    from tiler.stores.dataset import open_dataset

    checks = Checks(decode=not quick, seams=seams, workers=workers)

    opened = open_dataset(dataset)
    with progress_bar("blocks") as on_progress:
        if repair:
            from tiler.checking.repair import verify_and_repair

            report = verify_and_repair(opened, layers or None, checks, on_progress)
        else:
            report = verify(opened, layers or None, checks, on_progress)
    if as_json:
        emit_json(report.model_dump(mode="json"))
    else:
        _show(report)
    return FOUND if report.findings else DONE


def _show(report: VerifyReport) -> None:
    for finding in [*report.repaired, *report.findings]:
        click.echo(_line(finding))
    for note in report.notes:
        click.echo(f"note: {note}", err=True)
    for layer in report.layers:
        if note := _seam_note(layer):
            click.echo(f"note: {layer.layer}: {note}", err=True)
    blocks = sum(layer.blocks for layer in report.layers)
    names = ", ".join(layer.layer for layer in report.layers)
    how = "digests only" if report.quick else "decoded"
    checked = f"{blocks} blocks of {names}, {format_bytes(sum(layer.stored_bytes for layer in report.layers))}, {how}"
    seams = sum(layer.seams_compared or 0 for layer in report.layers)
    checked += f", {len(report.repaired)} restored" if report.repaired else ""
    checked += f", {seams} borders" if seams else ""
    if report.findings:
        count = len(report.findings)
        click.echo(f"{report.dataset}: {count} finding{'s' * (count > 1)}; checked {checked}", err=True)
    else:
        click.echo(f"{report.dataset}: nothing wrong in {checked}")


def _line(finding: Finding) -> str:
    return f"{finding.place}  {finding.file}: {finding.what}; {finding.remedy}"


def _seam_note(layer: LayerCheck) -> str:
    """Say what a reader of the summary could not tell: that nothing was compared, or how far unbounded codecs are apart."""
    if layer.seams_compared is None or not layer.decoded:
        return ""
    if layer.pad == 0:
        return "no pad is stored, so there are no borders to compare"
    if layer.seam_tolerance is None and layer.seam_largest is not None:
        return f"borders are not bounded by the codec: largest difference {layer.seam_largest:g}"
    return ""
