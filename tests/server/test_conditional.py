import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.conditional import byte_range, etag_matches
from server.problems import RangeNotSatisfiableError

TAG = '"0123"'


@pytest.mark.parametrize(
    ("field", "expected"),
    [
        ('"0123"', True),
        ('W/"0123"', True),
        ("*", True),
        (" * ", True),
        ('"aaaa", "0123"', True),
        ('"aaaa",W/"0123" , "bbbb"', True),
        ('"a,b", "0123"', True),
        ("", False),
        ("0123", False),
        ('"012"', False),
        ('"01234"', False),
        ('"0123', False),
        ('"a"0123"b"', False),
        ('"*"', False),
    ],
)
def test_if_none_match(field: str, expected: bool) -> None:
    assert etag_matches(field, TAG) is expected


@pytest.mark.parametrize(
    ("field", "expected"),
    [
        ("bytes=0-0", (0, 1)),
        ("bytes=0-99", (0, 100)),
        ("bytes=10-19", (10, 20)),
        ("bytes=10-", (10, 100)),
        ("bytes=99-", (99, 100)),
        ("bytes=90-1000", (90, 100)),
        ("bytes=0-999999999999999999999", (0, 100)),
        ("bytes=-1", (99, 100)),
        ("bytes=-100", (0, 100)),
        ("bytes=-5000", (0, 100)),
        ("Bytes= 1-2 ", (1, 3)),
        # What a server may ignore, and this one does: all bytes are sent.
        ("bytes=0-1,5-6", None),
        ("bytes=5-2", None),
        ("bytes=-", None),
        ("bytes=", None),
        ("bytes=a-b", None),
        ("bytes=1-2-3", None),
        ("bytes=--1", None),
        ("bytes=+1-2", None),
        ("bytes=\u0661-2", None),
        ("samples=0-1", None),
        ("bytes=0-" + "9" * 5000, None),
    ],
)
def test_byte_range(field: str, expected: tuple[int, int] | None) -> None:
    assert byte_range(field, 100) == expected


@pytest.mark.parametrize("field", ["bytes=100-", "bytes=100-200", "bytes=5000-6000", "bytes=-0"])
def test_a_range_without_a_byte_is_not_satisfiable(field: str) -> None:
    with pytest.raises(RangeNotSatisfiableError) as caught:
        byte_range(field, 100)
    assert caught.value.length_bytes == 100


@given(data=st.binary(min_size=1, max_size=40), first=st.integers(0, 50), last=st.integers(0, 50))
def test_a_range_selects_the_bytes_that_its_numbers_count(data: bytes, first: int, last: int) -> None:
    expected = bytes(byte for position, byte in enumerate(data) if first <= position <= last)
    try:
        wanted = byte_range(f"bytes={first}-{last}", len(data))
    except RangeNotSatisfiableError:
        assert first >= len(data)
        return
    if wanted is None:
        assert last < first
    else:
        assert data[slice(*wanted)] == expected
