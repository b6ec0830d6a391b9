"""What ``clipmap demo`` refuses; that it works is the README's test."""

from pathlib import Path

import pytest

from tests.cli.conftest import Clipmap


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--size", "foo"], "expected WIDTHxHEIGHT"),
        (["--size", "8x8"], "from 16 to 16384"),
        (["--size", "99999x100"], "from 16 to 16384"),
        (["--side", "63"], "64<=x<=8192"),
        (["--side", "8193"], "64<=x<=8192"),
        (["--side", "many"], "not a valid integer"),
    ],
)
def test_what_cannot_be_made_is_refused_before_any_work(clipmap: Clipmap, tmp_path: Path, arguments: list[str], words: str) -> None:
    """2026-11-22: the size was looked at by the last step, after the dataset had been made and served."""
    ran = clipmap("demo", "-o", tmp_path / "demo", *arguments)
    assert ran.code == 2
    assert words in ran.err
    assert ran.err.count("\n") == 1
    assert not ran.out
    assert not (tmp_path / "demo").exists()
