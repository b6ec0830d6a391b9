import json
import subprocess
import sys
from http import HTTPStatus
from pathlib import Path

import pytest
from starlette.routing import Route
from starlette.testclient import TestClient

from schemas.manifest import Manifest
from schemas.settings import ServerSettings
from server.app import create_app

URL = "/alps/height/0/2/1"


def test_the_service_starts_without_anything_that_decodes(root: Path, alps: Manifest) -> None:
    program = f"""
import sys
from pathlib import Path
from schemas.settings import ServerSettings
from server.app import create_app
import server.listener
create_app(ServerSettings(roots=(Path({str(root)!r}),)))
heavy = {{"numpy", "numba", "OpenImageIO", "OpenEXR", "imagecodecs", "rasterio"}} & set(sys.modules)
sys.exit(f"imported: {{heavy}}" if heavy else 0)
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)


def test_two_services_in_one_process_share_nothing(root: Path, alps: Manifest, tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    full, bare = (TestClient(create_app(ServerSettings(roots=(folder,)))) for folder in (root, empty))
    assert full.get(URL).status_code == 200
    assert bare.get(URL).status_code == 404
    assert bare.get("/datasets").json() == {"datasets": [], "problems": []}


def test_pages_of_any_origin_may_read_every_answer(client: TestClient) -> None:
    for url in (
        URL,
        "/alps/height/0/4/3",
        "/alps/manifest.json",
        "/datasets",
        "/healthz",
        "/openapi.json",
        "/",
        "/alps/height/0/9/9",
        "/no",
    ):
        headers = client.get(url).headers
        assert headers["access-control-allow-origin"] == "*", url
        assert {"ETag", "Content-Range"} <= set(headers["access-control-expose-headers"].split(", ")), url


def test_browsers_may_send_conditions_and_ranges(client: TestClient) -> None:
    asked = {"Origin": "https://viewer.example", "Access-Control-Request-Method": "GET", "Access-Control-Request-Headers": "if-none-match"}
    answer = client.options(URL, headers=asked)
    assert answer.status_code == 204
    assert answer.headers["access-control-allow-origin"] == "*"
    assert "If-None-Match" in answer.headers["access-control-allow-headers"]
    assert answer.headers["access-control-allow-methods"] == "GET, HEAD"
    assert "access-control-allow-credentials" not in answer.headers


@pytest.mark.parametrize("url", ["/docs", "/redoc", "/docs/oauth2-redirect", "/datasets/", "/static/x.js"])
def test_no_page_that_loads_scripts_from_elsewhere(client: TestClient, url: str) -> None:
    answer = client.get(url)
    assert answer.status_code == 404
    assert answer.headers["content-type"] == "application/problem+json"


def test_the_openapi_document_covers_every_route(client: TestClient) -> None:
    document = client.get("/openapi.json").json()
    routes = [route for route in client.app.routes if isinstance(route, Route)]  # type: ignore[attr-defined]  # an ASGI app to the client
    assert {route.path for route in routes} == set(document["paths"])
    for path in document["paths"]:
        assert {method for route in routes if route.path == path for method in route.methods or ()} == {"GET", "HEAD"}
    assert "422" not in json.dumps(document)


def test_the_openapi_document_knows_statuses_and_headers_of_blocks(client: TestClient, alps: Manifest) -> None:
    paths = client.get("/openapi.json").json()["paths"]
    requests: list[tuple[str, dict[str, str], int]] = [
        (URL, {}, 200),
        ("/alps/height/0/4/3", {}, 204),
        (URL, {"Range": "bytes=0-1"}, 206),
        (URL, {"If-None-Match": "*"}, 304),
        ("/alps/height/0/a/1", {}, 400),
        ("/alps/height/0/9/9", {}, 404),
        (f"{URL}?v=old", {}, 410),
        (URL, {"Range": "bytes=999-"}, 416),
    ]
    unmentioned = {"content-length", "content-type", "access-control-expose-headers"}
    for path in ("/{dataset}/{layer}/{level}/{x}/{y}", "/{dataset}/{layer}/q/{name}"):
        responses = paths[path]["get"]["responses"]
        assert set(responses) == {"200", "204", "206", "304", "400", "404", "405", "410", "416", "500", "503", "default"}
        for url, headers, status in requests:
            answer = client.get(url, headers=headers)
            assert answer.status_code == status
            described = {name.lower() for name in responses[str(status)]["headers"]}
            assert set(answer.headers) - unmentioned == described - unmentioned, (path, status)
            if status >= HTTPStatus.BAD_REQUEST:
                assert responses[str(status)]["content"]["application/problem+json"]["schema"]["$ref"].endswith("/Problem")
