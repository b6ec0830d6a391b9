"""What a build has to do, given what lies in the store: begin, continue, update, or nothing; and when it must refuse."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from schemas.errors import NotFoundError, UsageError
from schemas.manifest import Layer, Manifest
from schemas.settings import BuildSettings
from tiler.building.plan import Plan
from tiler.samples.stretch import Ranges
from tiler.sources.convert import SampleSource
from tiler.stores import Claim, Store
from tiler.tasks.records import Act, PlanRecord, RecordBook
from tiler.tasks.stamps import SourceStamps

_OR: Final = "or choose another folder"


@dataclass(frozen=True, slots=True)
class Intent:
    """What is to be done: ``path`` is where blocks go, ``tasks_path`` the layer path under which the task records lie.

    ``record`` is the plan that an earlier run wrote down, if this one goes on with it. Of what builds that did not end have left,
    the prefixes ``kept`` stay for whoever continues them, and ``obsolete`` are deleted in the end.
    """

    act: Act | None
    path: str
    tasks_path: str
    record: PlanRecord | None
    kept: tuple[str, ...] = ()
    obsolete: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class _Left:
    """What builds of this layer that did not end have left, the newest first, and what is left of other layers."""

    plans: dict[str, PlanRecord]
    foreign: tuple[str, ...]
    abandoned: tuple[str, ...]

    def of(self, act: Act) -> list[str]:
        """Return the prefixes of builds that were to do ``act``."""
        return [path for path, plan in self.plans.items() if plan.act == act]

    def split(self, kept: Sequence[str], path: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return what stays besides the layers of others, and what becomes obsolete when the build works under ``path``."""
        stays = (*self.foreign, *(each for each in kept if each != path))
        return stays, tuple(each for each in self.abandoned if each not in stays and each != path)


def decide(store: Store, claim: Claim, dataset: Manifest | None, plan: Plan, stamps: SourceStamps, settings: BuildSettings) -> Intent:
    """Return what is to be done; raises UsageError if the settings contradict what lies in the store."""
    layer = None if dataset is None else dataset.layers.get(plan.name)
    left = _look(store, claim, dataset, plan.name)
    if layer is not None and not settings.overwrite:
        return _beside(store, layer, plan, stamps, settings, left)
    path, record = _unused_path(store, plan.name, [*claim.abandoned, *([] if layer is None else layer.paths)]), None
    if unfinished := left.of("build"):
        found = left.plans[unfinished[0]]
        difference = found.explain(plan.signature)
        if difference and not settings.overwrite:
            raise UsageError(
                f"{store.location}: an unfinished build of layer {plan.name!r} with other settings lies there ({difference}); "
                "give the same settings to continue it, or add --overwrite to begin anew"
            )
        if not difference:
            path, record = unfinished[0], found
    kept, obsolete = left.split([], path)
    return Intent("build", path, path, record, kept, obsolete)


def _look(store: Store, claim: Claim, dataset: Manifest | None, name: str) -> _Left:
    plans, foreign = {}, []
    for path in sorted(claim.abandoned, key=_number, reverse=True):
        layer = None if dataset is None else dataset.layers.get(layer_of(path))
        # What is not newer than the published layer was replaced by it.
        plan = RecordBook(store, path).plan() if _number(path) > max(map(_number, layer.paths if layer else []), default=0) else None
        if plan is not None and layer_of(path) == name:
            plans[path] = plan
        elif plan is not None:
            foreign.append(path)
    return _Left(plans, tuple(foreign), claim.abandoned)


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
    stamps = SourceStamps(source.info).stamps
    for path in [*(path for path in claim.abandoned if layer_of(path) == name), *([] if layer is None else [layer.path])]:
        record = RecordBook(store, path).plan()
        if record is None or record.stamps != stamps:
            continue
        same = all(getattr(record.settings, field) == getattr(settings, field) for field in ("stretch", "bands", "nodata"))
        if same and record.ranges:
            return tuple(record.ranges)
    return None


def _other_settings(store: Store, name: str, difference: str) -> UsageError:
    return UsageError(
        f"{store.location}: has a layer {name!r} already, built with other settings ({difference}); add --overwrite to replace it, {_OR}"
    )


def _beside(store: Store, layer: Layer, plan: Plan, stamps: SourceStamps, settings: BuildSettings, left: _Left) -> Intent:
    """Decide what becomes of a layer that is published already."""
    record = RecordBook(store, layer.path).plan()
    has = f"{store.location}: has a layer {plan.name!r} already"
    if record is None:
        raise UsageError(f"{has}, and no records of how it was built; add --overwrite to replace it, {_OR}")
    if difference := record.explain(plan.signature):
        if difference.startswith("stretch ") and record.settings.stretch == settings.stretch:
            raise UsageError(
                f"{has}, and the changed source gives another range to --stretch {settings.stretch}, which concerns every sample; "
                f"add --overwrite to rebuild all of it with the new range, or fix the range with --stretch MIN,MAX, {_OR}"
            )
        raise _other_settings(store, plan.name, difference)
    rebuilds = left.of("build")
    remarks = tuple(
        f"an unfinished rebuild of the layer lies under {path}; --overwrite goes on with it or begins anew" for path in rebuilds
    )
    if record.stamps == stamps.stamps and record.place == plan.place:
        return Intent(None, layer.path, layer.path, record, *left.split(rebuilds, layer.path), remarks)
    if not settings.update:
        raise UsageError(
            f"{has}, {_what_changed(record, plan, stamps)}; add --update to rebuild what changed, --overwrite to rebuild all, {_OR}"
        )
    updates = [path for path in left.of("update") if left.plans[path].signature == plan.signature]
    path = updates[0] if updates else _unused_path(store, plan.name, [*left.abandoned, *layer.paths])
    return Intent("update", path, layer.path, record, *left.split(rebuilds, path), remarks)


def _what_changed(record: PlanRecord, plan: Plan, stamps: SourceStamps) -> str:
    if not record.stamps:
        return "and an update of it was interrupted at its very end"
    return (
        "and the source has changed since, or is another file" if record.stamps != stamps.stamps else "and lies elsewhere in the world now"
    )


def layer_of(path: str) -> str:
    """Return the name of the layer that a prefix belongs to."""
    return path.partition(".")[0]


def _number(path: str) -> int:
    count = path.partition(".")[2] or "1"
    return int(count) if count.isdecimal() else 0


def _unused_path(store: Store, name: str, used: Sequence[str]) -> str:
    """Return a prefix that no version so far had, and under which or in place of which nothing lies.

    A reader of an old manifest then finds old blocks or none, never new ones, and nobody's files are in the way.
    """
    number = 1 + max((_number(path) for path in used if layer_of(path) == name), default=0)
    while _is_occupied(store, path := name if number == 1 else f"{name}.{number}"):
        number += 1
    return path


def _is_occupied(store: Store, path: str) -> bool:
    try:
        store.read(path)
    except NotFoundError:
        return bool(store.keys(path))
    return True
