"""What a build writes down about itself while it holds a store: who, where, since when, and what it is at work on.

One line of JSON, in a file of a directory or in an object of an object store. What follows the first line does not count, so a
longer note that is overwritten by a shorter one, and not cut off before the machine fails, is still understood.
"""

import getpass
import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Final, Self

CLAIM_NAME: Final = ".clipmap-lock"
"""File or object of the note; hidden, so no key."""
MAX_CLAIM_BYTES: Final = 65536
"""A longer one is no note of ours; not read."""

_FORMAT: Final = "clipmap build"
_PREFIX: Final = re.compile(r"[a-z0-9][a-z0-9_.-]*(/[a-z0-9][a-z0-9_.-]*)*")
_UNPRINTABLE: Final = re.compile(r"[^\w.@+-]")
_LONGEST_NAME: Final = 64
_CLOCKS_DIFFER_S: Final = 60.0
"""How far a note may lie in the future before the message says so: clocks that are kept by a time service agree far better."""


def utc_now() -> datetime:
    """Return the time of this machine's clock."""
    return datetime.now(UTC)


@dataclass(frozen=True, slots=True)
class ClaimNote:
    """Who holds, or held, a store, and which prefixes are not finished."""

    process: str
    machine: str = ""
    user: str = ""
    begun: datetime | None = None
    prefixes: tuple[str, ...] = ()
    held: bool = True
    """Only of use where no kernel keeps the lock: whether the build is at work, as far as it could tell us."""
    token: str = ""
    """Tells one claim from every other, so that a build knows its own note again."""
    sign_of_life: datetime | None = None

    @classmethod
    def mine(cls) -> Self:
        """Return the note of this process, begun now."""
        return cls(process=str(os.getpid()), machine=os.uname().nodename, user=_user(), begun=utc_now(), token=os.urandom(16).hex())

    @classmethod
    def parse(cls, data: bytes) -> Self | None:
        """Return what is written down in ``data``; None if that is no note of a build. Raises nothing: anybody may have written it."""
        lines = data[:MAX_CLAIM_BYTES].decode("utf-8", "replace").splitlines()
        if len(lines) > 1 and lines[0] == _FORMAT:  # the first form: process, then a prefix per line
            return cls(process=_name(lines[1]), prefixes=_prefixes(lines[2:]), held=False)
        try:
            fields = json.loads(lines[0]) if lines else None
        except (ValueError, RecursionError):
            return None
        if not isinstance(fields, dict) or fields.get("format") != _FORMAT:
            return None
        listed = fields.get("prefixes")
        return cls(
            process=_name(fields.get("process")),
            machine=_name(fields.get("machine")),
            user=_name(fields.get("user")),
            begun=_time(fields.get("begun")),
            prefixes=_prefixes(listed if isinstance(listed, list) else []),
            held=fields.get("held") is not False,
            token=_name(fields.get("token")),
            sign_of_life=_time(fields.get("sign_of_life")),
        )

    def dump(self) -> bytes:
        """Return the note as it is stored; ``parse`` reads it."""
        fields: Mapping[str, object] = {
            "format": _FORMAT,
            "process": self.process,
            "machine": self.machine,
            "user": self.user,
            "begun": _text(self.begun),
            "held": self.held,
            "sign_of_life": _text(self.sign_of_life),
            "token": self.token,
            "prefixes": list(self.prefixes),
        }
        return (json.dumps(fields) + "\n").encode()

    @property
    def elsewhere(self) -> bool:
        """Whether the note was written on another machine than this one."""
        return self.machine not in ("", os.uname().nodename)

    @property
    def is_gone(self) -> bool:
        """Whether the process that wrote the note is certain to have ended: on this machine, and no such process is there."""
        if self.elsewhere or not self.machine or not self.process.isdecimal():
            return False
        try:
            os.kill(int(self.process), 0)
        except ProcessLookupError:
            return True
        except (OSError, OverflowError):
            return False
        return False

    def at_work(self) -> str:
        """Return who is at work and for how long: 'process 123 of maria on a1, for 3 h 12 min, since 2026-11-22 18:50 UTC'."""
        who = f"process {self.process or 'unknown'}"
        who += f" of {self.user}" if self.user else ""
        who += f" on {self.machine}" if self.machine else ""
        if self.begun is None:
            return who
        age_s = (utc_now() - self.begun).total_seconds()
        if age_s < -_CLOCKS_DIFFER_S:
            return f"{who}, since {_minute(self.begun)}, which is still to come by the clock of this machine"
        return f"{who}, for {duration(age_s)}, since {_minute(self.begun)}"

    def left_by(self) -> str:
        """Return who had it: 'process 123 on a1, begun 2026-11-22 18:50 UTC'."""
        where = f" on {self.machine}" if self.machine else ""
        begun = f", begun {_minute(self.begun)}" if self.begun else ""
        return f"process {self.process or 'unknown'}{where}{begun}"


def duration(seconds: float) -> str:
    """Return a time span for people, in its two largest units: '40 s', '12 min', '3 h 12 min', '2 d 3 h'; none is negative."""
    whole = max(0, int(seconds))
    if whole < 60:
        return f"{whole} s"
    minutes = whole // 60
    if minutes < 60:
        return f"{minutes} min"
    if minutes < 24 * 60:
        return f"{minutes // 60} h {minutes % 60} min"
    return f"{minutes // (24 * 60)} d {minutes // 60 % 24} h"


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a number without a name, as in many containers; OSError since Python 3.13
        return str(os.getuid())


def _name(value: object) -> str:
    """Return a name from a note as it may stand in a message."""
    return _UNPRINTABLE.sub("?", str(value))[:_LONGEST_NAME] if isinstance(value, (str, int)) else ""


def _prefixes(listed: list[object] | list[str]) -> tuple[str, ...]:
    # Only names that a build can have given: what stands here is deleted by the next build.
    return tuple(entry for entry in listed if isinstance(entry, str) and _PREFIX.fullmatch(entry))


def _text(time: datetime | None) -> str | None:
    return None if time is None else time.isoformat(timespec="milliseconds")


def _time(value: object) -> datetime | None:
    try:
        time = datetime.fromisoformat(value) if isinstance(value, str) else None
        return None if time is None or time.tzinfo is None else time.astimezone(UTC)
    except (ValueError, OverflowError):
        return None


def _minute(time: datetime) -> str:
    return time.strftime("%Y-%m-%d %H:%M UTC")
