"""Task records: what a build writes down of every task it has finished. Resume, update and repair are decided by them.

They lie in the store, under ``<path>/tasks`` of the layer they belong to: ``plan.json`` says what is built and how it is cut into
tasks, ``<level>/<y>/<x>.json`` is the record of the task whose core begins at sample (x, y) of that level, and ``.f32`` beside it
the float32 samples that it hands to the next tier. A task's record is written after all that it names, so it is the task's commit.
"""

import json
from base64 import b64decode, b64encode
from collections.abc import Collection, Iterator
from fractions import Fraction
from math import inf
from typing import Any, Final, Literal, Self, TypeVar

from pydantic import Field, JsonValue, ValidationError

from schemas.address import BlockAddress
from schemas.blockindex import RECORD_BYTES, BlockIndex, BlockRecord, pack_record
from schemas.errors import NotFoundError
from schemas.manifest import Digest, digest
from schemas.model import Model
from schemas.settings import BuildSettings, LightSettings, NormalSettings
from tiler.sources import Layout
from tiler.stores import Store
from tiler.tasks.cut import CutBlock
from tiler.tasks.partition import Task

TASKS: Final = "tasks"
Act = Literal["build", "update"]
Document = TypeVar("Document", bound=Model)


class Partition(Model):
    """How a layer is cut into tasks; the blocks do not depend on it, but the records do."""

    task: int = Field(description="Side of a task [level-0 samples]")
    layout: Layout = Field(description="How the source's pixels can be had")


class PlanRecord(Model):
    """What is built, from what, and how it is cut into tasks."""

    act: Act = Field(description="Whether all blocks lie under the path, or those that an update changes")
    signature: dict[str, JsonValue] = Field(description="Everything that a block's bytes depend on besides the source's pixels")
    place: dict[str, JsonValue] = Field(description="Where the layer lies; only the manifest depends on it")
    partition: Partition
    sources: list[str] = Field(description="Absolute paths of the source files, in the order in which they were given")
    stamps: list[str] = Field(description="State of every source file: path, size and time of change; empty while an update is published")
    settings: BuildSettings
    light: LightSettings | None = Field(default=None, description="What light is simulated, if the layer is one of light")
    normals: NormalSettings | None = Field(default=None, description="What normals are found, if the layer is one of normals")
    ranges: list[tuple[float, float]] = Field(default=[], description="What a stretch found to become 0 to 255, per channel")

    def explain(self, signature: dict[str, JsonValue], ignored: Collection[str] = ()) -> str:
        """Return in what this plan's signature differs from another one, for messages; '' if in nothing but what is ``ignored``."""
        both = (name for name in signature | self.signature if name not in ignored)
        names = [name for name in both if signature.get(name) != self.signature.get(name)]
        return ", ".join(f"{name} was {_said(self.signature.get(name))}, now {_said(signature.get(name))}" for name in names[:3])


def _said(value: JsonValue) -> str:
    return "none" if value is None else json.dumps(value).strip('"')


class TaskRecord(Model):
    """What went into a task and what came out."""

    plan: Digest = Field(description="Digest of the plan's signature")
    stamp: str = Field(description="State of the source files the task saw, or digest of the pieces of the tier below")
    content: Digest = Field(description="Digest of the pixels the task read, or the stamp again")
    blocks: str = Field(description="base64 of the 32-byte index records of the task's blocks: level by level, in row order")
    valid: int = Field(default=0, ge=0, description="Valid samples of level 0")
    minima: list[float] = Field(default=[], description="Smallest sample of level 0 per channel; empty if none is valid")
    maxima: list[float] = Field(default=[])
    sums: list[str] = Field(default=[], description="Exact sum of the samples of level 0 per channel, as a fraction")
    piece: Digest | None = Field(default=None, description="Digest of the samples handed to the next tier; null if there is none")

    @classmethod
    def of(cls, task: Task, blocks: list[CutBlock], **fields: Any) -> Self:  # noqa: ANN401 - the other fields, as they are
        """Return the record of a task that made ``blocks``, in any order."""
        order = sorted(blocks, key=lambda block: (block.address.level, block.address.y, block.address.x))
        packed = b"".join(pack_record(block.record) for block in order)
        finest = [block for block in order if block.address.level == 0 and not block.record.blank]
        channels = range(len(finest[0].sums)) if finest else range(0)
        return cls(
            blocks=b64encode(packed).decode(),
            valid=sum(block.record.valid for block in finest),
            minima=[min((block.minima[n] for block in finest), default=inf) for n in channels],
            maxima=[max((block.maxima[n] for block in finest), default=-inf) for n in channels],
            sums=[_exact_sum([block.sums[n] for block in finest]) for n in channels],
            **fields,
        )

    def index(self) -> BlockIndex:
        """Return the index records of the task's blocks."""
        data = b64decode(self.blocks)
        return BlockIndex(data, len(data) // RECORD_BYTES, "a task record")

    def entries(self, task: Task, side: int) -> Iterator[tuple[BlockAddress, BlockRecord]]:
        """Yield the task's blocks of ``side`` samples and their index records."""
        index = self.index()
        number = 0
        for level, rect in task.blocks(side):
            for y in range(rect.y0, rect.y1):
                for x in range(rect.x0, rect.x1):
                    yield BlockAddress(level, x, y), index[number]
                    number += 1


def _exact_sum(values: list[float]) -> str:
    """Return the sum as a fraction: exact, so that the order in which tasks are added up cannot matter; a float64 is a fraction."""
    if all(value.is_integer() for value in values):
        return str(sum(map(int, values)))  # those of 8- and 16-bit imagery, 20 times as fast
    return str(sum(map(Fraction, values), Fraction(0)))


def _check(key: str, record: object) -> str:
    """Return the digest that a record must have: builds rely on records, so a flipped bit must not go unnoticed."""
    return digest(f"{key}\n{json.dumps(record, sort_keys=True)}".encode())


class RecordBook:
    """The records of one layer in a store; safe to use from several threads and processes."""

    def __init__(self, store: Store, path: str) -> None:
        self._store = store
        self._prefix = f"{path}/{TASKS}"
        self.path = path

    def _key(self, task: Task, suffix: str) -> str:
        return f"{self._prefix}/{task.tier.first}/{task.core.y0}/{task.core.x0}.{suffix}"

    def plan(self) -> PlanRecord | None:
        """Return the plan; None if there is none, a damaged one, or one that this version does not understand."""
        return self._read(f"{self._prefix}/plan.json", PlanRecord)

    def write_plan(self, plan: PlanRecord) -> None:
        """Put the plan down."""
        self._write(f"{self._prefix}/plan.json", plan)

    def read(self, task: Task) -> TaskRecord | None:
        """Return a task's record; None if there is none, or a damaged one."""
        return self._read(self._key(task, "json"), TaskRecord)

    def write(self, task: Task, record: TaskRecord) -> None:
        """Put a task's record down: from now on the task counts as finished."""
        self._write(self._key(task, "json"), record)

    def _read(self, key: str, kind: type[Document]) -> Document | None:
        try:
            found = json.loads(self._store.read(key))
            return kind.model_validate(found["record"]) if found["check"] == _check(key, found["record"]) else None
        except (NotFoundError, ValidationError, ValueError, TypeError, KeyError):
            return None

    def _write(self, key: str, document: Model) -> None:
        # Not by pydantic, in whose JSON a nodata value of NaN would be none.
        record = json.loads(json.dumps(document.model_dump()))
        self._store.write(key, json.dumps({"check": _check(key, record), "record": record}, indent=1).encode())

    def read_piece(self, task: Task) -> bytes:
        """Return the bytes a task handed on; raises NotFoundError."""
        return self._store.read(self._key(task, "f32"))

    def write_piece(self, task: Task, data: bytes) -> None:
        """Put down what a task hands on."""
        self._store.write(self._key(task, "f32"), data)

    def finished(self) -> int:
        """Return how many tasks have a record."""
        return sum(key.endswith(".json") for key in self._store.keys(self._prefix)) - 1

    def delete(self) -> None:
        """Delete all records and pieces."""
        self._store.delete_prefix(self._prefix)
