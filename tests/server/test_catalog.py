import os
import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from schemas.address import BlockAddress
from schemas.errors import InputError, NotFoundError, UsageError
from schemas.manifest import Manifest
from schemas.settings import ServerSettings
from server import slots as slots_module
from server.app import create_app
from server.catalog import Catalog
from tests.server.datasets import block_bytes, write_dataset
from tiler.stores.dataset import Dataset, open_dataset

ADDRESS = BlockAddress(0, 2, 1)
URL = f"/alps/height/{ADDRESS}"


def names(client: TestClient) -> list[str]:
    return [dataset["name"] for dataset in client.get("/datasets").json()["datasets"]]


def client_of(*roots: Path) -> TestClient:
    return TestClient(create_app(ServerSettings(roots=roots)), raise_server_exceptions=False)


def test_the_catalogue_says_what_a_viewer_needs_to_choose(client: TestClient, alps: Manifest) -> None:
    catalogue = client.get("/datasets").json()
    assert catalogue["problems"] == []
    (dataset,) = catalogue["datasets"]
    assert (dataset["name"], dataset["version"], dataset["crs"]) == ("alps", alps.version, "EPSG:32632")
    height = dataset["layers"]["height"]
    stored = sum(len(block_bytes(1, BlockAddress(level, x, y))) for level, x, y in _height_addresses())
    assert {name: height[name] for name in ("kind", "width", "height", "levels", "block", "codec", "media_type", "stored", "bytes")} == {
        "kind": "height", "width": 19, "height": 13, "levels": 4, "block": 4, "codec": "lerc:0.01",
        "media_type": "application/octet-stream", "stored": 20 - 1 + 6 + 2 + 1, "bytes": stored,
    }  # fmt: skip
    assert height["extent"] == [100.0, 476.0, 136.0, 500.0]
    assert dataset["layers"]["imagery"]["extent"] == [100.0, 474.0, 138.0, 500.0]


def _height_addresses() -> list[tuple[int, int, int]]:
    counts = ((5, 4), (3, 2), (2, 1), (1, 1))
    every = [(level, x, y) for level, (columns, rows) in enumerate(counts) for x in range(columns) for y in range(rows)]
    return [address for address in every if address != (0, 4, 3)]


def test_the_links_of_the_catalogue_lead_somewhere(client: TestClient, root: Path) -> None:
    write_dataset(root / "Große Höhe #2")
    for dataset in client.get("/datasets").json()["datasets"]:
        manifest = client.get("/" + dataset["manifest"])
        assert (manifest.status_code, manifest.json()["version"]) == (200, dataset["version"])
        block = client.get("/" + dataset["layers"]["height"]["blocks"].format(level=0, x=2, y=1))
        assert (block.status_code, block.content) == (200, block_bytes(1, ADDRESS))
        assert "immutable" in block.headers["cache-control"]


def test_catalogue_and_manifest_are_revalidated(client: TestClient, alps: Manifest, root: Path) -> None:
    for url in ("/datasets", "/alps/manifest.json"):
        etag = client.get(url).headers["etag"]
        assert client.get(url, headers={"If-None-Match": etag}).status_code == 304
    assert client.get("/alps/manifest.json").content == alps.to_json()
    write_dataset(root / "alps", seed=2)
    for url in ("/datasets", "/alps/manifest.json"):
        assert client.get(url, headers={"If-None-Match": etag}).status_code == 200


def test_the_root_leads_to_the_catalogue(client: TestClient) -> None:
    answer = client.get("/")
    assert (answer.status_code, answer.headers["location"]) == (307, "datasets")


def test_health(client: TestClient, root: Path) -> None:
    from importlib.metadata import version

    assert client.get("/healthz").json() == {"status": "ok", "version": version("clipmap"), "datasets": 1}
    write_dataset(root / "rhine", seed=2)
    assert names(client) == ["alps", "rhine"]
    assert client.get("/healthz").json()["datasets"] == 2


def test_a_new_dataset_appears(client: TestClient, root: Path) -> None:
    assert client.get("/rhine/height/0/2/1").status_code == 404
    write_dataset(root / "rhine", seed=2)
    assert client.get("/rhine/height/0/2/1").content == block_bytes(2, ADDRESS)
    assert names(client) == ["alps", "rhine"]


def test_a_dataset_appears_when_its_first_build_is_finished(root: Path) -> None:
    (root / "alps" / "height").mkdir(parents=True)
    with client_of(root / "alps") as client:
        assert names(client) == []
        write_dataset(root / "alps")
        assert names(client) == ["alps"]
        assert client.get(URL).content == block_bytes(1, ADDRESS)


def test_a_rebuilt_dataset_is_a_new_version_throughout(client: TestClient, alps: Manifest, root: Path) -> None:
    assert client.get(URL, params={"v": alps.version}).status_code == 200
    rebuilt = write_dataset(root / "alps", seed=2)
    assert client.get(URL, params={"v": alps.version}).status_code == 410
    answer = client.get(URL, params={"v": rebuilt.version})
    assert (answer.status_code, answer.content) == (200, block_bytes(2, ADDRESS))
    assert client.get("/alps/manifest.json").json()["version"] == rebuilt.version
    assert client.get("/datasets").json()["datasets"][0]["version"] == rebuilt.version


def test_a_removed_dataset_is_404_until_it_returns(client: TestClient, root: Path) -> None:
    shutil.move(root / "alps", root.parent / "alps")
    assert client.get(URL).status_code == client.get("/alps/manifest.json").status_code == 404
    assert names(client) == []
    assert client.get("/healthz").json()["datasets"] == 0
    shutil.move(root.parent / "alps", root / "alps")
    assert client.get(URL).status_code == 200


def test_a_dataset_may_move_to_another_root(root: Path, alps: Manifest) -> None:
    other = root.parent / "other"
    other.mkdir()
    with client_of(root, other) as client:
        assert client.get(URL).status_code == 200
        shutil.move(root / "alps", other / "alps")
        assert client.get(URL).status_code == 200
        assert names(client) == ["alps"]


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b'{"format": "clipmap", "format_version": 99}', b"\xff\xfe"])
def test_running_viewers_keep_the_last_good_version_of_a_damaged_manifest(
    client: TestClient, alps: Manifest, root: Path, content: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    manifest = root / "alps" / "manifest.json"
    good = manifest.read_bytes()
    assert client.get(URL).status_code == 200
    manifest.write_bytes(content)
    for _ in range(3):
        answer = client.get(URL, params={"v": alps.version})
        assert (answer.status_code, answer.content) == (200, block_bytes(1, ADDRESS))
        assert client.get("/alps/manifest.json").content == good
    assert caplog.text.count(str(manifest)) == 1
    catalogue = client.get("/datasets").json()
    assert [dataset["name"] for dataset in catalogue["datasets"]] == ["alps"]
    assert alps.version in catalogue["problems"][0]["detail"]
    manifest.write_bytes(good)
    assert client.get("/datasets").json()["problems"] == []


def test_a_manifest_that_was_never_good_is_503(root: Path, alps: Manifest) -> None:
    (root / "broken").mkdir()
    (root / "broken" / "manifest.json").write_bytes(b"{")
    with client_of(root) as client:
        for url in ("/broken/manifest.json", "/broken/height/0/0/0"):
            answer = client.get(url)
            assert (answer.status_code, answer.headers["content-type"]) == (503, "application/problem+json")
            assert str(root) not in answer.text
        assert names(client) == ["alps"]
        assert client.get("/datasets").json()["problems"][0]["name"] == "broken"
        write_dataset(root / "broken", seed=2)
        assert client.get("/broken/height/0/2/1").content == block_bytes(2, ADDRESS)


def test_an_unreadable_manifest_is_tried_again(
    root: Path, alps: Manifest, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Reading fails for a reason that leaves no trace in the file's status, e.g. too many open files."""
    from schemas.errors import StorageError

    def fail(path: Path) -> None:
        raise StorageError(f"{path}: cannot be read: Too many open files")

    with client_of(root) as client:
        rebuilt = write_dataset(root / "alps", seed=2)
        with monkeypatch.context() as patch:
            patch.setattr(slots_module, "open_dataset", fail)
            for _ in range(3):
                assert client.get("/alps/manifest.json").json()["version"] == alps.version
        assert caplog.text.count("Too many open files") == 1
        assert client.get("/alps/manifest.json").json()["version"] == rebuilt.version


def test_hidden_and_other_folders_are_no_datasets(client: TestClient, root: Path) -> None:
    write_dataset(root / ".draft", seed=2)
    (root / "empty").mkdir()
    (root / "manifest.txt").write_text("not a dataset")
    (root / "deep").mkdir()
    write_dataset(root / "deep" / "down", seed=3)
    assert names(client) == ["alps"]
    for name in (".draft", "empty", "deep", "down", "manifest.txt"):
        assert client.get(f"/{name}/manifest.json").status_code == 404


def test_folder_names_that_are_no_text_are_skipped(client: TestClient, root: Path) -> None:
    try:
        os.mkdir(os.fsencode(root) + b"/\xff\xfe")
    except OSError:
        pytest.skip("this file system takes only text as names")
    (Path(os.fsdecode(os.fsencode(root) + b"/\xff\xfe")) / "manifest.json").write_bytes(b"{")
    assert names(client) == ["alps"]


def test_roots_may_be_datasets_and_folders(root: Path, alps: Manifest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_dataset(tmp_path / "rhine", seed=2)
    monkeypatch.chdir(tmp_path / "rhine")
    with client_of(Path("."), root, root / "alps") as client:
        assert names(client) == ["alps", "rhine"]


def test_roots_that_cannot_be_served(root: Path, alps: Manifest, tmp_path: Path) -> None:
    with pytest.raises(NotFoundError, match=r"nowhere: no such folder"):
        Catalog([root, tmp_path / "nowhere"])
    with pytest.raises(InputError, match=r"manifest\.json: is not a folder"):
        Catalog([root / "alps" / "manifest.json"])
    write_dataset(tmp_path / "other" / "alps", seed=2)
    with pytest.raises(UsageError) as caught:
        Catalog([root, tmp_path / "other"])
    assert str(root / "alps") in str(caught.value)
    assert str(tmp_path / "other" / "alps") in str(caught.value)
    (root / "alps" / "manifest.json").write_bytes(b"{")
    with pytest.raises(InputError, match=r"manifest\.json: not a manifest"):
        Catalog([root / "alps"])


def test_a_name_that_turns_up_twice_stays_where_it_was(root: Path, alps: Manifest, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    with client_of(other, root) as client:
        write_dataset(other / "alps", seed=2)
        assert client.get(URL).content == block_bytes(1, ADDRESS)
        assert client.get("/datasets").json()["datasets"][0]["version"] == alps.version


def test_the_manifest_is_read_once_per_version(root: Path, alps: Manifest, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[Path] = []

    def counted(path: Path) -> Dataset:
        opened.append(path)
        time.sleep(0.05)  # long enough for every other thread to arrive meanwhile
        return open_dataset(path)

    monkeypatch.setattr(slots_module, "open_dataset", counted)
    catalog = Catalog([root])
    with ThreadPoolExecutor(8) as pool:
        assert len({id(published) for published in pool.map(catalog.dataset, ["alps"] * 200)}) == 1
        assert len(opened) == 1
        write_dataset(root / "alps", seed=2)
        assert len({id(published) for published in pool.map(catalog.dataset, ["alps"] * 200)}) == 1
    assert len(opened) == 2


@pytest.mark.parametrize("name", ["..", ".", "%2e%2e", "..%2f..", "%00", "alps%00", "%2fetc", "~", "alps%2f..", "..\\", "%ff"])
@pytest.mark.parametrize("rest", ["manifest.json", "height/0/0/0"])
def test_no_name_becomes_a_path(root: Path, alps: Manifest, name: str, rest: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Datasets beside and above the root stay unreachable; the only files touched are those of the catalogue."""
    write_dataset(root.parent, seed=2)
    with client_of(root) as client:
        touched: list[str] = []
        real = os.stat

        def noted(path: str, **options: Any) -> os.stat_result:
            touched.append(os.fspath(path))
            return real(path, **options)

        with monkeypatch.context() as patch:
            patch.setattr(os, "stat", noted)
            answer = client.get(f"/{name}/{rest}")
        assert answer.status_code in (400, 404)
        assert {path for path in touched if path.startswith(str(root.parent))} <= {
            str(root / "manifest.json"),
            str(root / "alps/manifest.json"),
        }
