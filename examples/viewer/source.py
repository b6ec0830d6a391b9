"""Where blocks come from: a dataset in a directory, or one that a server hands out over HTTP. Bytes only, any thread.

A source is one version of a dataset: its blocks are held against the digests of that version, and once the dataset has been
rebuilt reading ends in an InputError, so that two versions never meet in one picture.
"""

import re
import threading
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Final, Protocol, Self
from urllib.parse import urlsplit

from schemas.address import BlockAddress
from schemas.blockindex import BlockIndex
from schemas.errors import ClipmapError, InputError, MissingExtraError, NotFoundError, StorageError
from schemas.manifest import MANIFEST_NAME, Manifest, digest, parse_manifest

CONNECT_S: Final = 5.0
READ_S: Final = 30.0
RETRIES: Final = 2
_BUSY: Final = (429, 502, 503, 504)
"""Answers after which the same request is made once more."""
_DIGEST_TAG: Final = re.compile(r'(?:W/)?"([0-9a-f]{32})"')
"""An entity tag that is a digest; a proxy that compresses on the way makes it a weak one, of the same bytes."""


class BlockSource(Protocol):
    """One published dataset; ``read`` may be called from several threads."""

    @property
    def location(self) -> str:
        """Path or URL of the dataset, for messages."""
        ...

    @property
    def manifest(self) -> Manifest:
        """The dataset's manifest, read once."""
        ...

    def read(self, layer: str, address: BlockAddress) -> bytes | None:
        """Return the stored bytes of a block, None for a blank.

        Raises NotFoundError, StorageError, or InputError if the bytes are not the block's or the dataset was rebuilt.
        """
        ...

    def close(self) -> None:
        """Let go of files and connections."""
        ...


def _rebuilt(location: str) -> InputError:
    return InputError(f"{location}: the dataset was rebuilt meanwhile, and two versions are never mixed; start again")


class DirectorySource:
    """A dataset in a directory; raises NotFoundError if there is none, InputError if its manifest is not understood."""

    def __init__(self, root: Path) -> None:
        self._root = root
        if not root.is_dir():
            raise NotFoundError(f"{root}: no such directory; give the directory of a dataset or its URL")
        try:
            self.manifest = self._read_manifest()
        except NotFoundError:
            raise NotFoundError(f"{root}: no {MANIFEST_NAME}: not a dataset, or its build has not finished") from None
        self._indexes: dict[tuple[str, int], BlockIndex] = {}
        self._lock = threading.Lock()

    @property
    def location(self) -> str:
        """The directory's path."""
        return str(self._root)

    def read(self, layer: str, address: BlockAddress) -> bytes | None:
        """Return the bytes of a block's file, None if the index says that it is blank.

        Raises NotFoundError, StorageError, or InputError if the file is not what the index says or the dataset was rebuilt.
        """
        try:
            return self._block(layer, address)
        except (NotFoundError, InputError):
            # A rebuild deletes the old blocks, and a second one may reuse their names: damage only if it is the same version.
            if self._is_rebuilt():
                raise _rebuilt(self.location) from None
            raise

    def close(self) -> None:
        """Nothing is held open."""

    def _read_manifest(self) -> Manifest:
        path = self._root / MANIFEST_NAME
        return parse_manifest(_read_file(path), str(path))

    def _is_rebuilt(self) -> bool:
        try:
            return self._read_manifest().version != self.manifest.version
        except ClipmapError:
            return False

    def _block(self, name: str, address: BlockAddress) -> bytes | None:
        layer = self.manifest.layer(name)
        lattice = layer.lattice
        record = self._index(name, lattice.check(address).level)[lattice.block_number(address)]
        if record.blank:
            return None
        path = self._root / layer.block_key(name, address)
        data = _read_file(path)
        if len(data) != record.length_bytes:
            raise InputError(f"{path}: has {len(data)} bytes instead of {record.length_bytes}; the block is damaged, rebuild the layer")
        if digest(data) != record.digest:
            raise InputError(f"{path}: holds other bytes than the index says; the block is damaged, rebuild the layer")
        return data

    def _index(self, name: str, level: int) -> BlockIndex:
        """Return the block index of a level, read and checked once; workers that want the same one wait for it."""
        with self._lock:
            known = self._indexes.get((name, level))
            if known is None:
                layer = self.manifest.layer(name)
                path = self._root / layer.index_key(level)
                data = _read_file(path)
                if digest(data) != layer.levels[level].index:
                    raise InputError(f"{path}: differs from what the manifest says; the index is damaged, rebuild the layer")
                columns, rows = layer.lattice.block_counts(level)
                known = self._indexes[name, level] = BlockIndex(data, columns * rows, str(path))
            return known


def _read_file(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
        raise NotFoundError(f"{path}: no such block or file; the dataset is incomplete, rebuild the layer") from None
    except OSError as error:
        raise StorageError(f"{path}: cannot be read: {error.strerror}") from error


class HttpSource:
    """A dataset at ``http://host:port/name``, read through a pool of ``connections`` kept-alive connections.

    Blocks are asked for by the version of the manifest. Raises NotFoundError if the server has no such dataset, StorageError
    if it does not answer or refuses, InputError if the URL cannot be one of a dataset.
    """

    def __init__(self, url: str, connections: int) -> None:
        _check_host(url)
        self._url = re.split("[?#]", url)[0].rstrip("/").removesuffix(f"/{MANIFEST_NAME}")
        self._urllib3 = _import_urllib3()
        retry = self._urllib3.Retry(
            total=RETRIES, connect=RETRIES, read=RETRIES, redirect=3, backoff_factor=0.2, status_forcelist=_BUSY, raise_on_status=False
        )
        timeout = self._urllib3.Timeout(connect=CONNECT_S, read=READ_S)
        self._pool = self._urllib3.PoolManager(maxsize=connections, block=True, retries=retry, timeout=timeout)
        try:
            data = self._get(f"{self._url}/{MANIFEST_NAME}")
            if data is None:
                raise InputError(f"{self._url}/{MANIFEST_NAME}: the server sent nothing; is this the URL of a clipmap dataset?")
            self.manifest = parse_manifest(data, f"{self._url}/{MANIFEST_NAME}")
        except ClipmapError:
            self.close()
            raise

    @property
    def location(self) -> str:
        """The dataset's URL."""
        return self._url

    def read(self, layer: str, address: BlockAddress) -> bytes | None:
        """Return the bytes of a block, None for a blank (status 204).

        Raises NotFoundError, StorageError, or InputError if the bytes do not fit their digest or the dataset was rebuilt.
        """
        return self._get(f"{self._url}/{layer}/{address}", {"v": self.manifest.version})

    def close(self) -> None:
        """Close all connections."""
        self._pool.clear()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _get(self, url: str, query: Mapping[str, str] | None = None) -> bytes | None:
        try:
            response = self._pool.request("GET", url, fields=query)
        except self._urllib3.exceptions.HTTPError as error:
            raise self._unreachable(url, error) from error
        status = int(response.status)
        if status == 200:
            return _verified(bytes(response.data), response.headers.get("ETag", ""), url)
        if status == 204:
            return None
        if status == 410:
            raise _rebuilt(self._url)
        if status == 404:
            raise NotFoundError(f"{url}: the server has no such dataset or block (404); check the dataset's name in the URL")
        if status in (401, 403):
            raise StorageError(f"{url}: the server refuses access ({status})")
        raise StorageError(f"{url}: the server answered with status {status}; try again or look at its log")

    def _unreachable(self, url: str, error: Exception) -> ClipmapError:
        errors = self._urllib3.exceptions
        reason = getattr(error, "reason", None) or error
        if isinstance(reason, errors.NameResolutionError):
            return StorageError(f"{url}: the host's name cannot be resolved; check the URL")
        if isinstance(reason, errors.NewConnectionError):
            return StorageError(f"{url}: cannot connect; is `clipmap serve` running there?")
        if isinstance(reason, errors.ConnectTimeoutError):
            return StorageError(f"{url}: no connection within {CONNECT_S:g} s; is `clipmap serve` running there?")
        if isinstance(reason, errors.ReadTimeoutError):
            return StorageError(f"{url}: no answer within {READ_S:g} s; the server is overloaded or stuck")
        if isinstance(error, (errors.LocationParseError, errors.URLSchemeUnknown)):
            return InputError(f"{url}: not a URL that can be opened; use http://HOST:PORT/DATASET")
        return StorageError(f"{url}: the connection broke: {reason}")


def _check_host(url: str) -> None:
    try:
        host = urlsplit(url).hostname
    except ValueError:
        raise InputError(f"{url}: not a URL that can be opened; use http://HOST:PORT/DATASET") from None
    if not host:
        raise InputError(f"{url}: the URL has no host; use http://HOST:PORT/DATASET")


def _verified(data: bytes, tag: str, url: str) -> bytes:
    """Return ``data`` if it has the digest that its entity tag names; a tag that a proxy put in its place says nothing."""
    named = _DIGEST_TAG.fullmatch(tag)
    if named is not None and digest(data) != named[1]:
        raise InputError(f"{url}: the server sent other bytes than the block's; the stored block is damaged, rebuild the layer")
    return data


def _import_urllib3() -> ModuleType:
    try:
        return import_module("urllib3")
    except ImportError as error:
        raise MissingExtraError("reading over HTTP needs urllib3: pip install 'clipmap[view]'") from error


def open_source(where: str, connections: int = 4) -> BlockSource:
    """Open the dataset at ``where``, a directory or an http(s) URL; raises NotFoundError, InputError or StorageError."""
    if where.startswith(("http://", "https://")):
        return HttpSource(where, connections)
    if "://" in where:
        raise InputError(f"{where}: only http:// and https:// URLs and directories can be opened")
    return DirectorySource(Path(where))
