"""The note that a build leaves in a store: it says everything, and no bytes that anybody put there can do harm."""

import string
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tiler.stores import claims
from tiler.stores.claims import ClaimNote, duration

names = st.text(string.ascii_letters + string.digits + "._@+-", max_size=20)
prefixes = st.lists(st.from_regex(r"[a-z][a-z0-9_.]{0,8}(/tasks)?", fullmatch=True), max_size=5).map(tuple)
times = st.datetimes(datetime(1970, 1, 1), datetime(2200, 1, 1), timezones=st.just(UTC)).map(
    lambda time: time.replace(microsecond=time.microsecond // 1000 * 1000)
)
notes = st.builds(ClaimNote, names, names, names, st.none() | times, prefixes, st.booleans(), names, st.none() | times)
NOTE = ClaimNote("123", "a1", "maria", datetime(2026, 11, 22, 18, 50, 31, tzinfo=UTC), ("height",))


@given(notes)
def test_what_is_written_is_read(note: ClaimNote) -> None:
    assert ClaimNote.parse(note.dump()) == note


@given(notes, notes)
def test_the_rest_of_a_longer_note_does_not_count(note: ClaimNote, longer: ClaimNote) -> None:
    """A kill between overwriting and cutting off leaves this."""
    assert ClaimNote.parse(note.dump() + longer.dump()[len(note.dump()) :]) == note


@given(st.binary(max_size=200) | notes.map(ClaimNote.dump).flatmap(lambda data: st.integers(0, len(data) - 2).map(lambda end: data[:end])))
def test_anything_else_is_no_note(data: bytes) -> None:
    assert ClaimNote.parse(data) is None


hostile = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=10),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


@given(st.dictionaries(st.sampled_from(["process", "machine", "user", "begun", "held", "sign_of_life", "token", "prefixes"]), hostile))
def test_hostile_fields_become_harmless(fields: dict[str, Any]) -> None:
    import json

    note = ClaimNote.parse(json.dumps({"format": "clipmap build", **fields}).encode())
    assert note is not None
    assert (note.at_work() + note.left_by()).isprintable()
    assert len(note.at_work()) < 300


@pytest.mark.parametrize(
    "prefix", ["", "/", "..", "../x", "a/../b", "a/..", "/etc", ".git", "a/.x", "a//b", "a/", "A", "a b", "a\n", "a\0", "ä"]
)
def test_no_prefix_leads_out_of_the_store_or_to_what_is_hidden(prefix: str) -> None:
    note = ClaimNote.parse(replace(NOTE, prefixes=(prefix, "height.2/tasks")).dump())
    assert note is not None
    assert note.prefixes == ("height.2/tasks",)


@pytest.mark.parametrize("begun", ["yesterday", "0001-01-01T00:00:00+23:00", "2026-11-22T18:50:31", "9999-12-31T23:59:59-23:00", 1e300])
def test_times_that_are_none(begun: object) -> None:
    note = ClaimNote.parse(NOTE.dump().replace(b'"2026-11-22T18:50:31.000+00:00"', str(begun).encode().join([b'"', b'"'])))
    assert note is not None
    assert note.begun is None
    assert note.at_work() == "process 123 of maria on a1"


@pytest.mark.parametrize(
    ("passed", "text"),
    [
        (timedelta(), ", for 0 s, since 2026-11-22 18:50 UTC"),
        (timedelta(hours=3, minutes=12, seconds=59), ", for 3 h 12 min, since 2026-11-22 18:50 UTC"),
        (timedelta(seconds=-30), ", for 0 s, since 2026-11-22 18:50 UTC"),
        (timedelta(days=-1), ", since 2026-11-22 18:50 UTC, which is still to come by the clock of this machine"),
    ],
)
def test_the_age_by_this_machines_clock(passed: timedelta, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert NOTE.begun is not None
    now = NOTE.begun + passed
    monkeypatch.setattr(claims, "utc_now", lambda: now)
    assert NOTE.at_work() == f"process 123 of maria on a1{text}"
    assert NOTE.left_by() == "process 123 on a1, begun 2026-11-22 18:50 UTC"


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (-5, "0 s"),
        (0.9, "0 s"),
        (59.9, "59 s"),
        (60, "1 min"),
        (3599, "59 min"),
        (3600, "1 h 0 min"),
        (86399, "23 h 59 min"),
        (183600, "2 d 3 h"),
    ],
)
def test_durations_for_people(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_a_user_without_a_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a container a process may run under a number that no file knows."""

    def unknown() -> str:
        raise KeyError("getpwuid(): uid not found: 12345")

    monkeypatch.setattr("getpass.getuser", unknown)
    assert ClaimNote.mine().user.isdigit()
