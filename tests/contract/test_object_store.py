"""The store in a bucket, against moto's server on loopback (see ``tests/s3.py`` for what it is and how it is installed)."""

import os
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from schemas.errors import ClipmapError, MissingExtraError, NotFoundError, StorageError, UsageError
from tests.contract.stores import StoreContract
from tests.s3 import S3Server
from tiler.stores import objects
from tiler.stores.dataset import open_dataset
from tiler.stores.directory import DirectoryStore
from tiler.stores.locate import open_store
from tiler.stores.objects import ObjectStore


class TestObjectStore(StoreContract):
    server: S3Server

    @pytest.fixture(autouse=True)
    def _server(self, s3: S3Server) -> None:
        self.server = s3

    def store(self, place: Path) -> ObjectStore:
        return ObjectStore(self.server.url(place))

    def set(self, place: Path, key: str, data: bytes) -> None:
        self.server.put(place, key, data)

    def get(self, place: Path, key: str) -> bytes:
        data = self.server.get(place, key)
        assert data is not None
        return data

    def left(self, place: Path) -> list[str]:
        return self.server.names(place)

    def test_hidden_objects_are_no_keys_but_go_with_their_prefix(self, tmp_path: Path) -> None:
        for name in ("a", ".lock", "c/.tmp-d", ".trash/e", "c/f"):
            self.set(tmp_path, name, b"x")
        assert self.store(tmp_path).keys("") == ["a", "c/f"]
        self.store(tmp_path).delete_prefix("c")
        assert self.left(tmp_path) == [".lock", ".trash/e", "a"]

    def test_more_keys_than_one_page_lists_or_one_request_deletes(self, tmp_path: Path) -> None:
        store = self.store(tmp_path)
        keys = [f"a/{number}" for number in range(1003)]
        for key in [*keys, "b"]:
            store.write(key, b"")
        assert store.keys("a") == sorted(keys)
        store.delete(keys[:2])
        store.delete_prefix("a")
        assert self.left(tmp_path) == ["b"]

    def test_large_objects_go_in_parts_and_appear_whole(self, tmp_path: Path) -> None:
        data = bytes(range(256)) * 50_000
        self.store(tmp_path).write("a", data)
        assert self.get(tmp_path, "a") == self.store(tmp_path).read("a") == data

    def test_names_with_spaces_signs_and_other_scripts(self, tmp_path: Path) -> None:
        place = tmp_path / "Große Höhe %41 #2?"
        store = self.store(place)
        store.write("höhe/a b%41", b"x")
        assert self.left(place) == ["höhe/a b%41"]
        assert open_store(store.location).keys("") == ["höhe/a b%41"]

    def test_read_if_changed(self, tmp_path: Path) -> None:
        store = self.store(tmp_path)
        with pytest.raises(NotFoundError):
            store.read_if_changed("a", None)
        store.write("a", b"one")
        first = store.read_if_changed("a", None)
        assert first is not None
        assert first[0] == b"one"
        assert store.read_if_changed("a", first[1]) is None
        store.write("a", b"two")
        second = store.read_if_changed("a", first[1])
        assert second is not None
        assert second[0] == b"two"

    def test_a_bucket_that_does_not_exist_is_a_sentence(self, tmp_path: Path) -> None:
        store = ObjectStore("s3://no-such-bucket/a")
        said = (
            r"^s3://no-such-bucket/a.*: there is no bucket 'no-such-bucket' at this endpoint; check its name, the region and the endpoint$"
        )
        for call in (lambda: store.read("b"), lambda: store.write("b", b""), lambda: store.keys("")):
            with pytest.raises(StorageError, match=said):
                call()
        with pytest.raises(StorageError, match=said), store.exclusive():
            pass

    def test_a_location_that_is_no_dataset_is_a_sentence(self, tmp_path: Path) -> None:
        self.set(tmp_path, "a/b", b"x")
        with pytest.raises(NotFoundError, match=r"^s3://.*: no dataset there \(no manifest.json\)$"):
            open_dataset(self.server.url(tmp_path))

    def test_the_lock_cannot_be_written_to_a_bucket_of_others(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        said = r"clipmap-lock: the lock cannot be read: the store refuses access"
        with answering(403, monkeypatch), pytest.raises(StorageError, match=said), ObjectStore("s3://theirs/a").exclusive():
            pass


@contextmanager
def answering(status: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A server that answers every request with one status, and one retry only, so that no test waits."""

    class Handler(BaseHTTPRequestHandler):
        def answer(self) -> None:
            body = b"<Error><Code>SomeCode</Code><Message>secret=hunter2</Message></Error>"
            self.send_response(status)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        do_GET = do_PUT = do_POST = answer  # noqa: N815 - the names that http.server looks for

        def log_message(self, *_: object) -> None:
            return

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        use_endpoint(f"http://127.0.0.1:{server.server_port}", monkeypatch)
        yield
        server.shutdown()


def use_endpoint(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.startswith(("AWS_", "GOOGLE_", "AZURE_"))]:
        monkeypatch.delenv(name)
    variables = {"ENDPOINT_URL": endpoint, "ALLOW_HTTP": "true", "ACCESS_KEY_ID": "someone", "SECRET_ACCESS_KEY": "hunter2"}
    for name, value in variables.items():
        monkeypatch.setenv(f"AWS_{name}", value)
    monkeypatch.setitem(objects._RETRIES, "max_retries", 1)


def sentences(store: ObjectStore) -> Iterator[str]:
    """What every call says that must reach the store; one line each, with the place and no secret."""
    for call in (lambda: store.read("a"), lambda: store.write("a", b"x"), lambda: store.keys("b"), lambda: store.delete_prefix("b")):
        with pytest.raises(StorageError) as caught:
            call()
        said = str(caught.value)
        assert said.startswith("s3://theirs/data")
        assert said.isprintable()
        assert "hunter2" not in said
        assert len(said) < 250
        yield said


@pytest.mark.parametrize(
    ("status", "text"),
    [
        (401, "the store refuses access (401 SomeCode); check the credentials, and that they may read, write, list and delete in 'theirs'"),
        (403, "the store refuses access (403 SomeCode); check the credentials"),
        (301, "bucket 'theirs' lies in another region; set AWS_REGION"),
        (409, "the store answered 409 SomeCode; try again later"),
        (500, "the store answered 500 SomeCode to 2 requests; try again later"),
        (503, "the store answered 503 SomeCode to 2 requests; try again later"),
    ],
)
def test_what_a_store_answers_is_a_sentence(status: int, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with answering(status, monkeypatch):
        assert all(text in said for said in sentences(ObjectStore("s3://theirs/data")))


def test_a_store_that_cannot_be_reached_is_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as closed:
        port = closed.getsockname()[1]
    use_endpoint(f"http://127.0.0.1:{port}", monkeypatch)
    for said in sentences(ObjectStore("s3://theirs/data")):
        assert said.endswith(f"the store at http://127.0.0.1:{port} cannot be reached; check the endpoint and the network")


def test_a_store_that_never_answers_does_not_hang_for_long(monkeypatch: pytest.MonkeyPatch) -> None:
    """The timeout is 30 s; the environment sets another one, under the name that obstore would read."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        use_endpoint(f"http://127.0.0.1:{silent.getsockname()[1]}", monkeypatch)
        monkeypatch.setenv("AWS_TIMEOUT", "200ms")
        started = time.monotonic()
        for said in sentences(ObjectStore("s3://theirs/data")):
            assert said.endswith(" did not answer in time; check the endpoint and the network")
        assert time.monotonic() - started < 15


@pytest.mark.parametrize(
    ("url", "text"),
    [
        (
            "ftp://host/data",
            r"ftp://host/data: no store has URLs of this kind; known are s3://, gs://, az:// and file://, and paths of folders",
        ),
        ("http://me:hunter2@host/data?sig=hunter2", r"http://host/data: no store has URLs"),
        (
            "s3://me:hunter2@bucket/data",
            r"s3://bucket/data: .*no user, password or query; give credentials by the environment \(AWS_\.\.\.\)",
        ),
        ("az://bucket/data?sig=hunter2", r"az://bucket/data: .*\(AZURE_\.\.\.\)"),
        ("s3://", r"s3://: no bucket is named; a store's URL is like s3://BUCKET/PREFIX"),
        ("gs:///data", r"gs:///data: no bucket is named; a store's URL is like gs://BUCKET/PREFIX"),
        ("s3://bu cket/data", r"no bucket is named"),
        ("s3://bucket/a/../b", r"no empty parts, no '\.' and no '\.\.' in its path"),
        ("s3://bucket/a//b", r"no empty parts"),
        ("s3://bucket/a/%2e%2e/b", r"no empty parts"),
        ("s3://[bucket/a", r"cannot be understood"),
        ("file://otherhost/data", r"file://otherhost/data: a file URL names a folder of this machine"),
    ],
)
def test_urls_that_cannot_be_meant(url: str, text: str) -> None:
    with pytest.raises(UsageError, match=text) as caught:
        open_store(url)
    assert "hunter2" not in str(caught.value)


@pytest.mark.parametrize("url", ["s3://bucket", "s3://bucket/", "S3://bucket/a/b/", "gs://bucket/a", "s3://bucket/.hidden/a"])
def test_urls_of_stores(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    use_endpoint("https://localhost", monkeypatch)
    assert open_store(url).location == url.replace("S3:", "s3:").rstrip("/")


def test_folders_by_path_and_by_url(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a b").mkdir()
    (tmp_path / "a b/x").write_bytes(b"x")
    monkeypatch.chdir(tmp_path)
    for location in (tmp_path / "a b", str(tmp_path / "a b"), "a b", (tmp_path / "a b").as_uri(), f"file://localhost{tmp_path}/a b"):
        store = open_store(location)
        assert isinstance(store, DirectoryStore)
        assert store.keys("") == ["x"]


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        (
            "AWS_ENDPOINT_URL",
            "http://127.0.0.1:9",
            "AWS_ENDPOINT_URL is plain http; set AWS_ALLOW_HTTP=true if that is meant, or use https",
        ),
        ("AWS_ENDPOINT", "localhost:9000", "the environment variable AWS_ENDPOINT is no URL of an endpoint; it is like https://HOST:PORT"),
        ("AWS_ALLOW_HTTP", "perhaps", "perhaps"),
        ("AWS_TIMEOUT", "soon", "soon"),
    ],
)
def test_an_environment_that_cannot_be_meant(name: str, value: str, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    use_endpoint("https://localhost", monkeypatch)
    monkeypatch.delenv("AWS_ALLOW_HTTP")
    monkeypatch.delenv("AWS_ENDPOINT_URL")
    monkeypatch.setenv(name, value)
    with pytest.raises(UsageError, match=text) as caught:
        open_store("s3://bucket/a")
    assert str(caught.value).isprintable()


def test_without_the_extra_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "obstore", None)
    with pytest.raises(MissingExtraError, match=r"need obstore: pip install 'clipmap\[cloud\]'"):
        open_store("s3://bucket/a")
    with pytest.raises(ClipmapError):
        open_dataset("s3://bucket/a")
