"""What a build would do with what lies at its output: found out by reading only, without the lock."""

import os
from dataclasses import replace
from pathlib import Path

from schemas.errors import UsageError
from schemas.estimates import Standing
from schemas.manifest import Manifest
from schemas.settings import BuildSettings
from tiler.building.build import refuse_foreign
from tiler.building.intent import decide
from tiler.building.plan import Plan
from tiler.stores import Store
from tiler.stores.claims import CLAIM_NAME, MAX_CLAIM_BYTES, ClaimNote
from tiler.stores.locate import folder_of, is_remote
from tiler.stores.objects import ObjectStore
from tiler.tasks.records import RecordBook
from tiler.tasks.stamps import SourceStamps


class SeenClaim:
    """What the last build at ``output`` wrote down about itself, seen without holding the store."""

    def __init__(self, store: Store, output: str | Path) -> None:
        self.note, self.at_work = _note(store, output)
        note = self.note
        self.abandoned = () if note is None else note.prefixes
        self.predecessor = note.left_by() if note is not None and note.prefixes else None

    def announce(self, *prefixes: str) -> None:
        """Raise UsageError."""
        raise UsageError("a plan announces nothing")

    def confirm(self) -> None:
        """Do nothing: nothing is held."""


def find_standing(
    store: Store, claim: SeenClaim, output: str | Path, dataset: Manifest | None, plan: Plan, stamps: SourceStamps, settings: BuildSettings
) -> Standing:
    """Return what ``build_layer`` would do at ``output`` if nothing changes until then; writes nothing, holds nothing."""
    if claim.at_work:
        who = f" ({claim.note.at_work()})" if claim.note is not None else ""
        return _refused(plan, f"{store.location}: another build is writing there{who}; wait until it has ended")
    try:
        if not is_remote(output):
            _require_writable(folder_of(output))
        if dataset is None:
            refuse_foreign(store, claim)
        intent = decide(store, claim, dataset, plan, stamps, settings)
    except UsageError as error:
        return _refused(plan, str(error))
    tasks = plan.task_count if intent.record is None else replace(plan, partition=intent.record.partition).task_count
    if intent.act is None:
        return Standing(act="nothing", sentence="up to date: nothing to do", tasks=tasks, tasks_finished=tasks)
    if intent.act == "update":
        sentence = "update: read the whole source, rebuild the tasks whose pixels have changed"
        return Standing(act="update", sentence=sentence, tasks=tasks, tasks_finished=0)
    if intent.record is None:
        replaced = dataset is not None and plan.name in dataset.layers
        return Standing(act="begin", sentence="begin anew, replace the layer" if replaced else "begin", tasks=tasks, tasks_finished=0)
    finished = max(0, min(RecordBook(store, intent.tasks_path).finished(), tasks))
    left = "" if claim.predecessor is None else f", with what {claim.predecessor} left"
    return Standing(
        act="continue", sentence=f"continue{left}: {finished} of {tasks} tasks are finished", tasks=tasks, tasks_finished=finished
    )


def _refused(plan: Plan, sentence: str) -> Standing:
    return Standing(act="refuse", sentence=f"refuse: {sentence}", tasks=plan.task_count, tasks_finished=0)


def nearest_folder(folder: Path) -> Path:
    """Return ``folder``, or the nearest one above it that exists."""
    absolute = folder.absolute()
    return next(each for each in (absolute, *absolute.parents) if each.exists())


def _require_writable(folder: Path) -> None:
    nearest = nearest_folder(folder)
    if not nearest.is_dir():
        raise UsageError(f"{nearest}: a file is in the way; choose another folder")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise UsageError(f"{nearest}: cannot be written; choose another folder, or let it be made writable")


def _note(store: Store, output: str | Path) -> tuple[ClaimNote | None, bool]:
    """Return what the last build wrote down about itself, and whether it is at work."""
    if isinstance(store, ObjectStore):
        note = store.claim_note()
        return note, note is not None and note.held
    if is_remote(output):
        return None, False
    try:
        with (folder_of(output) / CLAIM_NAME).open("rb") as file:
            return ClaimNote.parse(file.read(MAX_CLAIM_BYTES)), _is_locked(os.fstat(file.fileno()))
    except OSError:
        return None, False


def _is_locked(file: os.stat_result) -> bool:
    """Whether the kernel holds a lock on a file; asked of its table: trying to lock would make a build that begins just now fail."""
    place = f"{os.major(file.st_dev):02x}:{os.minor(file.st_dev):02x}:{file.st_ino}"
    try:
        lines = Path("/proc/locks").read_text().splitlines()
    except OSError:
        return False
    return any(line.split()[1:2] == ["FLOCK"] and place in line.split() for line in lines)
