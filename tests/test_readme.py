"""Runs the README from top to bottom, in one folder: what it shows works, and prints what it shows.

How to write blocks is said in ``tests/readme_blocks.py``. Blocks that need CLIPMAP_TEST_DATA are skipped where it is not set, and
``clipmap view`` and ``clipmap demo`` where there is no OpenGL. Port 8000 is replaced by a free one. A command that ends in ``&`` is
a server: it is waited for until it answers on that port, and stopped when the next one starts or at the end.
"""

import doctest
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import pytest

from tests.readme_blocks import Step, parse_steps

README = Path(__file__).parents[1] / "README.md"
README_PORT = 8000
STEP_TIMEOUT_S = 300
START_TIMEOUT_S = 60


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def with_port(step: Step, port: int) -> str:
    """The text of ``step`` with ``port`` in place of 8000; a server in the background gets it as an option if it names none."""
    before = r"\b" if step.in_background else r"(?<=:)"
    text = re.sub(rf"{before}{README_PORT}\b", str(port), step.text)
    if step.in_background and str(port) not in text:
        text = f"{text.rstrip().removesuffix('&').rstrip()} --port {port} &"
    return text


class Session:
    """A folder in which the steps of a document run one after the other, and the servers they start."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._port = free_port()
        self._servers: list[subprocess.Popen[bytes]] = []
        self._environment = os.environ | {"PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}

    def run(self, step: Step) -> None:
        """Run one step; raises AssertionError with its line if it fails or prints something else than shown."""
        text, where = with_port(step, self._port), f"README.md, line {step.line}: {step.text.strip()}"
        if step.in_background:
            self._start(text.rstrip().removesuffix("&"), where)
            return
        command = ["bash", "-euo", "pipefail", "-c", text] if step.language == "console" else [sys.executable, "-W", "error", "-c", text]
        done = subprocess.run(
            command,
            cwd=self._folder,
            env=self._environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=STEP_TIMEOUT_S,
            check=False,
        )
        assert done.returncode == 0, f"{where}\nended with exit status {done.returncode}:\n{done.stdout}"
        if step.expected:
            shown = re.sub(rf":{README_PORT}\b", f":{self._port}", step.expected)
            flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
            same = doctest.OutputChecker().check_output(shown, done.stdout.strip(), flags)
            assert same, f"{where}\nshows\n{shown}\nbut prints\n{done.stdout}"

    def _start(self, command: str, where: str) -> None:
        self.close()  # one port, one server: the next one takes the place of the last
        server = subprocess.Popen(
            ["bash", "-c", f"exec {command}"], cwd=self._folder, env=self._environment, stdin=subprocess.DEVNULL, start_new_session=True
        )
        self._servers.append(server)
        deadline = time.monotonic() + START_TIMEOUT_S
        while time.monotonic() < deadline:
            assert server.poll() is None, f"{where}\nended at once with exit status {server.returncode}"
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", self._port)) == 0:
                    return
            time.sleep(0.05)
        raise AssertionError(f"{where}\ndoes not answer on port {self._port} after {START_TIMEOUT_S} s")

    def close(self) -> None:
        """Stop the servers, their children included."""
        for server in self._servers:
            if server.poll() is None:
                os.killpg(server.pid, signal.SIGTERM)
            try:
                server.wait(10)
            except subprocess.TimeoutExpired:
                os.killpg(server.pid, signal.SIGKILL)
                server.wait()
        self._servers.clear()


@contextmanager
def session(folder: Path) -> Iterator[Session]:
    opened = Session(folder)
    try:
        yield opened
    finally:
        opened.close()


def runnable(steps: list[Step]) -> list[Step]:
    """The steps that can run here."""
    has_data = bool(os.environ.get("CLIPMAP_TEST_DATA"))
    chosen = [step for step in steps if not step.not_run and (has_data or not step.needs_data)]
    draws = [step for step in chosen if re.match(r"clipmap (view|demo)\b", step.text)]
    return chosen if not draws or has_opengl() else [step for step in chosen if step not in draws]


@cache
def has_opengl() -> bool:
    """Whether a context without a window can be made; tried in a process of its own, as drivers may crash."""
    code = "import moderngl; moderngl.create_context(standalone=True, backend='egl').release()"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0


def test_the_readme_shows_commands() -> None:
    """A guard against a README whose blocks this module fails to find."""
    steps = parse_steps(README.read_text(encoding="utf-8"))
    not_run = [step for step in steps if step.not_run]
    assert sum(step.text.startswith("clipmap ") and not step.not_run for step in steps) >= 3
    assert len(not_run) < len(steps) / 2, "most of the README must be tested"


def test_the_readme_works(tmp_path: Path) -> None:
    steps = runnable(parse_steps(README.read_text(encoding="utf-8")))
    if not steps:
        pytest.skip("every block of the README needs CLIPMAP_TEST_DATA, which is not set")
    with session(tmp_path) as opened:
        for step in steps:
            opened.run(step)


EXAMPLE = """
# Title

```console
$ echo "one  two"; \\
> echo three
one two
...
$ python3 -m http.server --bind 127.0.0.1 8000 2>/dev/null &
$ python3 -c 'import urllib.request as u; print(u.urlopen("http://127.0.0.1:8000/").status)'
200
```

<!-- not run: there is nothing to install -->

```console
$ install-a-lot
```

```python
from pathlib import Path
Path("made.txt").write_text("by Python")
```

```console
$ cat made.txt
by Python
```

```text
$ not a command
```
"""


def test_documents_are_parsed() -> None:
    steps = parse_steps(EXAMPLE)
    assert [(step.language, step.line, step.in_background) for step in steps] == [
        ("console", 5, False),
        ("console", 9, True),
        ("console", 10, False),
        ("console", 17, False),
        ("python", 21, False),
        ("console", 26, False),
    ]
    assert steps[0].text == 'echo "one  two"; echo three'
    assert steps[0].expected == "one two\n..."
    assert [step.not_run for step in steps] == [None, None, None, "there is nothing to install", None, None]
    with pytest.raises(ValueError, match="line 2: a console block must begin with a command"):
        parse_steps("```console\noutput\n```\n")


def test_documents_are_run(tmp_path: Path) -> None:
    with session(tmp_path) as opened:
        for step in runnable(parse_steps(EXAMPLE)):
            opened.run(step)
    assert (tmp_path / "made.txt").read_text() == "by Python"


@pytest.mark.parametrize(
    ("block", "message"),
    [
        ("```console\n$ exit 3\n```", "exit status 3"),
        ("```console\n$ echo yes\nno\n```", "but prints"),
        ("```console\n$ false &\n```", "ended at once with exit status 1"),
        ("```python\n1 / 0\n```", "ZeroDivisionError"),
    ],
)
def test_a_document_that_does_not_work_is_told(tmp_path: Path, block: str, message: str) -> None:
    with session(tmp_path) as opened, pytest.raises(AssertionError, match=message):
        opened.run(parse_steps(f"{block}\n")[0])


def test_blocks_that_need_real_inputs_are_skipped_without_them(monkeypatch: pytest.MonkeyPatch) -> None:
    block = "```console\n$ {}\n$ echo {}\n```\n"
    text = block.format("ls $CLIPMAP_TEST_DATA", 1) + block.format("ls", 2) + "<!-- needs CLIPMAP_TEST_DATA -->\n" + block.format("ls", 3)
    steps = parse_steps(text)
    monkeypatch.delenv("CLIPMAP_TEST_DATA", raising=False)
    assert [step.text for step in runnable(steps)] == ["ls", "echo 2"], "a block is skipped as a whole"
    monkeypatch.setenv("CLIPMAP_TEST_DATA", "/data")
    assert runnable(steps) == steps


def test_servers_without_a_port_get_a_free_one() -> None:
    step = parse_steps("```console\n$ clipmap serve data &\n```\n")[0]
    assert with_port(step, 5) == "clipmap serve data --port 5 &"
