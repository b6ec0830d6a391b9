"""Where blocks lie: the store contract and its implementations. Light to import: a server needs nothing else of tiler."""

from typing import Protocol


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

    def delete_prefix(self, prefix: str) -> None:
        """Delete every key that begins with ``prefix`` and '/'; none is no error; raises StorageError."""
        ...

    def keys(self, prefix: str) -> list[str]:
        """Return the keys that begin with ``prefix`` and '/', sorted; '' means all."""
        ...

    def sync(self) -> None:
        """Return when everything written would survive a power cut."""
        ...

    @property
    def location(self) -> str:
        """Where the store is, for messages."""
        ...
