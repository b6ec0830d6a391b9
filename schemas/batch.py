"""What became of the jobs of a batch: the document that ``clipmap batch --json`` prints."""

from typing import Literal

from pydantic import Field

from schemas.model import Model

JobOutcome = Literal["built", "continued", "updated", "up to date", "failed", "interrupted", "not begun"]


class JobReport(Model):
    """What became of one job."""

    sources: list[str]
    dataset: str = Field(description="Where the dataset is")
    layer: str | None = Field(description="Name of the layer; null if the job never got that far")
    outcome: JobOutcome
    blocks: int = Field(description="Blocks that the layer stores; 0 without a layer")
    blocks_written: int = Field(description="Blocks whose bytes this run stored")
    tasks: int = Field(description="Tasks of the build")
    tasks_kept: int = Field(description="Tasks that an earlier run had finished")
    stored_bytes: int = Field(description="Bytes of the layer's blocks [bytes]")
    wall_s: float = Field(description="Time of the job [seconds]")
    workers: int = Field(description="Threads it had")
    memory_bytes: int = Field(description="Memory that was set aside for it [bytes]")
    peak_rss_bytes: int = Field(description="Largest resident set of its process while it ran [bytes]")
    reason: str | None = Field(description="Why there is no new layer, and what to do; null if there is one")
    notes: list[str] = Field(description="Remarks, such as what is kept of a build that did not end")


class BatchReport(Model):
    """A whole batch: its jobs in the order they were given."""

    jobs: list[JobReport]
    failed: int = Field(description="Jobs that failed, were interrupted or could not begin")
    wall_s: float = Field(description="Time of the batch [seconds]")
    memory_bytes: int | None = Field(description="Memory that all jobs together were to stay within; null if there was no bound [bytes]")
