"""A Dask cluster on loopback: a scheduler and worker processes of their own."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


class Cluster:
    """A scheduler and its workers, each a process; ``environment`` is what workers see besides ours."""

    def __init__(self, folder: Path, environment: dict[str, str]) -> None:
        self._folder, self._environment = folder, os.environ | environment
        self.workers: list[subprocess.Popen[bytes]] = []
        found = folder / "scheduler.json"
        self.scheduler = self._start("scheduler", "--scheduler-file", str(found), "--port", "0", "--host", "127.0.0.1", "--no-dashboard")
        wait_until(lambda: found.exists() and found.read_text().endswith("}"))
        self.address: str = json.loads(found.read_text())["address"]

    def _start(self, kind: str, *arguments: str) -> "subprocess.Popen[bytes]":
        command = [sys.executable, "-W", "ignore", "-m", f"distributed.cli.dask_{kind}", *arguments]
        with (self._folder / f"{kind}.log").open("ab") as log:
            return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=self._environment, cwd=self._folder)

    def add_worker(self) -> "subprocess.Popen[bytes]":
        options = ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory", str(self._folder)]
        self.workers.append(self._start("worker", self.address, *options))
        return self.workers[-1]

    def stop(self) -> None:
        for process in [*self.workers, self.scheduler]:
            process.kill()
            process.wait()


def wait_until(condition: Callable[[], bool], seconds: float = 60) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.01)


@contextmanager
def two_workers(folder: Path, request: pytest.FixtureRequest) -> Iterator[Cluster]:
    """Run two workers with a thread each, which also know the S3-speaking server if that can be started."""
    try:
        environment = request.getfixturevalue("s3_process").environment
    except pytest.skip.Exception:
        environment = {}
    running = Cluster(folder, environment)
    try:
        for _ in range(2):
            running.add_worker()
        yield running
    finally:
        running.stop()
