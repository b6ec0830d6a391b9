"""Datasets in a bucket, from the build to the viewer's request (server: ``tests/s3.py``)."""

import json
import os
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from cli.main import run
from schemas.errors import StorageError
from tests.integration.files import settings
from tests.s3 import S3Server
from tiler.building.build import build_layer
from tiler.checking.diff import diff
from tiler.checking.verify import verify
from tiler.stores import locate
from tiler.stores.dataset import open_dataset
from tiler.stores.objectlock import LockTimes
from tiler.stores.objects import ObjectStore

QUICK = LockTimes(refresh_s=0.2, stale_s=2.0, watch_s=0.7)


def same(a: str | Path, b: str | Path) -> bool:
    return diff(open_dataset(a), open_dataset(b)).same


def until(true: Callable[[], bool], limit_s: float = 20) -> None:
    deadline = time.monotonic() + limit_s
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.1)


def test_a_build_into_a_bucket_is_the_local_one(height_tiff: Path, s3: S3Server, tmp_path: Path) -> None:
    place = tmp_path / "bucket"
    build_layer(height_tiff, tmp_path / "out", settings())
    build_layer(height_tiff, s3.url(place), settings())
    assert same(tmp_path / "out", s3.url(place))
    assert verify(open_dataset(s3.url(place))).findings == []
    assert ".clipmap-lock" not in s3.names(place)


def test_commands_take_urls(height_tiff: Path, s3: S3Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    place = tmp_path / "bucket"
    report = build_layer(height_tiff, tmp_path / "out", settings())
    s3.upload(tmp_path / "out", place)
    assert run(["inspect", s3.url(place), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["version"] == report.manifest.version
    assert run(["verify", s3.url(place)]) == 0
    assert run(["diff", str(tmp_path / "out"), s3.url(place)]) == 0
    assert run(["inspect", (tmp_path / "out").as_uri()]) == 0
    s3.delete(place, next(name for name in s3.names(place) if name.endswith(".raw")))
    capsys.readouterr()
    assert run(["verify", s3.url(place)]) == 1
    assert "missing" in capsys.readouterr().out
    for arguments, code in (
        (["inspect", s3.url(tmp_path / "no")], 3),
        (["diff", "sftp://a/b", "c"], 2),
        (["verify", "s3://no-such-bucket/a"], 4),
    ):
        assert run(arguments) == code
        assert capsys.readouterr().err.count("\n") == 1


def test_what_is_served_follows_what_is_published(height_tiff: Path, s3: S3Server, tmp_path: Path) -> None:
    place = tmp_path / "bucket" / "alps"
    first = build_layer(height_tiff, tmp_path / "out", settings()).manifest
    s3.upload(tmp_path / "out", place)
    command = [sys.executable, "-W", "error", "-c", "from cli.main import main; main()", "serve", s3.url(place), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as service:
        try:
            assert service.stdout is not None
            line = service.stdout.readline()
            assert line.startswith("Serving alps at http://")
            root = line.split()[-1]

            def get(path: str) -> bytes:
                with urllib.request.urlopen(root + path, timeout=20) as answer:
                    body: bytes = answer.read()
                return body

            lattice = first.layer("height").lattice
            for address in lattice.addresses(1):
                assert get(f"alps/height/{address}?v={first.version}") == open_dataset(tmp_path / "out").block("height", address)
            second = build_layer(height_tiff, tmp_path / "out", settings(overwrite=True, height_offset=100.0)).manifest
            s3.upload(tmp_path / "out", place)
            until(lambda: json.loads(get("alps/manifest.json"))["version"] == second.version)
            for address in lattice.addresses(1):
                assert get(f"alps/height/{address}?v={second.version}") == open_dataset(tmp_path / "out").block("height", address)
            service.send_signal(signal.SIGTERM)
            assert service.wait(20) == 0
            assert service.communicate() == ("", "")
        finally:
            service.kill()


BUILD = """
import os, signal, sys
from functools import partial
from pathlib import Path
from schemas.errors import ClipmapError
from tests.integration.files import settings
from tiler.building.build import build_layer
from tiler.stores import locate
from tiler.stores.objectlock import LockTimes
from tiler.stores.objects import ObjectStore
locate.ObjectStore = partial(ObjectStore, lock_times=LockTimes(0.2, 2.0, 0.7))
def look(done, total):
    if {kill} and done == total // 2:
        os.kill(os.getpid(), signal.SIGKILL)
try:
    build_layer(Path({source!r}), {url!r}, settings(), look)
except ClipmapError as error:
    sys.exit(f"clipmap: {{error}}")
"""


def start_build(source: Path, url: str, kill: bool) -> "subprocess.Popen[str]":
    program = BUILD.format(source=str(source), url=url, kill=kill)
    root = Path(__file__).parents[2]
    return subprocess.Popen(
        [sys.executable, "-c", program], stderr=subprocess.PIPE, text=True, cwd=root, env={**os.environ, "PYTHONPATH": str(root)}
    )


def test_a_killed_build_is_explained_and_gone_on_with(
    height_tiff: Path, s3: S3Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "bucket"
    with start_build(height_tiff, s3.url(place), kill=True) as killed:
        assert killed.wait(60) == -signal.SIGKILL
    monkeypatch.setattr(locate, "ObjectStore", partial(ObjectStore, lock_times=QUICK))
    with pytest.raises(
        StorageError, match=rf"another build is writing here \(process {killed.pid} of .*\); its last sign of life came \d s ago"
    ):
        build_layer(height_tiff, s3.url(place), settings())
    time.sleep(QUICK.stale_s + 1)
    with pytest.raises(StorageError, match="has probably died: make sure that it has, then build again with --break-lock"):
        build_layer(height_tiff, s3.url(place), settings())
    build_layer(height_tiff, s3.url(place), settings(break_lock=True))
    build_layer(height_tiff, tmp_path / "out", settings())
    assert same(tmp_path / "out", s3.url(place))
    assert verify(open_dataset(s3.url(place))).findings == []
    assert ".clipmap-lock" not in s3.names(place)


def test_of_two_builds_that_begin_at_once_one_is_refused(height_tiff: Path, s3: S3Server, tmp_path: Path) -> None:
    place = tmp_path / "bucket"
    with start_build(height_tiff, s3.url(place), kill=False) as one, start_build(height_tiff, s3.url(place), kill=False) as other:
        ended = [(build.communicate(timeout=60)[1], build.returncode) for build in (one, other)]
    # If one has ended before the other begins, that one finds nothing left to do, or is told to overwrite.
    assert 0 in [code for _, code in ended]
    assert all(code == 0 or "another build is writing here (process" in said or "--overwrite" in said for said, code in ended), ended
    assert verify(open_dataset(s3.url(place))).findings == []
