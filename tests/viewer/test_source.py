import socket
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest

from schemas.address import BlockAddress
from schemas.errors import ClipmapError, InputError, NotFoundError, StorageError
from schemas.manifest import Manifest, digest, parse_manifest
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
        self.tag: str | None = None
        """What to send as ETag; None: the digest of the block as it was written."""
        self.digests = {path: digest(path.read_bytes()) for path in root.rglob("*") if path.is_file()}
        self.stall = threading.Event()
        self.stall.set()
        service = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_GET(self) -> None:
                service.asked.append(self.path)
                service.stall.wait(5)
                status, body, tag = service.answer(self.path)
                self.send_response(status)
                if tag and status == 200:
                    self.send_header("ETag", tag)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *args: object) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_address[1]}/set"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def answer(self, url: str) -> tuple[int, bytes, str]:
        if self.faults:
            return self.faults.pop(0), b"", ""
        path, query = urlsplit(url).path, parse_qs(urlsplit(url).query)
        data = (self.root / "manifest.json").read_bytes()
        if query.get("v", [None])[0] not in (None, parse_manifest(data, "").version):
            return 410, b"gone", ""
        if path == "/set/manifest.json":
            return 200, data, f'"{digest(data)}"'
        parts = path.split("/")
        if len(parts) != 6 or parts[1] != "set" or parts[2] not in self.manifest.layers:
            return 404, b"no", ""
        key = self.manifest.layer(parts[2]).block_key(parts[2], BlockAddress(*map(int, parts[3:])))
        file = self.root / key
        if not file.is_file():
            return 204, b"", ""
        return 200, file.read_bytes(), f'"{self.digests[file]}"' if self.tag is None else self.tag


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
    assert service.asked.count(f"/set/height/0/1/1?v={service.manifest.version}") == 3
    assert not [path for path in service.asked if "/height/" in path and "?v=" not in path]


@pytest.mark.parametrize(
    ("where", "kind", "words"),
    [
        ("nowhere", NotFoundError, "no such directory"),
        ("", NotFoundError, "no manifest.json"),
        ("ftp://host/set", InputError, "only http"),
        ("http://127.0.0.1:{free}/set", StorageError, "cannot connect; is `clipmap serve` running there"),
        ("http://does-not-exist.invalid/set", StorageError, "cannot be resolved"),
        ("http://[::bad/set", InputError, "not a URL"),
        ("http://127.0.0.1:port/set", InputError, "not a URL"),
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


def block_file(dataset: tuple[Path, Manifest], x: int, y: int) -> Path:
    root, manifest = dataset
    return root / manifest.layer("height").block_key("height", BlockAddress(0, x, y))


def rebuilt(root: Path) -> None:
    """What a rebuild leaves: another version under another path, the old blocks deleted."""
    z = np.full((40, 40), 5, np.float32)
    for file in (root / "height").rglob("*.*"):
        file.unlink()
    write_dataset(root, [LayerSpec("height", "height", z, TRANSFORM, codec="lerc:0.1")])


def test_a_missing_block_is_named(dataset: tuple[Path, Manifest]) -> None:
    source = open_source(str(dataset[0]))
    missing = block_file(dataset, 1, 1)
    missing.unlink()
    with pytest.raises(NotFoundError, match="rebuild the layer") as caught:
        source.read("height", BlockAddress(0, 1, 1))
    assert str(missing) in str(caught.value)


def test_a_blank_is_blank_because_the_index_says_so(dataset: tuple[Path, Manifest]) -> None:
    """2026-11-22: the directory source never looked into the index, and took a blank for a missing file."""
    source = open_source(str(dataset[0]))
    assert source.read("height", BlockAddress(0, 0, 0)) is None
    with pytest.raises(NotFoundError, match="outside level 0"):
        source.read("height", BlockAddress(0, 3, 0))


def test_a_block_copied_over_another_is_noticed_in_a_directory(dataset: tuple[Path, Manifest]) -> None:
    """2026-11-22: neither length nor digest was held against the index, so the wrong ground was shown."""
    source = open_source(str(dataset[0]))
    victim, other = block_file(dataset, 1, 1), block_file(dataset, 2, 1)
    assert len(victim.read_bytes()) == len(other.read_bytes())
    victim.write_bytes(other.read_bytes())
    with pytest.raises(InputError, match="holds other bytes than the index says") as caught:
        source.read("height", BlockAddress(0, 1, 1))
    assert str(victim) in str(caught.value)
    assert source.read("height", BlockAddress(0, 2, 1)) == other.read_bytes()
    victim.write_bytes(b"short")
    with pytest.raises(InputError, match=r"height-0-\d+\.raw: has 5 bytes instead of 1024"):
        source.read("height", BlockAddress(0, 1, 1))


@pytest.mark.parametrize("damage", [b"", b"\xff"])
def test_a_damaged_index_is_noticed(dataset: tuple[Path, Manifest], damage: bytes) -> None:
    """2026-11-22: an index is held against the manifest before it is used."""
    index = dataset[0] / dataset[1].layer("height").index_key(0)
    index.write_bytes(damage + index.read_bytes()[1:])
    with pytest.raises(InputError, match=r"index\.bin: .*the index is damaged"):
        open_source(str(dataset[0])).read("height", BlockAddress(0, 1, 1))


def test_an_index_is_read_once(dataset: tuple[Path, Manifest]) -> None:
    """2026-11-22: blocks are checked without reading the index for each of them."""
    source = open_source(str(dataset[0]))
    assert source.read("height", BlockAddress(0, 1, 1)) is not None
    (dataset[0] / dataset[1].layer("height").index_key(0)).unlink()
    assert source.read("height", BlockAddress(0, 2, 1)) is not None


def test_a_rebuild_under_a_directory_is_told_from_damage(dataset: tuple[Path, Manifest]) -> None:
    """2026-11-22: the old layer's files vanish in a rebuild, and the dataset was called damaged."""
    source = open_source(str(dataset[0]))
    assert source.read("height", BlockAddress(0, 1, 1)) is not None
    rebuilt(dataset[0])
    for x in (1, 2):
        with pytest.raises(InputError, match=r"was rebuilt meanwhile.*start again") as caught:
            source.read("height", BlockAddress(0, x, 1))
        assert "damaged" not in str(caught.value)
    assert open_source(str(dataset[0])).read("height", BlockAddress(0, 1, 1)) is not None


def test_old_names_with_new_bytes_are_a_rebuild_too(dataset: tuple[Path, Manifest]) -> None:
    """2026-11-22: a second rebuild takes the first one's path again, so the file is there and holds another version."""
    source = open_source(str(dataset[0]))
    write_dataset(dataset[0], [LayerSpec("height", "height", np.full((40, 40), 5, np.float32), TRANSFORM)])
    with pytest.raises(InputError, match=r"was rebuilt meanwhile.*start again"):
        source.read("height", BlockAddress(0, 1, 1))


def test_a_rebuild_behind_a_server_ends_in_a_sentence(dataset: tuple[Path, Manifest], service: Service) -> None:
    """2026-11-22: blocks were asked for without their version, so blocks of two versions met in one picture."""
    source = open_source(service.url)
    assert source.read("height", BlockAddress(0, 1, 1)) is not None
    write_dataset(dataset[0], [LayerSpec("height", "height", np.full((40, 40), 5, np.float32), TRANSFORM)])
    with pytest.raises(InputError, match=r"was rebuilt meanwhile.*start again") as caught:
        source.read("height", BlockAddress(0, 1, 1))
    assert "\n" not in str(caught.value)
    source.close()


def test_a_block_copied_over_another_is_noticed_over_http(dataset: tuple[Path, Manifest], service: Service) -> None:
    """2026-11-22: a server that answers from its index cannot notice a copy of the same length; the entity tag tells."""
    source = open_source(service.url)
    block_file(dataset, 1, 1).write_bytes(block_file(dataset, 2, 1).read_bytes())
    with pytest.raises(InputError, match="/set/height/0/1/1: the server sent other bytes than the block's"):
        source.read("height", BlockAddress(0, 1, 1))
    assert source.read("height", BlockAddress(0, 2, 1)) is not None
    service.tag = f'W/"{"0" * 32}"'
    with pytest.raises(InputError, match="/set/height/0/2/1: the server sent other bytes"):
        source.read("height", BlockAddress(0, 2, 1))
    for foreign in ("", '"64f1-3a2b"'):
        service.tag = foreign
        assert source.read("height", BlockAddress(0, 2, 1)) is not None
    source.close()


@pytest.mark.parametrize("url", ["http://", "https:///set", "http://:8000/set", "http://?v=1"])
def test_a_url_without_a_host_is_told_so(url: str) -> None:
    """2026-11-22: ``view http://`` said that the connection to http:/manifest.json broke."""
    with pytest.raises(InputError, match="the URL has no host; use http://HOST:PORT/DATASET") as caught:
        open_source(url)
    assert str(caught.value).startswith(url)


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
