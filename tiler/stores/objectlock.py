"""The lock of an object store: an object, made and changed by conditional puts, with a sign of life while its build is at work.

No kernel knows the lock, so it outlives a process that is killed. Whether that has happened nobody can know for certain; what can be
known is how long ago the holder last refreshed the object. So a second build is told that, and takes the lock over only when it is
told to, only after a long silence, and only if the silence goes on while it watches. A holder that was suspended, not killed, finds
out with its next conditional put.
"""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Any, Final

from schemas.errors import NotFoundError, StorageError
from tiler.stores.claims import CLAIM_NAME, MAX_CLAIM_BYTES, ClaimNote, duration, utc_now

Failing = Callable[[str, str], AbstractContextManager[None]]
"""(key, what cannot be done) to a context that turns obstore's errors into ours."""

_ATTEMPTS: Final = 5
"""How often a lock may change under our hands before we say that it is fought over."""
_CLOCKS_DIFFER_S: Final = 60.0
"""S3 refuses requests from clocks that are 15 min off; one that is 1 min off is worth a word."""


@dataclass(frozen=True, slots=True)
class LockTimes:
    """How often a holder shows that it lives, when it is thought dead, and how long its silence is watched before it is dispossessed."""

    refresh_s: float = 30.0
    stale_s: float = 300.0
    watch_s: float = 35.0
    """Longer than ``refresh_s``: a holder that lives shows it meanwhile, whatever the clocks say."""


DEFAULT_TIMES: Final = LockTimes()

_CONFLICTS: Final = ("AlreadyExistsError", "PreconditionError")


class _LostError(Exception):
    """A conditional put found another state of the object than it had expected."""


@dataclass(frozen=True, slots=True)
class _Seen:
    """The lock object as it was read."""

    note: ClaimNote | None
    version: dict[str, str]
    modified: datetime

    @property
    def held(self) -> bool:
        """Whether its build was at work when it last wrote; what is no note of a build holds nothing."""
        return self.note is not None and self.note.held

    @property
    def silent_s(self) -> float:
        """Seconds since the store last took a sign of life, by its clock and ours."""
        return (utc_now() - self.modified).total_seconds()


class _LockObject:
    """Reads and conditional writes of the lock object."""

    def __init__(self, objects: Any, location: str, failing: Failing) -> None:  # noqa: ANN401 - obstore is an extra
        self._objects, self.location, self._failing = objects, location, failing

    def read(self) -> _Seen | None:
        """Return what is there, None if nothing is; raises StorageError."""
        try:
            with self._failing(CLAIM_NAME, "the lock cannot be read"):
                found = self._objects.get(CLAIM_NAME)
                meta = found.meta
                note = None if meta["size"] > MAX_CLAIM_BYTES else ClaimNote.parse(found.bytes().to_bytes())
        except NotFoundError:
            return None
        return _Seen(note, _version(meta), meta["last_modified"])

    def put(self, note: ClaimNote, expected: dict[str, str] | None) -> dict[str, str]:
        """Write ``note`` if the object still has the version ``expected`` (None: if there is none); return its new version.

        Raises _LostError if it has not, StorageError if it cannot be written.
        """
        with self._failing(CLAIM_NAME, "the lock cannot be written"):
            try:
                return _version(
                    self._objects.put(
                        CLAIM_NAME,
                        replace(note, sign_of_life=utc_now()).dump(),
                        mode="create" if expected is None else expected,
                        use_multipart=False,
                    )
                )
            except Exception as error:
                if type(error).__name__ in _CONFLICTS:
                    raise _LostError from error
                raise

    def delete(self) -> None:
        """Delete the object; raises StorageError."""
        with suppress(NotFoundError), self._failing(CLAIM_NAME, "the lock cannot be deleted"):
            self._objects.delete(CLAIM_NAME)


def _version(fields: Any) -> dict[str, str]:  # noqa: ANN401 - obstore is an extra
    """Return what names a state of an object for a conditional put: S3 and Azure take the entity tag, Google the version."""
    return {name: fields[name] for name in ("e_tag", "version") if fields.get(name) is not None}


def read_note(objects: Any, location: str, failing: Failing) -> ClaimNote | None:  # noqa: ANN401 - obstore is an extra
    """Return what the lock object says, None if there is none or it is no note of a build; raises StorageError."""
    seen = _LockObject(objects, location, failing).read()
    return None if seen is None else seen.note


class ObjectClaim:
    """A build's hold on an object store; ``confirm`` before a manifest is published tells whether it still is one."""

    def __init__(self, lock: _LockObject, note: ClaimNote, version: dict[str, str], left: ClaimNote | None) -> None:
        self._lock, self._note, self._version = lock, note, version
        self._turn = threading.Lock()
        self._lost_to: ClaimNote | None = None
        self._lost = False
        self.abandoned = () if left is None else left.prefixes
        self.predecessor = left.left_by() if left is not None and left.prefixes else None

    def announce(self, *prefixes: str) -> None:
        """Write down the prefixes that are no dataset's until the build has ended; raises StorageError, also if the hold is lost."""
        self._put(replace(self._note, prefixes=prefixes))

    def confirm(self) -> None:
        """Refresh the lock; raises StorageError if another build has taken it over."""
        self._put(self._note)

    def release(self) -> None:
        """Give up the lock, or leave it with what is announced, for the next build to find; raises StorageError."""
        if self._lost:
            return
        if self._note.prefixes:
            self._put(replace(self._note, held=False))
            return
        # There is no conditional delete. The put just before makes sure that the lock is ours and fresh: nobody may take it over now.
        self._put(self._note)
        self._lock.delete()

    def _put(self, note: ClaimNote) -> None:
        with self._turn:
            if not self._lost and not self._put_over(note, self._version):
                # A first try may have been done although its answer was lost, and was then repeated.
                seen = self._lock.read()
                ours = seen is not None and seen.note is not None and seen.note.token == note.token
                if seen is None or not ours or not self._put_over(note, seen.version):
                    self._lost, self._lost_to = True, None if seen is None else seen.note
            if self._lost:
                raise StorageError(f"{self._lock.location}: {self._thief()}; this build stops")

    def _put_over(self, note: ClaimNote, version: dict[str, str]) -> bool:
        try:
            self._version = self._lock.put(note, version)
        except _LostError:
            return False
        self._note = note
        return True

    def _thief(self) -> str:
        if self._lost_to is None:
            return "the lock of this build was deleted meanwhile"
        return f"the lock was taken over by another build meanwhile ({self._lost_to.at_work()})"


@contextmanager
def held(objects: Any, location: str, failing: Failing, times: LockTimes, break_stale: bool) -> Iterator[ObjectClaim]:  # noqa: ANN401
    """Hold the lock of an object store; raises StorageError if somebody else has it, or if it cannot be given up in the end."""
    claim = _acquire(_LockObject(objects, location, failing), times, break_stale)
    ended = threading.Event()
    # A daemon: when the main thread has died, the process shall end, and the signs of life with it.
    life = threading.Thread(target=_show_life, args=(claim, ended, times.refresh_s), name="clipmap-lock", daemon=True)
    life.start()
    try:
        yield claim
    except BaseException:
        _stop(ended, life)
        with suppress(StorageError):  # why the build failed is what counts
            claim.release()
        raise
    _stop(ended, life)
    claim.release()


def _stop(ended: threading.Event, life: threading.Thread) -> None:
    ended.set()
    life.join()


def _show_life(claim: ObjectClaim, ended: threading.Event, refresh_s: float) -> None:
    while not ended.wait(refresh_s):
        with suppress(StorageError):  # tried again; and a hold that is lost is the business of whoever announces or confirms
            claim.confirm()


def _acquire(lock: _LockObject, times: LockTimes, break_stale: bool) -> ObjectClaim:
    mine = ClaimNote.mine()
    left: ClaimNote | None = None
    for _ in range(_ATTEMPTS):
        seen = lock.read()
        if seen is None or seen.note is None or seen.note.token != mine.token:  # ours, if the answer to a first try was lost
            if seen is not None and seen.held and not (break_stale and _has_died(lock, seen, times)):
                raise StorageError(_at_work(lock.location, seen, times, break_stale))
            left = None if seen is None else seen.note
        note = replace(mine, prefixes=() if left is None else left.prefixes)
        try:
            version = lock.put(note, None if seen is None else seen.version)
        except _LostError:
            continue
        return ObjectClaim(lock, note, version, left)
    raise StorageError(f"{lock.location}: several builds are after its lock; start one, and wait until it has ended")


def _has_died(lock: _LockObject, seen: _Seen, times: LockTimes) -> bool:
    """Whether a lock is old enough to be broken, and its object does not change while it is watched."""
    if seen.silent_s < times.stale_s:
        return False
    time.sleep(times.watch_s)
    again = lock.read()
    return again is not None and again.version == seen.version


def _at_work(location: str, seen: _Seen, times: LockTimes, break_stale: bool) -> str:
    """Return the sentence for a build that comes second."""
    who = seen.note.at_work() if seen.note is not None else "unknown"
    sentence = f"{location}: another build is writing here ({who}); "
    if seen.silent_s < -_CLOCKS_DIFFER_S:
        ahead = duration(-seen.silent_s)
        return f"{sentence}its last sign of life lies {ahead} ahead of this machine's clock: set the clock right, and try again"
    silence = duration(seen.silent_s)
    if seen.silent_s < times.stale_s:
        refused = f"; --break-lock is for one that has shown none for {duration(times.stale_s)}" if break_stale else ""
        return f"{sentence}its last sign of life came {silence} ago: wait until it has ended{refused}"
    if break_stale:
        return f"{sentence}it was silent for {silence}, but has just shown a sign of life: wait until it has ended"
    return (
        f"{sentence}it has shown no sign of life for {silence} and has probably died: make sure that it has, "
        "then build again with --break-lock"
    )
