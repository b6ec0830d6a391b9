"""What a build has to do, given what lies in the store: begin, continue, update, or nothing; and when it must refuse."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from schemas.errors import UsageError
from schemas.manifest import Layer, Manifest
from schemas.settings import BuildSettings
from tiler.plan import Plan
from tiler.records import PlanRecord, RecordBook
from tiler.sources.convert import SampleSource
from tiler.stamps import SourceStamps
from tiler.stores import Claim, Store
from tiler.stretch import Ranges

Act = Literal["build", "update", "nothing"]


@dataclass(frozen=True, slots=True)
class Intent:
    """What is to be done: ``path`` is where blocks go, ``tasks_path`` the layer path under which the task records lie.

    ``record`` is the plan that an earlier run wrote down, if this one goes on with it; ``obsolete`` are the prefixes that an
    unfinished build left and that nobody will want again.
    """

    act: Act
    path: str
    tasks_path: str
    record: PlanRecord | None
    obsolete: tuple[str, ...] = ()


def decide(store: Store, claim: Claim, dataset: Manifest | None, plan: Plan, stamps: SourceStamps, settings: BuildSettings) -> Intent:
    """Return what is to be done; raises UsageError if the settings contradict what lies in the store."""
    layer = None if dataset is None else dataset.layers.get(plan.name)
    last = _last_number(layer)
    left = sorted((path for path in claim.abandoned if layer_of(path) == plan.name and _number(path) > last), key=_number)
    if layer is not None and not settings.overwrite:
        return _beside(store, layer, plan, stamps, settings, left)
    for path in reversed(left):
        record = RecordBook(store, path).plan()
        if record is None:
            continue
        if difference := record.explain(plan.signature):
            if settings.overwrite:
                break
            raise UsageError(
                f"{store.location}: an unfinished build of layer {plan.name!r} with other settings lies there ({difference}); "
                "give the same settings to continue it, or add --overwrite to begin anew"
            )
        return Intent("build", path, path, record, tuple(other for other in left if other != path))
    path = _unused_path(store, plan.name, max([last, *map(_number, left)]))
    return Intent("build", path, path, None, tuple(left))


def find_ranges_known(store: Store, claim: Claim, dataset: Manifest | None, source: SampleSource, settings: BuildSettings) -> Ranges | None:
    """Return the ranges that an earlier build of the same files found for the same stretch, None if there was none.

    Raises UsageError if the layer is there with another stretch: before the whole source is read for nothing.
    """
    name = source.conversion.kind
    layer = None if dataset is None else dataset.layers.get(name)
    if layer is not None and not settings.overwrite:
        record = RecordBook(store, layer.path).plan()
        if record is not None and record.settings.stretch != settings.stretch:
            raise _other_settings(store, name, f"stretch was {record.settings.stretch or 'none'}, now {settings.stretch}")
    for path in [*(path for path in claim.abandoned if layer_of(path) == name), *([] if layer is None else [layer.path])]:
        record = RecordBook(store, path).plan()
        if record is None or record.stamps != SourceStamps(source.info).stamps:
            continue
        same = all(getattr(record.settings, field) == getattr(settings, field) for field in ("stretch", "bands", "nodata"))
        if same and record.ranges:
            return tuple(record.ranges)
    return None


def _other_settings(store: Store, name: str, difference: str) -> UsageError:
    return UsageError(
        f"{store.location}: has a layer {name!r} already, built with other settings ({difference}); add --overwrite to replace it, "
        "or choose another folder"
    )


def _beside(store: Store, layer: Layer, plan: Plan, stamps: SourceStamps, settings: BuildSettings, left: Sequence[str]) -> Intent:
    """Decide what becomes of a layer that is published already."""
    record = RecordBook(store, layer.path).plan()
    has = f"{store.location}: has a layer {plan.name!r} already"
    if record is None:
        raise UsageError(f"{has}, and no records of how it was built; add --overwrite to replace it, or choose another folder")
    if difference := record.explain(plan.signature):
        raise _other_settings(store, plan.name, difference)
    if record.stamps == stamps.stamps and record.place == plan.place:
        return Intent("nothing", layer.path, layer.path, record, tuple(left))
    if not settings.update:
        raise UsageError(
            f"{has}, and the source has changed since; add --update to rebuild what changed, --overwrite to rebuild all, "
            "or choose another folder"
        )
    path = left[-1] if left else _unused_path(store, plan.name, _last_number(layer))
    return Intent("update", path, layer.path, record, tuple(left[:-1]))


def layer_of(path: str) -> str:
    """Return the name of the layer that a prefix belongs to."""
    return path.partition(".")[0]


def can_be_continued(store: Store, dataset: Manifest | None, path: str) -> bool:
    """Whether an unfinished build under ``path`` is newer than what is published, and says what it builds."""
    layer = None if dataset is None else dataset.layers.get(layer_of(path))
    return _number(path) > _last_number(layer) and RecordBook(store, path).plan() is not None


def _last_number(layer: Layer | None) -> int:
    return 0 if layer is None else max(map(_number, layer.paths))


def _number(path: str) -> int:
    count = path.partition(".")[2] or "1"
    return int(count) if count.isdecimal() else 0


def _unused_path(store: Store, name: str, last: int) -> str:
    """Return a prefix that no version so far had and that nothing lies under.

    A reader of an old manifest then finds old blocks or none, never new ones, and nobody's files are in the way.
    """
    number = last + 1
    while store.keys(path := name if number == 1 else f"{name}.{number}"):
        number += 1
    return path
