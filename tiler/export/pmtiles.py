"""A layer as a PMTiles archive: the archive form of a dataset's layer, blocks as they are."""

from pathlib import Path

from tiler.archives.writing import write_archive
from tiler.export import Exported, Job
from tiler.stores.dataset import Dataset


def write_pmtiles(dataset: Dataset, name: str, target: Path, job: Job) -> Exported:
    """Write layer ``name`` to the file ``target``; raises what ``tiler.archives.writing.write_archive`` raises."""
    report = write_archive(dataset, name, target, job.on_progress, workers=job.workers)
    return Exported(levels=len(dataset.manifest.layer(name).levels), copied=report.tiles, stored_bytes=report.file_bytes)
