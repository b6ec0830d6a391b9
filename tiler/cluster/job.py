"""What another process needs to work on the tasks of a build: a job, put down beside the task records.

A process that finds it there shares the store with the build, and one that opens it makes sure that it would make the same
blocks: same files in the same state, same settings, same versions.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from secrets import token_hex
from typing import Final

from pydantic import Field, ValidationError

from schemas.errors import InputError, NotFoundError, StorageError, UsageError
from schemas.manifest import Manifest
from schemas.model import Model
from tiler.building.plan import Plan, plan_layer
from tiler.cluster.samplecopy import CopiedSamples
from tiler.samples.opening import open_samples
from tiler.sources.convert import SampleSource
from tiler.stores import Store
from tiler.stores.dataset import Dataset, read_manifest
from tiler.stores.locate import is_remote, open_store
from tiler.tasks.cut import Target
from tiler.tasks.destination import ChangedBlocks, Destination, NewBlocks
from tiler.tasks.records import TASKS, PlanRecord, RecordBook
from tiler.tasks.stamps import SourceStamps
from tiler.tasks.worker import TaskWorker

_NAME: Final = "job"


@dataclass(frozen=True, slots=True)
class JobRef:
    """Where a job lies: the location of its store, the key in it, and the token that tells one run of a build from every other."""

    location: str
    key: str
    token: str


class Job(Model):
    """One run of a build, as another process needs to know it."""

    token: str = Field(default_factory=lambda: token_hex(8), description="Tells this run of the build from every other")
    sources: list[str] = Field(description="Absolute paths, as they were given")
    record: PlanRecord
    path: str = Field(description="Prefix of the blocks")
    tasks_path: str = Field(description="Layer path under which the task records lie")
    update: bool = Field(description="Whether only blocks that differ from the published ones are stored")
    version: str | None = Field(description="Version of the dataset that is published while the build is at work; null if none is")
    copied: bool = Field(description="Whether the samples are copied into the store, because no other process can make them")

    def post(self, store: Store) -> JobRef:
        """Put the job down where other processes look for it, in place of one that a killed build left; raises StorageError."""
        key = f"{self.path}/{TASKS}/{_NAME}"
        # Not by pydantic, which has no NaN in JSON: --nodata nan would come out as no --nodata.
        store.write(key, json.dumps(self.model_dump()).encode())
        location = store.location if is_remote(store.location) else str(Path(store.location).absolute())
        return JobRef(location, key, self.token)


@dataclass(frozen=True, slots=True)
class OpenJob:
    """A job that this process can work on, from several threads, until it is closed."""

    worker: TaskWorker
    source: SampleSource

    def close(self) -> None:
        """Close the source files; nobody may be working."""
        self.source.close()


def make_target(plan: Plan, store: Store, path: str, published: Dataset | None) -> Target:
    """Return where the blocks of ``plan`` go: under ``path``; given a ``published`` dataset, only those that differ from its own."""
    destination: Destination
    if published is None:
        destination = NewBlocks(store, path, plan.name, plan.lattice.levels, plan.codec.suffix)
    else:
        destination = ChangedBlocks(store, path, published, plan.name)
    return Target(store, destination, plan.lattice, plan.block, plan.codec, plan.linear_light)


def open_job(ref: JobRef) -> OpenJob:
    """Open the source files of a job, or the copy of its samples, and make its plan anew.

    Raises StorageError if the job is not there or the dataset is another one than the build sees, InputError if a source file is,
    UsageError if this process would make other blocks; and whatever opening sources and stores raises.
    """
    store = open_store(ref.location)
    job = _read(store, ref)
    dataset = read_manifest(store)
    if (None if dataset is None else dataset.version) != job.version:
        raise StorageError(f"{ref.location}: a worker sees another version of the dataset than the build does; let all share one store")
    record = job.record
    plan, stamps = _planned(store, dataset, job)
    source = plan.source
    try:
        _check_same(record, stamps, plan)
        target = make_target(plan, store, job.path, Dataset(store, dataset) if dataset is not None and job.update else None)
        return OpenJob(TaskWorker(plan, target, RecordBook(store, job.tasks_path), stamps), source)
    except BaseException:
        source.close()
        raise


def _planned(store: Store, dataset: Manifest | None, job: Job) -> tuple[Plan, SourceStamps]:
    """Return the plan, its source open, and the state of the source; its tasks are those of the build."""
    record = job.record
    stamps: SourceStamps
    source: SampleSource
    if dataset is not None and (record.light is not None or record.normals is not None):
        plan, stamps = _planned_from_heights(Dataset(store, dataset), record)
        source = CopiedSamples(plan.source, store, job.path) if job.copied else plan.source
        return replace(plan, source=source, partition=record.partition), stamps
    source = open_samples([Path(path) for path in job.sources], store.scratch, record.settings, 1, lambda _: tuple(record.ranges) or None)
    try:
        stamps = SourceStamps(source.info)
        return replace(plan_layer(source, dataset, record.settings), partition=record.partition), stamps
    except BaseException:
        source.close()
        raise


def _planned_from_heights(dataset: Dataset, record: PlanRecord) -> tuple[Plan, SourceStamps]:
    """Return the plan of a layer of light or of normals, its source not yet baked, and the state of the heights."""
    if record.normals is not None:
        from tiler.building.normals import open_normals  # noqa: PLC0415 - it imports what puts jobs down

        plan, _, stamps = open_normals(dataset, record.normals.model_copy(update={"workers": 1}))
        return plan, stamps
    from tiler.building.light import open_light  # noqa: PLC0415 - as above

    if record.light is None:
        raise ValueError("a layer that comes from files")
    plan, _, stamps = open_light(dataset, record.light.model_copy(update={"workers": 1}))
    return plan, stamps


def _read(store: Store, ref: JobRef) -> Job:
    try:
        job = Job.model_validate(json.loads(store.read(ref.key)))
    except NotFoundError:
        job = None
    except (ValueError, ValidationError) as error:
        raise UsageError("a worker does not understand the build; install the same version of clipmap there as here") from error
    if job is None or job.token != ref.token:
        raise StorageError(
            f"{ref.location}: a worker sees another folder or store there than the build does; let all share one, under the same name"
        )
    return job


def _check_same(record: PlanRecord, stamps: SourceStamps, plan: Plan) -> None:
    for path, stamp, known in zip(stamps.paths, stamps.stamps, record.stamps, strict=False):
        if known != stamp:
            raise InputError(f"{path}: a worker sees another state of the file than the build does; let all read the same file")
    if difference := record.explain(plan.signature):
        raise UsageError(f"a worker would make other blocks ({difference} there); install the same versions on all machines")
