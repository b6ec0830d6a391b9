"""What ``clipmap verify`` and ``clipmap diff`` found, as typed documents; ``--json`` prints them as they are."""

from typing import Literal

from pydantic import Field, JsonValue

from schemas.manifest import Digest
from schemas.model import Model

FindingKind = Literal[
    "codec", "index", "availability", "counts", "missing", "unreadable", "length", "digest", "undecodable", "statistics", "seam", "stray"
]


class Finding(Model):
    """One thing that is wrong: what, where, and what to do about it."""

    kind: FindingKind
    layer: str
    level: int | None = Field(description="null if it concerns the whole layer")
    x: int | None = Field(description="Column of the block; null if it concerns no single block")
    y: int | None = Field(description="Row of the block")
    file: str = Field(description="Key in the store, the path below the dataset")
    what: str = Field(description="What is wrong")
    remedy: str = Field(description="What to do")

    @property
    def place(self) -> str:
        """The layer, level or block concerned, in the form that ``clipmap inspect`` takes: ``height/0/3/1``."""
        return "/".join(str(part) for part in (self.layer, self.level, self.x, self.y) if part is not None)


class LayerCheck(Model):
    """How much of a layer was checked."""

    layer: str
    blocks: int = Field(description="Blocks checked, blank ones included")
    stored_bytes: int = Field(description="Bytes read and compared with their digest [bytes]")
    decoded: bool = Field(description="Whether blocks were decoded and compared with the index's statistics")
    pad: int = Field(description="Stored border of a block [samples]")
    seams_compared: int | None = Field(description="Borders compared with the neighbour's core; null if that was not asked for")
    seam_tolerance: float | None = Field(description="Largest difference allowed there [unit of a sample]; null if not bounded")
    seam_largest: float | None = Field(description="Largest difference seen there [unit of a sample]; null if none was compared")


class VerifyReport(Model):
    """The outcome of a verification: nothing is wrong if there are no findings."""

    dataset: str
    version: Digest
    quick: bool = Field(description="Whether decoding was left out")
    layers: list[LayerCheck]
    findings: list[Finding]
    repaired: list[Finding] = Field(default=[], description="What --repair mended, and what is no finding any more")
    notes: list[str] = Field(default=[], description="Why --repair could not mend what is left")


class FieldDifference(Model):
    """A field of the manifest that differs; names of nested fields are joined by dots."""

    field: str
    a: JsonValue
    b: JsonValue


class LevelDifference(Model):
    """How the blocks of a level differ."""

    level: int
    blocks: int = Field(description="Blocks of the level")
    differing: int = Field(description="Blocks whose stored bytes differ, or that are blank in one dataset only")
    first: list[str] = Field(description="Addresses of the first of them in row order")
    largest: float | None = Field(description="Largest difference of a decoded sample that is valid in both; null if there is none")
    rms: float | None = Field(description="Root of the mean square of these differences, over the differing blocks")
    valid_in_one: int | None = Field(description="Samples that are valid in one dataset only; null if samples could not be compared")


class LayerDifference(Model):
    """How a layer that both datasets have differs."""

    layer: str
    fields: list[FieldDifference]
    not_compared: str | None = Field(description="Why samples were not compared; null if they were")
    levels: list[LevelDifference] = Field(description="Empty if the lattices differ")


class DiffReport(Model):
    """How two datasets differ."""

    a: str = Field(description="Where the first dataset is")
    b: str
    version_a: Digest
    version_b: Digest
    same: bool = Field(description="Whether fields and blocks are equal; where blocks lie and who wrote them does not count")
    world: list[FieldDifference]
    only_in_a: list[str] = Field(description="Layers that the second dataset lacks")
    only_in_b: list[str]
    layers: list[LayerDifference]
