import socket
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from schemas.address import BlockAddress
from schemas.errors import ClipmapError, InputError, NotFoundError, StorageError
from schemas.manifest import Manifest
from tests.viewer.writer import LayerSpec, write_dataset
from viewer import source as source_module
from viewer.source import DirectorySource, HttpSource, open_source

pytest.importorskip("urllib3", reason="urllib3 is not installed")

TRANSFORM = (1.0, 0.0, 0.0, 0.0, -1.0, 0.0)


class Service:
    """A block service on 127.0.0.1 for one dataset, with faults on demand; counts what it was asked."""

    def __init__(self, root: Path, manifest: Manifest) -> None:
        self.root, self.manifest = root, manifest
        self.asked: list[str] = []
        self.faults: list[int] = []
        self.stall = threading.Event()
        self.stall.set()
        service = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_GET(self) -> None:
                service.asked.append(self.path)
                service.stall.wait(5)
                status, body = service.answer(self.path)
                self.send_response(status)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *args: object) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_address[1]}/set"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def answer(self, path: str) -> tuple[int, bytes]:
        if self.faults:
            return self.faults.pop(0), b""
        if path == "/set/manifest.json":
            return 200, (self.root / "manifest.json").read_bytes()
        parts = path.split("/")
        if len(parts) != 6 or parts[1] != "set" or parts[2] not in self.manifest.layers:
            return 404, b"no"
        key = self.manifest.layer(parts[2]).block_key(parts[2], BlockAddress(*map(int, parts[3:])))
        file = self.root / key
        return (200, file.read_bytes()) if file.is_file() else (204, b"")


@pytest.fixture
def dataset(tmp_path: Path) -> tuple[Path, Manifest]:
    valid = np.ones((40, 40), np.bool_)
    valid[:16, :16] = False
    z = np.arange(1600, dtype=np.float32).reshape(40, 40)
    return tmp_path / "set", write_dataset(tmp_path / "set", [LayerSpec("height", "height", z, TRANSFORM, valid=valid)])


@pytest.fixture
def service(dataset: tuple[Path, Manifest]) -> Iterator[Service]:
    running = Service(*dataset)
    yield running
    running.stall.set()
    running.server.shutdown()
    running.server.server_close()


def test_a_directory_gives_manifest_and_blocks(dataset: tuple[Path, Manifest]) -> None:
    root, manifest = dataset
    source = open_source(str(root))
    assert isinstance(source, DirectorySource)
    assert source.manifest == manifest
    data = source.read("height", BlockAddress(0, 1, 0))
    assert data is not None
    np.testing.assert_array_equal(np.frombuffer(data, "<f4").reshape(16, 16)[0], np.arange(16, 32))
    source.close()


def test_http_gives_the_same(service: Service) -> None:
    for url in (service.url, service.url + "/", service.url + "/manifest.json"):
        source = open_source(url)
        assert isinstance(source, HttpSource)
        assert source.location == service.url
        assert source.manifest == service.manifest
        key = service.manifest.layer("height").block_key("height", BlockAddress(0, 1, 1))
        assert source.read("height", BlockAddress(0, 1, 1)) == (service.root / key).read_bytes()
        assert source.read("height", BlockAddress(0, 0, 0)) is None
        source.close()
    assert "/set/height/0/1/1" in service.asked


@pytest.mark.parametrize(
    ("where", "kind", "words"),
    [
        ("nowhere", NotFoundError, "no such directory"),
        ("", NotFoundError, "no manifest.json"),
        ("ftp://host/set", InputError, "only http"),
        ("http://127.0.0.1:{free}/set", StorageError, "cannot connect; is `clipmap serve` running there"),
        ("http://does-not-exist.invalid/set", StorageError, "cannot be resolved"),
        ("http://[::bad/set", InputError, "not a URL"),
    ],
)
def test_what_cannot_be_opened_says_why(tmp_path: Path, where: str, kind: type[ClipmapError], words: str) -> None:
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        free = held.getsockname()[1]
    name = where.format(free=free) if "://" in where else str(tmp_path / where)
    with pytest.raises(kind, match=words) as caught:
        open_source(name)
    assert "\n" not in str(caught.value)


def test_a_damaged_manifest_is_named(dataset: tuple[Path, Manifest]) -> None:
    (dataset[0] / "manifest.json").write_text("{}")
    with pytest.raises(InputError, match=r"manifest\.json: not a clipmap manifest"):
        open_source(str(dataset[0]))


def test_a_missing_block_is_named(dataset: tuple[Path, Manifest]) -> None:
    source = open_source(str(dataset[0]))
    with pytest.raises(NotFoundError, match="rebuild the layer"):
        source.read("height", BlockAddress(0, 0, 0))


@pytest.mark.parametrize(("status", "kind"), [(404, NotFoundError), (403, StorageError), (500, StorageError), (400, StorageError)])
def test_refusals_become_errors_with_the_status(service: Service, status: int, kind: type[ClipmapError]) -> None:
    source = open_source(service.url)
    service.faults = [status]
    with pytest.raises(kind, match=str(status)):
        source.read("height", BlockAddress(0, 1, 1))
    source.close()


def test_a_busy_server_is_asked_again(service: Service) -> None:
    source = open_source(service.url)
    service.asked.clear()
    service.faults = [503, 503]
    assert source.read("height", BlockAddress(0, 1, 1)) is not None
    assert len(service.asked) == 3
    service.faults = [503] * 3
    with pytest.raises(StorageError, match="503"):
        source.read("height", BlockAddress(0, 1, 1))
    source.close()


def test_a_stuck_server_times_out(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(source_module, "READ_S", 0.2)
    monkeypatch.setattr(source_module, "RETRIES", 0)
    source = open_source(service.url)
    service.stall.clear()
    with pytest.raises(StorageError, match=r"no answer within 0\.2 s"):
        source.read("height", BlockAddress(0, 1, 1))
    source.close()


def test_a_manifest_that_is_no_content_is_refused(service: Service) -> None:
    service.faults = [204]
    with pytest.raises(InputError, match="URL of a clipmap dataset"):
        open_source(service.url)
