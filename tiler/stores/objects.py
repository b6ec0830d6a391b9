"""A store in a bucket of an object store (S3 and compatible, Google, Azure), by URL; through obstore, the extra ``cloud``."""

import os
import re
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from datetime import timedelta
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote, urlsplit

from schemas.errors import MissingExtraError, NotFoundError, StorageError, UsageError
from tiler.stores import Claim
from tiler.stores.claims import ClaimNote
from tiler.stores.keys import check_key, is_key
from tiler.stores.objecterrors import is_bucket_missing, reason
from tiler.stores.objectlock import DEFAULT_TIMES, LockTimes, held, read_note

SCHEMES: Final = {"s3": "AWS", "gs": "GOOGLE", "az": "AZURE"}
"""URL schemes, and how the names of the environment variables begin that hold credentials, endpoint and options."""
_CLASSES: Final = {"s3": "S3Store", "gs": "GCSStore", "az": "AzureStore"}
_ENDPOINTS: Final = {
    "s3": ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT"),
    "gs": ("GOOGLE_BASE_URL",),
    "az": ("AZURE_STORAGE_ENDPOINT", "AZURE_ENDPOINT"),
}
_CLIENT_OPTIONS: Final = (
    "allow_http",
    "allow_invalid_certificates",
    "connect_timeout",
    "proxy_ca_certificate",
    "proxy_excludes",
    "proxy_url",
    "timeout",
)
"""Options of the HTTP client that obstore takes from the environment, but no longer once one is given by the program."""
_TIMEOUTS: Final = {"connect_timeout": "5s", "timeout": "30s"}
"""A store that takes requests and never answers costs 30 s, then the sentence comes; with obstore's own settings it is three minutes."""
_RETRIES: Final[dict[str, Any]] = {
    "max_retries": 15,
    "backoff": {"init_backoff": timedelta(seconds=0.2), "max_backoff": timedelta(seconds=15), "base": 2},
    "retry_timeout": timedelta(seconds=30),
}
"""For answers such as '503 slow down', and for connections that are refused: they are tried again for 6 to 15 s (seen), at most 30 s."""
_PARTS_AT_ONCE: Final = 4
"""Of an object of more than 5 MiB, which goes in parts of 5 MiB. Fewer than obstore's 12: each has to arrive within the timeout."""
_LISTED_AT_ONCE: Final = 1000
"""As many names as S3 lists, or deletes, at one request."""


class ObjectStore:
    """Keys are objects below ``url``, ``s3://BUCKET/PREFIX``, ``gs://BUCKET/PREFIX`` or ``az://CONTAINER/PREFIX``.

    Credentials, endpoint and region come from the environment, under the names that obstore reads. Nothing is contacted before the
    first call. A write is one object put in one step, so a killed process leaves no part of it. Safe to use from several threads, but
    not after ``os.fork`` in a process that has used one: obstore's own threads are not there then, and calls hang. Raises
    UsageError for a URL or an environment that cannot be meant, MissingExtraError without obstore.
    """

    def __init__(self, url: str, lock_times: LockTimes = DEFAULT_TIMES) -> None:
        self._scheme, self._bucket, prefix = _parse(url)
        self._location = f"{self._scheme}://{self._bucket}{'/' if prefix else ''}{_quoted(prefix)}"
        self._lock_times = lock_times
        options = _client_options(self._scheme)
        _check_endpoint(self._scheme, options)
        self._obstore = _obstore()
        try:
            self._objects: Any = getattr(import_module("obstore.store"), _CLASSES[self._scheme])(
                self._bucket, prefix=prefix or None, client_options=options, retry_config=_RETRIES
            )
        except Exception as error:
            raise UsageError(f"{self._location}: {reason(error, self._scheme, self._bucket)}") from error

    @property
    def location(self) -> str:
        """The URL, without credentials."""
        return self._location

    @property
    def scratch(self) -> Path:
        """The machine's folder for temporary files; ``TMPDIR`` chooses another one."""
        return Path(tempfile.gettempdir())

    @contextmanager
    def _failing(self, key: str, what: str) -> Iterator[None]:
        """Turn every error of obstore into one sentence."""
        where = f"{self._location}/{key}" if key else self._location
        try:
            yield
        except FileNotFoundError as error:
            if is_bucket_missing(error):
                raise StorageError(f"{where}: {what}: {reason(error, self._scheme, self._bucket)}") from error
            raise NotFoundError(f"{where}: no such block or file") from error
        except self._obstore.exceptions.BaseError as error:
            raise StorageError(f"{where}: {what}: {reason(error, self._scheme, self._bucket)}") from error
        except ValueError as error:
            raise NotFoundError(f"{self._location}: {key!r} is not a key of a store") from error

    def read(self, key: str) -> bytes:
        """Return the bytes under ``key``; raises NotFoundError or StorageError."""
        check_key(self._location, key)
        with self._failing(key, "cannot be read"):
            data: bytes = self._objects.get(key).bytes().to_bytes()
        return data

    def read_if_changed(self, key: str, tag: str | None) -> tuple[bytes, str | None] | None:
        """Return the bytes under ``key`` and their entity tag; None if the tag is still ``tag``. Raises as ``read`` does."""
        check_key(self._location, key)
        options = None if tag is None else {"if_none_match": tag}
        with self._failing(key, "cannot be read"):
            try:
                found = self._objects.get(key, options=options)
                return found.bytes().to_bytes(), found.meta["e_tag"]
            except self._obstore.exceptions.NotModifiedError:
                return None

    def write(self, key: str, data: bytes) -> None:
        """Put ``data`` under ``key`` in one step; raises StorageError."""
        check_key(self._location, key)
        with self._failing(key, "cannot be written"):
            self._objects.put(key, data, max_concurrency=_PARTS_AT_ONCE)

    def delete(self, keys: Iterable[str]) -> None:
        """Delete the objects under ``keys``, a thousand with one request where the store can do that; raises StorageError."""
        remaining = iter(keys)
        while batch := list(islice(remaining, _LISTED_AT_ONCE)):
            for key in batch:
                check_key(self._location, key)
            self._delete(batch)

    def delete_prefix(self, prefix: str) -> None:
        """Delete every object below ``prefix``; raises StorageError."""
        check_key(self._location, prefix)
        for page in self._pages(prefix):
            self._delete(page)

    def keys(self, prefix: str) -> list[str]:
        """Return the keys below ``prefix``, sorted; '' means all. Raises StorageError."""
        if prefix:
            check_key(self._location, prefix)
        return sorted(key for page in self._pages(prefix) for key in page if is_key(key))

    def _pages(self, prefix: str) -> Iterator[list[str]]:
        with self._failing(prefix, "cannot be listed"):
            for page in self._objects.list(prefix or None, chunk_size=_LISTED_AT_ONCE):
                yield [entry["path"] for entry in page]

    def _delete(self, names: list[str]) -> None:
        with self._failing(names[0] if len(names) == 1 else "", "cannot be deleted"):
            try:
                self._objects.delete(names)
            except FileNotFoundError:  # Google and Azure say so if one is not there; the others may still be
                for name in names:
                    self._delete_one(name)

    def _delete_one(self, name: str) -> None:
        try:
            self._objects.delete(name)
        except FileNotFoundError:
            return

    def sync(self) -> None:
        """Return at once: an object store answers a put when the object is safe."""

    def exclusive(self, break_stale: bool = False) -> AbstractContextManager[Claim]:
        """Keep other builds out of the store as long as the context lasts, by an object with the name of the lock.

        It is made, refreshed and given up by conditional puts, so of two builds that begin at once only one gets it. A build that
        is killed leaves it, and ``break_stale`` takes it over once it has shown no sign of life for five minutes. Raises
        StorageError that says who has it, since when, and how long ago the last sign of life was.
        """
        return held(self._objects, self._location, self._failing, self._lock_times, break_stale)

    def claim_note(self) -> ClaimNote | None:
        """Return what the last build wrote down about itself, without holding the store; None if there is nothing."""
        return read_note(self._objects, self._location, self._failing)


def _obstore() -> Any:  # noqa: ANN401 - an extra: its types are not there without it
    try:
        module = import_module("obstore")
        import_module("obstore.exceptions")
    except ModuleNotFoundError as error:
        raise MissingExtraError("datasets in object stores need obstore: pip install 'clipmap[cloud]'") from error
    return module


def _parse(url: str) -> tuple[str, str, str]:
    """Return scheme, bucket and prefix of a URL; raises UsageError. Never repeats what may be a secret."""
    try:
        parts = urlsplit(url)
    except ValueError as error:
        raise UsageError(f"a store's URL cannot be understood ({error}); it is like s3://BUCKET/PREFIX") from error
    scheme = parts.scheme.lower()
    shown = f"{scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}"
    if scheme not in SCHEMES:
        known = ", ".join(f"{name}://" for name in SCHEMES)
        raise UsageError(f"{shown}: no store has URLs of this kind; known are {known} and file://, and paths of folders")
    if "@" in parts.netloc or parts.query or parts.fragment:
        names = f"{SCHEMES[scheme]}_..."
        raise UsageError(f"{shown}: a store's URL has no user, password or query; give credentials by the environment ({names})")
    prefix = unquote(parts.path.strip("/"))
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", parts.netloc):
        raise UsageError(f"{shown}: no bucket is named; a store's URL is like {scheme}://BUCKET/PREFIX")
    if prefix and any(part in ("", ".", "..") for part in prefix.split("/")):
        raise UsageError(f"{shown}: a store's URL has no empty parts, no '.' and no '..' in its path")
    return scheme, parts.netloc, prefix


def _quoted(prefix: str) -> str:
    """Return a prefix as it stands in a URL, with no more escapes than that it can be read back."""
    return re.sub("[%?#]", lambda found: f"%{ord(found[0]):02X}", prefix)


def _client_options(scheme: str) -> dict[str, str]:
    found = {name: os.environ.get(f"{SCHEMES[scheme]}_{name.upper()}") for name in _CLIENT_OPTIONS}
    return _TIMEOUTS | {name: value for name, value in found.items() if value}


def _check_endpoint(scheme: str, options: dict[str, str]) -> None:
    """Refuse an endpoint that obstore could not use: it would say so late, or in a way that nobody understands."""
    for name in _ENDPOINTS[scheme]:
        endpoint = os.environ.get(name)
        if endpoint is None:
            continue
        if not re.match(r"https?://[^/\s]", endpoint):
            raise UsageError(f"the environment variable {name} is no URL of an endpoint; it is like https://HOST:PORT")
        if endpoint.startswith("http://") and options.get("allow_http", "").lower() not in ("1", "true", "yes", "on", "y", "t"):
            raise UsageError(f"{name} is plain http; set {SCHEMES[scheme]}_ALLOW_HTTP=true if that is meant, or use https")
