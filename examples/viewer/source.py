"""Where blocks come from: a dataset in a directory, or one that a server hands out over HTTP. Bytes only, any thread."""

from importlib import import_module
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Final, Protocol, Self

from schemas.address import BlockAddress
from schemas.errors import ClipmapError, InputError, MissingExtraError, NotFoundError, StorageError
from schemas.manifest import MANIFEST_NAME, Manifest, parse_manifest

CONNECT_S: Final = 5.0
READ_S: Final = 30.0
RETRIES: Final = 2
_BUSY: Final = (429, 502, 503, 504)
"""Answers after which the same request is made once more."""


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
        """Return the stored bytes of a block, None for a blank; raises NotFoundError or StorageError."""
        ...

    def close(self) -> None:
        """Let go of files and connections."""
        ...


class DirectorySource:
    """A dataset in a directory; raises NotFoundError if there is none, InputError if its manifest is not understood."""

    def __init__(self, root: Path) -> None:
        self._root = root
        if not root.is_dir():
            raise NotFoundError(f"{root}: no such directory; give the directory of a dataset or its URL")
        try:
            data = _read_file(root / MANIFEST_NAME)
        except NotFoundError:
            raise NotFoundError(f"{root}: no {MANIFEST_NAME}: not a dataset, or its build has not finished") from None
        self.manifest = parse_manifest(data, str(root / MANIFEST_NAME))

    @property
    def location(self) -> str:
        """The directory's path."""
        return str(self._root)

    def read(self, layer: str, address: BlockAddress) -> bytes | None:
        """Return the bytes of a block's file; raises NotFoundError or StorageError."""
        return _read_file(self._root / self.manifest.layer(layer).block_key(layer, address))

    def close(self) -> None:
        """Nothing is held open."""


def _read_file(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
        raise NotFoundError(f"{path}: no such block or file; the dataset is incomplete, rebuild the layer") from None
    except OSError as error:
        raise StorageError(f"{path}: cannot be read: {error.strerror}") from error


class HttpSource:
    """A dataset at ``http://host:port/name``, read through a pool of ``connections`` kept-alive connections.

    Raises NotFoundError if the server has no such dataset, StorageError if it does not answer or refuses.
    """

    def __init__(self, url: str, connections: int) -> None:
        self._url = url.partition("#")[0].rstrip("/").removesuffix(f"/{MANIFEST_NAME}")
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
        """Return the bytes of a block, None for a blank (status 204); raises NotFoundError or StorageError."""
        return self._get(f"{self._url}/{layer}/{address}")

    def close(self) -> None:
        """Close all connections."""
        self._pool.clear()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _get(self, url: str) -> bytes | None:
        try:
            response = self._pool.request("GET", url)
        except self._urllib3.exceptions.HTTPError as error:
            raise self._unreachable(url, error) from error
        status = int(response.status)
        if status == 200:
            return bytes(response.data)
        if status == 204:
            return None
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
