"""Where blocks lie: the store contract and its implementations. Light to import: a server needs nothing else of tiler."""

from collections.abc import Iterable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Protocol


class Claim(Protocol):
    """A build's hold on a store: what an earlier build left unfinished, and what this one announces to be at work on."""

    @property
    def abandoned(self) -> tuple[str, ...]:
        """The prefixes that a build which did not end properly had announced; none if there was no such build."""
        ...

    @property
    def predecessor(self) -> str | None:
        """Who left them, for messages, e.g. 'process 123 on a1, begun 2026-11-22 18:50 UTC'; None if nobody did."""
        ...

    def announce(self, *prefixes: str) -> None:
        """Write down the prefixes that are no dataset's until the build has ended; replaces what was announced before.

        Raises StorageError if that cannot be done, or if the hold was lost.
        """
        ...

    def confirm(self) -> None:
        """Make sure that the hold is still there, e.g. before a manifest is published; raises StorageError that says who has it."""
        ...


class Store(Protocol):
    """A flat key-value store of byte strings; keys are relative paths with '/' between their parts.

    Every implementation passes ``tests/contract/test_stores.py``.
    """

    def read(self, key: str) -> bytes:
        """Return the bytes under ``key``; raises NotFoundError if there are none, StorageError if they cannot be read."""
        ...

    def write(self, key: str, data: bytes) -> None:
        """Put ``data`` under ``key`` so that a reader sees the old bytes or the new ones, never a part; raises StorageError."""
        ...

    def delete(self, keys: Iterable[str]) -> None:
        """Delete what lies under ``keys``; a key under which there is nothing is no error; raises StorageError."""
        ...

    def delete_prefix(self, prefix: str) -> None:
        """Delete every key that begins with ``prefix`` and '/'; none is no error; raises StorageError."""
        ...

    def keys(self, prefix: str) -> list[str]:
        """Return the keys that begin with ``prefix`` and '/', sorted; '' means all."""
        ...

    def exclusive(self, break_stale: bool = False) -> AbstractContextManager[Claim]:
        """Keep other builds out of the store as long as the context lasts; raises StorageError that says who is at work there.

        The prefixes announced last stay announced if the context is left while they are, and are the next build's
        ``abandoned``; ``announce()`` with none says that all is done. ``break_stale`` takes over the lock of a build that has
        given no sign of life for long, where a lock can outlive its process: in object stores.
        """
        ...

    def sync(self) -> None:
        """Return when everything written would survive a power cut."""
        ...

    @property
    def location(self) -> str:
        """Where the store is: what ``open_store`` opens again, on this machine or another, and for messages."""
        ...

    @property
    def scratch(self) -> Path:
        """A local folder for files of a build that have no name or do not outlive it."""
        ...
