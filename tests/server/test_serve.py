"""``clipmap serve`` as a user starts it: another process, a real socket, signals."""

import errno
import http.client
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

from schemas.address import BlockAddress
from schemas.manifest import Manifest
from tests.server.datasets import block_bytes, write_dataset

TIMEOUT_S = 60
COMMAND = [sys.executable, "-c", "from cli.main import main; main()", "serve"]
ADDRESS = BlockAddress(0, 2, 1)
URL = f"/alps/height/{ADDRESS}"


class Service:
    def __init__(self, process: "subprocess.Popen[str]") -> None:
        self.process = process
        assert process.stdout is not None
        self.line = process.stdout.readline()
        url = urlsplit(self.line.split()[-1])
        self.host, self.port = url.hostname or "", url.port or 0

    def request(self, target: str, method: str = "GET", headers: dict[str, str] | None = None) -> tuple[int, dict[str, str], bytes]:
        """Send ``target`` as it stands; a URL library would tidy it up."""
        connection = http.client.HTTPConnection(self.host, self.port, timeout=TIMEOUT_S)
        try:
            connection.putrequest(method, target, skip_accept_encoding=True)
            for name, value in (headers or {}).items():
                connection.putheader(name, value)
            connection.endheaders()
            answer = connection.getresponse()
            return answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()
        finally:
            connection.close()

    def stop(self, number: signal.Signals) -> tuple[int, str, str]:
        self.process.send_signal(number)
        rest, errors = self.process.communicate(timeout=TIMEOUT_S)
        return self.process.returncode, rest, errors


@contextmanager
def serving(*arguments: str | Path) -> Iterator[Service]:
    command = [*COMMAND, *map(str, arguments)]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env={**os.environ, "PYTHONWARNINGS": "error"}
    )
    try:
        yield Service(process)
    finally:
        process.kill()
        process.communicate()


def failing(*arguments: str | Path) -> tuple[int, str]:
    done = subprocess.run([*COMMAND, *map(str, arguments)], capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    assert done.stdout == ""
    return done.returncode, done.stderr


def test_one_line_when_ready_then_blocks_then_a_clean_end(root: Path, alps: Manifest) -> None:
    write_dataset(root / "rhine", seed=2)
    with serving(root, "--port", "0") as service:
        assert service.line == f"Serving alps, rhine at http://127.0.0.1:{service.port}/\n"
        status, headers, body = service.request(f"{URL}?v={alps.version}")
        assert (status, body) == (200, block_bytes(1, ADDRESS))
        assert headers["cache-control"] == "public, max-age=31536000, immutable"
        assert "server" not in headers
        assert service.request(URL, headers={"If-None-Match": headers["etag"]})[0] == 304
        assert service.request(URL, headers={"Range": "bytes=-5"})[::2] == (206, body[-5:])
        status, head_headers, nothing = service.request(URL, "HEAD")
        assert (status, head_headers["content-length"], nothing) == (200, str(len(body)), b"")
        assert service.request("/alps/height/0/4/3")[::2] == (204, b"")
        assert service.stop(signal.SIGTERM) == (0, "", "")


def test_ctrl_c_is_a_clean_end(root: Path) -> None:
    with serving(root, "--port", "0", "--log-level", "error") as service:
        assert service.line == f"Serving no dataset yet at http://127.0.0.1:{service.port}/\n"
        assert service.request("/healthz")[0] == 200
        assert service.stop(signal.SIGINT) == (0, "", "")


def test_escapes_in_raw_request_lines(root: Path, alps: Manifest) -> None:
    targets = [
        "/../other/manifest.json",
        "/alps/../../other/manifest.json",
        "/%2e%2e/other/manifest.json",
        "/..%2fother/manifest.json",
        "//etc/passwd",
        "/%2fetc%2fpasswd/manifest.json",
        "/alps%00/manifest.json",
        "/alps/height/0/%2e%2e/%2e%2e",
        "/alps/height/q/..%2f..%2fmanifest.json",
        "/alps/height.1/0/index.bin",
        "/%ff%fe/manifest.json",
    ]
    write_dataset(root.parent / "other", seed=2)
    with serving(root, "--port", "0") as service:
        for target in targets:
            status, headers, body = service.request(target)
            assert status in (400, 404), target
            assert headers["content-type"] == "application/problem+json", target
            assert b"clipmap" not in body, target
        assert service.stop(signal.SIGTERM) == (0, "", "")


def test_parallel_clients_get_equal_bytes(root: Path, alps: Manifest) -> None:
    addresses = [BlockAddress(0, x, y) for x in range(4) for y in range(4)] * 8
    with serving(root, "--port", "0") as service, ThreadPoolExecutor(16) as pool:
        answers = pool.map(lambda address: service.request(f"/alps/height/{address}")[::2], addresses)
        assert list(answers) == [(200, block_bytes(1, address)) for address in addresses]


def release(pipe: Path) -> None:
    """Let the readers that wait for the pipe read to its end; none is no error."""
    try:
        os.close(os.open(pipe, os.O_WRONLY | os.O_NONBLOCK))
    except OSError as error:
        if error.errno != errno.ENXIO:
            raise


def wait_for_threads(pid: int, count: int) -> None:
    """Return when a process has more than ``count`` threads: all those of a pool of ``count``, and its first one."""
    deadline = time.monotonic() + TIMEOUT_S
    while len(os.listdir(f"/proc/{pid}/task")) <= count:
        assert time.monotonic() < deadline, "the service never used all threads of its pool"
        time.sleep(0.01)


def test_health_is_answered_while_every_thread_waits_for_the_disk(root: Path, alps: Manifest) -> None:
    """A block that is a named pipe is a disk that does not answer: its reader hangs until somebody writes."""
    path = root / "alps" / alps.layer("height").block_key("height", ADDRESS)
    path.unlink()
    os.mkfifo(path)
    with serving(root, "--port", "0", "--log-level", "error") as service, ThreadPoolExecutor(64) as pool:
        waiting = [pool.submit(service.request, URL) for _ in range(60)]
        try:
            wait_for_threads(service.process.pid, 40)
            # No thread is left: a block that could be read at once waits as well, /healthz does not.
            starved = pool.submit(service.request, "/alps/height/0/0/0")
            for _ in range(20):
                assert service.request("/healthz")[0] == 200
            assert wait([starved, *waiting], timeout=0.5).done == set()
        finally:
            while not all(answer.done() for answer in waiting):
                release(path)
                time.sleep(0.01)
        assert {answer.result()[0] for answer in waiting} == {500}
        assert starved.result()[::2] == (200, block_bytes(1, BlockAddress(0, 0, 0)))


def test_requests_are_logged_on_demand(root: Path, alps: Manifest) -> None:
    with serving(root, "--port", "0", "--log-level", "info") as service:
        service.request(URL)
        code, rest, errors = service.stop(signal.SIGTERM)
        assert (code, rest) == (0, "")
        assert f'"GET {URL} HTTP/1.1" 200' in errors


def test_a_port_in_use_is_one_sentence(root: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        code, errors = failing(root, "--port", str(port))
    assert code == 4
    assert errors == f"clipmap: 127.0.0.1 port {port}: cannot listen there: Address already in use; choose another port or address\n"


def test_mistakes_are_one_sentence(root: Path, alps: Manifest, tmp_path: Path) -> None:
    code, errors = failing(tmp_path / "nowhere")
    assert (code, errors) == (3, f"clipmap: {tmp_path}/nowhere: no such folder; give a dataset or a folder of datasets\n")
    write_dataset(tmp_path / "other" / "alps", seed=2)
    code, errors = failing(root, tmp_path / "other")
    assert (code, errors.count("\n")) == (2, 1)
    code, errors = failing(root, "--host", "no.such.host.invalid")
    assert (code, errors.count("\n")) == (2, 1)
    assert failing()[0] == failing(root, "--port", "65536")[0] == 2
