"""Fixtures and settings that every test shares."""

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import settings

if TYPE_CHECKING:
    from tests.s3 import S3Server

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # So it is in a shell's background jobs, and what they start never hears of an interrupt: neither would the builds that tests interrupt.
    signal.signal(signal.SIGINT, signal.default_int_handler)

settings.register_profile("local", deadline=None)
settings.register_profile("ci", deadline=None, derandomize=True, database=None, print_blob=True)
settings.load_profile("ci" if os.environ.get("CI") else "local")


@pytest.fixture(autouse=True)
def strict_floating_point() -> Iterator[None]:
    """Turn 0/0, overflow and underflow into errors, so that a test cannot pass on NaN; only where NumPy is in use already."""
    numpy = sys.modules.get("numpy")
    with numpy.errstate(all="raise") if numpy else nullcontext():
        yield


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real inputs that ``CLIPMAP_TEST_DATA`` names; the test is skipped where there is none."""
    name = os.environ.get("CLIPMAP_TEST_DATA")
    if not name:
        pytest.skip("CLIPMAP_TEST_DATA is not set: it names the folder of real inputs")
    folder = Path(name)
    assert folder.is_dir(), f"CLIPMAP_TEST_DATA={name} is not a folder"
    return folder


@pytest.fixture(scope="session")
def s3_process() -> "Iterator[S3Server]":
    """An S3-speaking server on loopback, one per worker; ``s3`` also makes it known to the code under test."""
    from tests.s3 import s3_server

    with s3_server() as server:
        yield server


@pytest.fixture
def s3(s3_process: "S3Server", monkeypatch: pytest.MonkeyPatch) -> "S3Server":
    """An S3-speaking server on loopback, and an environment in which ``s3://`` URLs lead there."""
    for name, value in s3_process.environment.items():
        monkeypatch.setenv(name, value)
    return s3_process
