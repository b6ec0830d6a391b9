"""A server on loopback that speaks S3: moto's, which ``pip install 'clipmap[dev]'`` brings as ``moto[server]``.

It is other people's program, reached over HTTP as any S3 is; it checks no signatures. No account, container or MinIO is needed. Where it
cannot be started, the tests that need it are skipped and say why.
"""

import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import Final
from urllib.parse import quote
from xml.etree import ElementTree

import pytest

BUCKET: Final = "clipmap-tests"
_PROGRAM: Final = Path(__file__).with_name("s3_server.py")


@dataclass(frozen=True)
class S3Server:
    """A running server with a bucket; ``put`` and ``get`` reach the objects past the code under test.

    A folder of a test serves as a prefix that no other test has.
    """

    endpoint: str

    @property
    def environment(self) -> dict[str, str]:
        """Variables by which obstore finds the server."""
        return {
            "AWS_ENDPOINT_URL": self.endpoint,
            "AWS_ALLOW_HTTP": "true",
            "AWS_ACCESS_KEY_ID": "someone",
            "AWS_SECRET_ACCESS_KEY": "not-a-secret",
            "AWS_REGION": "us-east-1",
        }

    def url(self, place: Path) -> str:
        return f"s3://{BUCKET}{quote(str(place))}"

    def put(self, place: Path, key: str, data: bytes) -> None:
        self.request("PUT", f"{BUCKET}{place}/{key}", data)

    def get(self, place: Path, key: str) -> bytes | None:
        try:
            return self.request("GET", f"{BUCKET}{place}/{key}")
        except urllib.error.HTTPError as error:
            error.close()
            if error.code != 404:
                raise
            return None

    def delete(self, place: Path, key: str) -> None:
        self.request("DELETE", f"{BUCKET}{place}/{key}")

    def names(self, place: Path) -> list[str]:
        """Names of all objects below a place, hidden or not, sorted."""
        prefix = f"{place}/".lstrip("/")
        page = self.request("GET", BUCKET, query=f"list-type=2&max-keys=1000&prefix={quote(prefix)}")
        found = [element.text or "" for element in ElementTree.fromstring(page).iter() if element.tag.endswith("}Key")]
        return sorted(name.removeprefix(prefix) for name in found)

    def upload(self, folder: Path, place: Path) -> None:
        """Store every file of a folder, the manifest last, as a build does."""
        files = [path for path in folder.rglob("*") if path.is_file()]
        for path in sorted(files, key=lambda path: path.name == "manifest.json"):
            self.put(place, path.relative_to(folder).as_posix(), path.read_bytes())

    def request(self, method: str, name: str, data: bytes | None = None, query: str = "") -> bytes:
        # The server wants to see that a request is signed, not by whom; and it would take bytes without a type for a form.
        fields = {
            "Authorization": "AWS4-HMAC-SHA256 Credential=x/20260101/us-east-1/s3/aws4_request, SignedHeaders=host, Signature=0",
            "Content-Type": "application/octet-stream",
        }
        request = urllib.request.Request(f"{self.endpoint}/{quote(name)}{'?' if query else ''}{query}", data, fields, method=method)
        with urllib.request.urlopen(request, timeout=20) as answer:
            body: bytes = answer.read()
        return body


@contextmanager
def s3_server() -> Iterator[S3Server]:
    """Run the server in a process of its own as long as the context lasts."""
    pytest.importorskip("obstore", reason="the extra 'cloud' is not installed: pip install 'clipmap[dev]'")
    # What it logs of each request would fill a pipe that nobody reads, and stop it.
    with (
        TemporaryFile("w+") as log,
        subprocess.Popen(
            [sys.executable, "-W", "ignore", str(_PROGRAM)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True
        ) as process,
    ):
        assert process.stdout is not None
        port = process.stdout.readline().strip()
        if not port:
            log.seek(0)
            last = (log.read().splitlines() or ["no word"])[-1]
            pytest.skip(f"the S3-speaking server of moto[server], of the extra 'dev', does not start: {last}")
        server = S3Server(f"http://127.0.0.1:{port}")
        try:
            server.request("PUT", BUCKET)
            yield server
        finally:
            process.kill()
