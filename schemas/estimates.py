"""What a build would make and take, before anything is written: the document that ``clipmap build --plan --json`` prints."""

from typing import Literal

from pydantic import Field

from schemas.manifest import LayerKind
from schemas.model import Model

PlannedAct = Literal["begin", "continue", "update", "nothing", "refuse"]


class LevelEstimate(Model):
    """One level as it would be stored."""

    level: int = Field(description="0 is the finest")
    width: int = Field(description="Columns [samples]")
    height: int = Field(description="Rows [samples]")
    columns: int = Field(description="Columns of blocks")
    rows: int = Field(description="Rows of blocks")
    blocks: int = Field(description="Blocks, blank ones included")
    stored: int = Field(description="Blocks that would have bytes, estimated")
    stored_bytes: int = Field(description="Bytes of the stored blocks, estimated [bytes]")
    encoded: int = Field(description="Blocks that were encoded for the estimate; 0: extrapolated from finer levels")


class Standing(Model):
    """What the build would do, given what lies at the output."""

    act: PlannedAct
    sentence: str = Field(description="The same for people; why, if it would be refused")
    tasks: int = Field(description="Tasks of the whole build")
    tasks_finished: int = Field(description="Tasks that an earlier run has left finished")


class SpaceEstimate(Model):
    """What the build would put into the store."""

    stored_bytes: int = Field(description="Bytes of all blocks [bytes]")
    stored_bytes_low: int = Field(description="Lower end of the range that holds the truth 19 times of 20 [bytes]")
    stored_bytes_high: int = Field(description="Upper end of that range [bytes]")
    sampled_share: float = Field(description="Share of level-0 samples that were encoded for the estimate, from 0 to 1")
    index_bytes: int = Field(description="Bytes of the block indexes [bytes]")
    record_bytes: int = Field(description="Bytes of the task records [bytes]")
    piece_bytes: int = Field(description="Bytes of the float32 samples that tasks hand on [bytes]")
    files: int = Field(description="Files or objects: blocks, indexes, records, pieces, manifest")
    folders: int = Field(description="Folders; none in an object store")
    occupied_bytes: int = Field(description="What all files occupy, rounded up to the units of the file system [bytes]")
    free_bytes: int | None = Field(description="Free on the file system of the output; null if unknown, as in an object store [bytes]")
    free_inodes: int | None = Field(description="Files and folders that the file system can still take; null if unknown or without limit")


class BuildEstimate(Model):
    """What a build would make and take on this machine."""

    sources: list[str]
    dataset: str = Field(description="Where the dataset is, or would be")
    layer: str = Field(description="Name of the layer")
    kind: LayerKind
    codec: str
    width: int = Field(description="Columns of level 0 [samples]")
    height: int = Field(description="Rows of level 0 [samples]")
    channels: int = Field(description="Channels of a stored sample, alpha included")
    block: int = Field(description="Side of a block's core [samples]")
    levels: list[LevelEstimate]
    standing: Standing
    space: SpaceEstimate
    workers: int = Field(description="Threads")
    memory_bytes: int = Field(description="Largest resident set of the process, estimated [bytes]")
    available_memory_bytes: int | None = Field(description="Memory that this process could still get; null if unknown [bytes]")
    time_s: float = Field(description="Time of the whole build, estimated from timed windows [seconds]")
    remaining_s: float = Field(description="Time of what is left to do [seconds]")
    warnings: list[str] = Field(description="What does not fit, and what the estimate does not know")
