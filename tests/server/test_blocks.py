import logging
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from schemas.address import BlockAddress, block_name
from schemas.lattice import Lattice
from schemas.manifest import Manifest, digest
from tests.server.datasets import block_bytes, write_dataset
from tiler.stores.dataset import Dataset

ADDRESS = BlockAddress(0, 2, 1)
BYTES = block_bytes(1, ADDRESS)
URL = f"/alps/height/{ADDRESS}"
IMMUTABLE = "public, max-age=31536000, immutable"
REVALIDATE = "public, no-cache"


def block_path(root: Path, alps: Manifest, address: BlockAddress = ADDRESS) -> Path:
    return root / "alps" / alps.layer("height").block_key("height", address)


def test_every_block_has_its_stored_bytes_under_address_and_name(client: TestClient, alps: Manifest) -> None:
    lattice = Lattice(19, 13, 4)
    seeds = {"height": 1, "imagery": 1001}
    for name, layer in alps.layers.items():
        for level in range(lattice.levels):
            for address in lattice.addresses(level):
                if (name, address) == ("height", BlockAddress(0, 4, 3)):
                    continue
                by_address = client.get(f"/alps/{name}/{address}")
                by_name = client.get(f"/alps/{name}/q/{block_name(name, address, lattice.levels, layer.suffix)}")
                assert by_address.content == by_name.content == block_bytes(seeds[name], address)
                assert by_address.headers == by_name.headers
                assert by_address.headers["content-type"] == layer.media_type
                assert by_address.headers["etag"] == f'"{digest(by_address.content)}"'
                assert by_address.headers["content-length"] == str(len(by_address.content))
                assert by_address.headers["accept-ranges"] == "bytes"


@pytest.mark.parametrize(
    "url", [URL, "/alps/manifest.json", "/datasets", "/healthz", "/openapi.json", "/", "/alps/height/0/4/3", "/nowhere"]
)
def test_head_has_the_headers_of_get_and_no_body(client: TestClient, url: str) -> None:
    got, headed = client.get(url), client.head(url)
    assert (headed.status_code, headed.headers) == (got.status_code, got.headers)
    assert headed.content == b""


def test_cache_lifetime_depends_on_the_version_in_the_url(client: TestClient, alps: Manifest) -> None:
    for url in (URL, "/alps/height/q/height-3.lerc", "/alps/height/0/4/3", "/alps/manifest.json"):
        assert client.get(url).headers["cache-control"] == REVALIDATE
        assert client.get(url, params={"v": alps.version}).headers["cache-control"] == IMMUTABLE


@pytest.mark.parametrize("stale", ["0" * 32, "", "latest", "A" * 500])
@pytest.mark.parametrize("url", [URL, "/alps/height/q/height-3.lerc", "/alps/height/0/4/3", "/alps/manifest.json"])
def test_another_version_is_gone(client: TestClient, url: str, stale: str) -> None:
    answer = client.get(url, params={"v": stale})
    assert answer.status_code == 410
    assert answer.headers["content-type"] == "application/problem+json"
    # Data that are put back have their old version again, so the answer must not outlive the moment.
    assert answer.headers["cache-control"] == "no-store"
    assert "read its manifest again" in answer.json()["detail"]


def test_a_current_copy_is_not_sent_again_and_not_even_read(client: TestClient, alps: Manifest, root: Path) -> None:
    block_path(root, alps).unlink()
    etag = f'"{digest(BYTES)}"'
    for field in (etag, f"W/{etag}", f'"other", {etag}', "*"):
        for method in ("GET", "HEAD"):
            answer = client.request(method, URL, headers={"If-None-Match": field}, params={"v": alps.version})
            assert (answer.status_code, answer.content) == (304, b"")
            assert (answer.headers["etag"], answer.headers["cache-control"]) == (etag, IMMUTABLE)
            assert answer.headers["access-control-allow-origin"] == "*"
            assert "content-type" not in answer.headers
            assert "content-length" not in answer.headers


def test_if_none_match_in_two_header_lines(client: TestClient) -> None:
    lines = [("If-None-Match", '"other"'), ("If-None-Match", f'"{digest(BYTES)}"')]
    assert client.get(URL, headers=lines).status_code == 304


def test_an_outdated_copy_is_replaced(client: TestClient) -> None:
    answer = client.get(URL, headers={"If-None-Match": '"0123"'})
    assert (answer.status_code, answer.content) == (200, BYTES)


@pytest.mark.parametrize(("field", "part"), [("bytes=0-9", slice(0, 10)), ("bytes=50-", slice(50, None)), ("bytes=-7", slice(-7, None))])
def test_range(client: TestClient, field: str, part: slice) -> None:
    answer = client.get(URL, headers={"Range": field})
    start, stop, _ = part.indices(len(BYTES))
    assert (answer.status_code, answer.content) == (206, BYTES[part])
    assert answer.headers["content-range"] == f"bytes {start}-{stop - 1}/{len(BYTES)}"
    assert answer.headers["content-length"] == str(stop - start)
    assert answer.headers["etag"] == f'"{digest(BYTES)}"'


def test_ranges_that_are_answered_with_everything(client: TestClient) -> None:
    for field in ("bytes=0-1,4-5", "bytes=9-1", "pages=1-2", "nonsense"):
        answer = client.get(URL, headers={"Range": field})
        assert (answer.status_code, answer.content) == (200, BYTES)
    assert client.head(URL, headers={"Range": "bytes=0-9"}).status_code == 200


def test_unsatisfiable_range(client: TestClient) -> None:
    answer = client.get(URL, headers={"Range": f"bytes={len(BYTES)}-"})
    assert answer.status_code == 416
    assert answer.headers["content-range"] == f"bytes */{len(BYTES)}"
    assert answer.headers["content-type"] == "application/problem+json"


def test_if_range(client: TestClient) -> None:
    etag = f'"{digest(BYTES)}"'
    assert client.get(URL, headers={"Range": "bytes=0-9", "If-Range": etag}).status_code == 206
    for outdated in ('"0123"', f"W/{etag}", "Wed, 21 Oct 2015 07:28:00 GMT"):
        answer = client.get(URL, headers={"Range": "bytes=0-9", "If-Range": outdated})
        assert (answer.status_code, answer.content) == (200, BYTES)


def test_if_none_match_comes_before_range(client: TestClient) -> None:
    headers = {"If-None-Match": f'"{digest(BYTES)}"', "Range": "bytes=100000-"}
    assert client.get(URL, headers=headers).status_code == 304


def test_blank_block(client: TestClient) -> None:
    for headers in ({}, {"Range": "bytes=0-1"}, {"If-None-Match": '"0123"'}):
        answer = client.get("/alps/height/0/4/3", headers=headers)
        assert (answer.status_code, answer.content) == (204, b"")
        assert answer.headers["cache-control"] == REVALIDATE
        assert answer.headers["access-control-allow-origin"] == "*"
    assert client.get("/alps/imagery/0/4/3").status_code == 200


@pytest.mark.parametrize(
    "path",
    [
        "height/0/5/0", "height/0/0/4", "height/1/3/0", "height/4/0/0", "height/9/0/0", "height/0/2147483647/0", "light/0/0/0",
        "HEIGHT/0/0/0", "height/q/imagery-3.lerc", "height/q/height-3.webp", "height/q/height-2.lerc", "height/q/height-0-0123.lerc",
        "height/q/height-0-111.lerc",
        "height/0/0", "height/0/0/0/0", "height", "", "q/height-3.lerc", "height/q/",
    ],
)  # fmt: skip
def test_what_does_not_exist_is_404(client: TestClient, path: str) -> None:
    answer = client.get(f"/alps/{path}")
    assert (answer.status_code, answer.json()["title"]) == (404, "Not Found")


def test_an_unknown_layer_is_answered_with_those_there_are(client: TestClient) -> None:
    assert client.get("/alps/light/0/0/0").json()["detail"] == "no layer 'light' in the dataset; it has height, imagery"


@pytest.mark.parametrize(
    "path",
    [
        "0/0/a", "0/a/0", "a/0/0", "0/-1/0", "0/0/-1", "-1/0/0", "0/1.0/0", "0/+1/0", "0/01/0", "0/ 1/0", "0/1e0/0", "0/1_0/0", "0/0x1/0",
        "0/2147483648/0", "0/99999999999999999999/0", f"0/{'9' * 5000}/0", "0/%D9%A1/0", "0/0/..%00", "q/a/b", "0/%2e%2e/0",
        "q/height", "q/height-0-4.lerc", "q/..%00", "q/%2e%2e", "q/height-3.lerc%00", "q/height-3.lerc%0a", "q/index.bin",
        f"q/height-{'9' * 5000}.lerc",
    ],
)  # fmt: skip
def test_what_cannot_be_understood_is_400(client: TestClient, path: str) -> None:
    answer = client.get(f"/alps/height/{path}")
    assert answer.status_code == 400
    assert answer.headers["content-type"] == "application/problem+json"
    problem = answer.json()
    assert set(problem) == {"type", "title", "status", "detail"}
    assert (problem["type"], problem["title"], problem["status"]) == ("about:blank", "Bad Request", 400)


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH"])
@pytest.mark.parametrize("url", [URL, "/datasets", "/healthz", "/alps/manifest.json"])
def test_other_methods(client: TestClient, method: str, url: str) -> None:
    answer = client.request(method, url)
    assert (answer.status_code, answer.headers["allow"]) == (405, "GET, HEAD, OPTIONS")
    assert answer.json()["status"] == 405


@pytest.mark.parametrize("damage", ["truncated", "extended", "missing", "a folder"])
def test_a_damaged_block_is_named_and_logged_but_never_sent(
    client: TestClient, alps: Manifest, root: Path, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = block_path(root, alps)
    path.unlink()
    if damage == "a folder":
        path.mkdir()
    elif damage != "missing":
        path.write_bytes(BYTES[:-1] if damage == "truncated" else BYTES + b"x")
    answer = client.get(URL)
    assert (answer.status_code, answer.headers["content-type"]) == (500, "application/problem+json")
    assert "block 0/2/1 of layer 'height' of dataset 'alps'" in answer.json()["detail"]
    assert str(root) not in answer.text  # where the files lie is no client's business
    assert str(path) in caplog.text
    assert client.get("/alps/height/0/0/0").status_code == 200


@pytest.mark.parametrize("damage", ["missing", "truncated", "altered"])
def test_a_damaged_index_stops_its_level_only(client: TestClient, alps: Manifest, root: Path, damage: str) -> None:
    index = root / "alps" / alps.layer("height").index_key(0)
    data = bytearray(index.read_bytes())
    index.unlink()
    if damage == "truncated":
        index.write_bytes(data[:-1])
    elif damage == "altered":
        data[5] ^= 1
        index.write_bytes(data)
    answer = client.get(URL)
    assert (answer.status_code, answer.json()["status"]) == (500, 500)
    assert str(root) not in answer.text
    assert client.get("/alps/height/1/0/0").status_code == 200


def test_an_unforeseen_error_shows_no_traceback(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("secret")

    monkeypatch.setattr(Dataset, "block", fail)
    answer = client.get(URL)
    assert (answer.status_code, answer.headers["content-type"]) == (500, "application/problem+json")
    assert answer.headers["access-control-allow-origin"] == "*"
    assert "secret" not in answer.text


def test_a_disk_that_fails_is_500_and_in_the_log(
    client: TestClient, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    from schemas.errors import StorageError

    def fail(*_: object) -> None:
        raise StorageError("/srv/alps: Input/output error")

    monkeypatch.setattr(Dataset, "block", fail)
    with caplog.at_level(logging.ERROR):
        answer = client.get(URL)
    assert (answer.status_code, answer.headers["content-type"]) == (500, "application/problem+json")
    assert "/srv" not in answer.text
    assert "/srv/alps: Input/output error" in caplog.text


class Rebuilder:
    """Publishes a new version and deletes the old blocks between a request's look at the index and its read of the block."""

    def __init__(self, folder: Path, times: int, seed: int) -> None:
        self.folder, self.times, self.seed = folder, times, seed
        self.read = Dataset.block

    def block(self, dataset: Dataset, layer: str, address: BlockAddress) -> bytes | None:
        if self.times:
            self.times -= 1
            self.seed += 1
            write_dataset(self.folder, seed=self.seed)
            for old in dataset.manifest.layers.values():
                shutil.rmtree(self.folder / old.path)
        return self.read(dataset, layer, address)

    def install(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def block(dataset: Dataset, layer: str, address: BlockAddress) -> bytes | None:
            return self.block(dataset, layer, address)

        monkeypatch.setattr(Dataset, "block", block)


def test_a_rebuild_during_a_request_never_mixes_versions(client: TestClient, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Rebuilder(root / "alps", times=1, seed=1).install(monkeypatch)
    answer = client.get(URL)
    assert (answer.status_code, answer.content) == (200, block_bytes(2, ADDRESS))
    assert answer.headers["etag"] == f'"{digest(answer.content)}"'


def test_a_rebuild_during_a_request_for_the_old_version_is_410(
    client: TestClient, alps: Manifest, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Rebuilder(root / "alps", times=1, seed=1).install(monkeypatch)
    assert client.get(URL, params={"v": alps.version}).status_code == 410


def test_a_dataset_that_is_rebuilt_all_the_time_is_given_up(client: TestClient, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rebuilder = Rebuilder(root / "alps", times=100, seed=1)
    rebuilder.install(monkeypatch)
    answer = client.get(URL)
    assert (answer.status_code, rebuilder.times) == (500, 97)


def test_many_threads_get_equal_bytes(client: TestClient, alps: Manifest) -> None:
    addresses = [address for level in range(4) for address in Lattice(19, 13, 4).addresses(level) if address != BlockAddress(0, 4, 3)] * 4

    def fetch(address: BlockAddress) -> tuple[int, bytes]:
        answer = client.get(f"/alps/height/{address}", params={"v": alps.version})
        return answer.status_code, answer.content

    with ThreadPoolExecutor(8) as pool:
        for address, got in zip(addresses, pool.map(fetch, addresses), strict=True):
            assert got == (200, block_bytes(1, address))
