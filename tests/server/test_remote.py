"""Datasets served from a bucket (server: ``tests/s3.py``): new versions are seen, and a store that fails holds up nobody else."""

import logging
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from schemas.address import BlockAddress
from schemas.errors import InputError, NotFoundError, StorageError, UsageError
from schemas.manifest import Manifest
from schemas.settings import ServerSettings
from server import remote
from server.app import create_app
from server.catalog import Catalog
from server.remote import READS_AT_ONCE, reads_each
from tests.s3 import S3Server
from tests.server.datasets import block_bytes, write_dataset
from tiler.stores.objects import ObjectStore

ADDRESS = BlockAddress(0, 2, 1)
BLANK = BlockAddress(0, 4, 3)
URL = f"/alps/height/{ADDRESS}"


@pytest.fixture
def place(tmp_path: Path) -> Path:
    return tmp_path / "bucket" / "alps"


def publish(s3: S3Server, place: Path, tmp_path: Path, seed: int = 1) -> Manifest:
    """Build beside, and upload: the blocks of a version have a path of their own, the manifest comes last."""
    folder = tmp_path / f"built-{seed}"
    manifest = write_dataset(folder, seed=seed, blank=[BLANK])
    s3.upload(folder, place)
    return manifest


@pytest.fixture
def alps(s3: S3Server, place: Path, tmp_path: Path) -> Manifest:
    return publish(s3, place, tmp_path)


@pytest.fixture
def client(s3: S3Server, place: Path, alps: Manifest) -> Iterator[TestClient]:
    with client_of(s3.url(place)) as client:
        yield client


def client_of(*roots: str | Path) -> TestClient:
    return TestClient(create_app(ServerSettings(roots=roots)), raise_server_exceptions=False)


def until(true: Callable[[], bool], limit_s: float = 20) -> None:
    deadline = time.monotonic() + limit_s
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_blocks_come_by_the_same_path_as_from_a_folder(client: TestClient, alps: Manifest, tmp_path: Path) -> None:
    local = tmp_path / "folder"
    write_dataset(local / "alps", blank=[BLANK])
    with client_of(local) as other:
        for url in (
            URL,
            f"{URL}?v={alps.version}",
            "/alps/manifest.json",
            "/datasets",
            "/alps/height/0/4/3",
            "/alps/imagery/q/imagery-3.webp",
            "/alps/height/9/0/0",
        ):
            for fields in ({}, {"Range": "bytes=3-9"}):
                mine, theirs = client.get(url, headers=fields), other.get(url, headers=fields)
                assert (mine.status_code, mine.content, mine.headers) == (theirs.status_code, theirs.content, theirs.headers)
    assert client.get(URL).content == block_bytes(1, ADDRESS)
    etag = client.get(URL).headers["etag"]
    assert client.get(URL, headers={"If-None-Match": etag}).status_code == 304


def test_a_new_version_is_served_as_soon_as_it_was_looked_for(
    client: TestClient, s3: S3Server, place: Path, alps: Manifest, tmp_path: Path
) -> None:
    assert client.get(URL).content == block_bytes(1, ADDRESS)
    second = publish(s3, place, tmp_path, seed=2)
    until(lambda: client.get("/alps/manifest.json").json()["version"] == second.version, 5)
    assert client.get(URL).content == block_bytes(2, ADDRESS)
    assert client.get(URL, params={"v": alps.version}).status_code == 410
    assert client.get("/datasets").json()["datasets"][0]["version"] == second.version


def test_blocks_of_the_old_version_may_go_at_once(client: TestClient, s3: S3Server, place: Path, alps: Manifest, tmp_path: Path) -> None:
    """No request sees the gap between two looks: a block that is missing makes the service look again."""
    ObjectStore(s3.url(place)).keys("")
    assert client.get("/alps/height/0/0/0").status_code == 200
    publish(s3, place, tmp_path, seed=2)
    ObjectStore(s3.url(place)).delete_prefix(alps.layer("height").path)
    answer = client.get(URL)
    assert (answer.status_code, answer.content) == (200, block_bytes(2, ADDRESS))


def test_a_block_that_is_missing_is_damage(client: TestClient, s3: S3Server, place: Path, alps: Manifest) -> None:
    s3.delete(place, alps.layer("height").block_key("height", ADDRESS))
    assert client.get(URL).status_code == 500
    s3.put(place, alps.layer("height").block_key("height", ADDRESS), b"short")
    assert client.get(URL).status_code == 500


def test_a_dataset_that_is_removed_is_404_until_it_returns(client: TestClient, s3: S3Server, place: Path, alps: Manifest) -> None:
    manifest = s3.get(place, "manifest.json") or b""
    s3.delete(place, "manifest.json")
    until(lambda: client.get(URL).status_code == 404)
    assert client.get("/datasets").json()["datasets"] == []
    s3.put(place, "manifest.json", manifest)
    until(lambda: client.get(URL).status_code == 200)


def test_a_damaged_manifest_leaves_the_last_good_version_in_service(
    client: TestClient, s3: S3Server, place: Path, alps: Manifest, caplog: pytest.LogCaptureFixture
) -> None:
    s3.put(place, "manifest.json", b"{")
    until(lambda: client.get("/datasets").json()["problems"] != [])
    assert client.get(URL, params={"v": alps.version}).content == block_bytes(1, ADDRESS)
    assert f"version {alps.version} stays in service" in caplog.text
    assert f"version {alps.version} stays in service" in client.get("/datasets").json()["problems"][0]["detail"]
    assert "s3://" not in client.get("/datasets").text
    s3.put(place, "manifest.json", alps.to_json())
    until(lambda: client.get("/datasets").json()["problems"] == [])


def test_roots_that_cannot_be_served(s3: S3Server, place: Path, alps: Manifest, tmp_path: Path) -> None:
    with pytest.raises(NotFoundError, match=r"^s3://.*nowhere: no dataset there \(no manifest.json\); give the URL of a dataset$"):
        Catalog([s3.url(tmp_path / "nowhere")])
    with pytest.raises(StorageError, match="there is no bucket 'no-such-bucket'"):
        Catalog(["s3://no-such-bucket/alps"])
    s3.put(tmp_path / "broken", "manifest.json", b"{")
    with pytest.raises(InputError, match="not a manifest"):
        Catalog([s3.url(tmp_path / "broken")])
    write_dataset(tmp_path / "folder" / "alps")
    with pytest.raises(UsageError, match="are both called 'alps'; rename one of them"):
        Catalog([tmp_path / "folder", s3.url(place)])
    assert Catalog([s3.url(place), s3.url(place) + "/"]).names() == ["alps"]
    assert Catalog([(tmp_path / "folder/alps").as_uri()]).names() == ["alps"]


def test_a_store_is_looked_at_once_a_second_at_most(s3: S3Server, place: Path, alps: Manifest, monkeypatch: pytest.MonkeyPatch) -> None:
    looks = []
    real = ObjectStore.read_if_changed

    def counted(store: ObjectStore, key: str, tag: str | None) -> tuple[bytes, str | None] | None:
        looks.append(tag)
        return real(store, key, tag)

    monkeypatch.setattr(ObjectStore, "read_if_changed", counted)
    catalog = Catalog([s3.url(place)])
    begun = time.monotonic()
    with ThreadPoolExecutor(8) as pool:
        assert len({id(published) for published in pool.map(catalog.dataset, ["alps"] * 400)}) == 1
    assert len(looks) <= 2 + (time.monotonic() - begun)
    assert looks[0] is None
    assert None not in looks[1:], "an unchanged manifest is not sent again"


class Stuck:
    """A store that stops to answer until it is released."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.released = threading.Event()
        real_read, real_look = ObjectStore.read, ObjectStore.read_if_changed

        def read(store: ObjectStore, key: str) -> bytes:
            assert self.released.wait(30)
            return real_read(store, key)

        def look(store: ObjectStore, key: str, tag: str | None) -> tuple[bytes, str | None] | None:
            assert self.released.wait(30)
            return real_look(store, key, tag)

        monkeypatch.setattr(ObjectStore, "read", read)
        monkeypatch.setattr(ObjectStore, "read_if_changed", look)


def test_a_store_that_does_not_answer_holds_up_nobody_else(
    s3: S3Server, place: Path, alps: Manifest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More requests for its blocks than the service has threads; those for a folder are answered meanwhile."""
    write_dataset(tmp_path / "folder" / "rhine", seed=3)
    with client_of(tmp_path / "folder", s3.url(place)) as client, ThreadPoolExecutor(80) as pool:
        stuck = Stuck(monkeypatch)
        waiting = [pool.submit(client.get, URL) for _ in range(60)]
        try:
            for _ in range(5):
                assert client.get("/rhine/height/0/2/1").content == block_bytes(3, ADDRESS)
                assert len(client.get("/datasets").json()["datasets"]) == 2
            until(lambda: sum(answer.done() for answer in waiting) >= 60 - READS_AT_ONCE)
            refused = [answer.result() for answer in waiting if answer.done()]
            assert {answer.status_code for answer in refused} == {503}
            assert "is slower than the requests come; ask again" in refused[0].json()["detail"]
        finally:
            stuck.released.set()
        assert {answer.result().status_code for answer in waiting} == {200, 503}
        assert client.get(URL).status_code == 200


def test_a_store_that_fails_is_503_and_its_reason_is_for_the_log(
    client: TestClient, alps: Manifest, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(store: ObjectStore, *_: object) -> bytes:
        raise StorageError(f"{store.location}: cannot be read: the store answered 503")

    with monkeypatch.context() as patch, caplog.at_level(logging.ERROR):
        patch.setattr(ObjectStore, "read", fail)
        patch.setattr(ObjectStore, "read_if_changed", fail)
        answer = client.get(URL)
        assert (answer.status_code, answer.headers["cache-control"]) == (503, "no-store")
        assert "s3://" not in answer.text
        assert "s3://" in caplog.text
        until(lambda: client.get("/datasets").json()["problems"] != [])
        assert client.get("/alps/manifest.json").json()["version"] == alps.version
    until(lambda: client.get("/datasets").json()["problems"] == [])
    assert client.get(URL).status_code == 200


def test_threads_are_left_for_folders_however_many_stores_there_are() -> None:
    assert [reads_each(count) for count in (1, 2, 5, 16)] == [32, 16, 6, 2]
    assert all(count * reads_each(count) <= READS_AT_ONCE < 40 for count in range(1, 17))
    assert remote._PATIENCE_S <= 1
