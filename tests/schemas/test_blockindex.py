"""The block index, against records laid out by hand as docs/FORMAT.md describes them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.blockindex import BLANK, RECORD_BYTES, BlockIndex, BlockRecord, pack_record
from schemas.errors import InputError
from schemas.manifest import digest

LAYOUT = np.dtype([("digest", "S16"), ("length_bytes", "<u4"), ("valid", "<u4"), ("min", "<f4"), ("max", "<f4")])
"""The table of docs/FORMAT.md as a structure of another library."""

float32s = st.floats(width=32, allow_nan=False, allow_infinity=False)
records = st.builds(
    BlockRecord, st.binary(max_size=30).map(digest), st.integers(1, 2**32 - 1), st.integers(0, 4096 * 4096), float32s, float32s
)


def test_a_record_has_32_bytes() -> None:
    assert RECORD_BYTES == LAYOUT.itemsize == 32


@given(st.lists(st.one_of(st.just(BLANK), records), min_size=1, max_size=40))
def test_round_trip(listed: list[BlockRecord]) -> None:
    data = b"".join(map(pack_record, listed))
    index = BlockIndex(data, len(listed), "index.bin")
    assert len(index) == len(listed)
    assert list(index) == listed
    assert [index[number] for number in range(len(listed))] == listed
    assert b"".join(map(pack_record, index)) == data


@given(records)
def test_the_layout_is_the_documented_one(record: BlockRecord) -> None:
    packed = np.frombuffer(pack_record(record), LAYOUT)[0]
    assert packed.tobytes()[:16].hex() == record.digest
    assert (packed["length_bytes"], packed["valid"]) == (record.length_bytes, record.valid)
    assert (packed["min"], packed["max"]) == (np.float32(record.min), np.float32(record.max))


def test_a_blank_is_all_zeros() -> None:
    assert pack_record(BLANK) == bytes(32)
    assert BlockIndex(bytes(64), 2, "index.bin")[1] is BLANK
    assert BLANK.blank
    assert not BlockRecord(digest(b""), 1, 0, 0.0, 0.0).blank


@pytest.mark.parametrize(("size", "count"), [(0, 1), (31, 1), (33, 1), (64, 1), (32, 2)])
def test_an_index_of_another_length_is_refused(size: int, count: int) -> None:
    with pytest.raises(
        InputError, match=rf"^a/index\.bin: has {size} bytes instead of {32 * count} \({count} blocks\); rebuild the layer$"
    ):
        BlockIndex(bytes(size), count, "a/index.bin")


@pytest.mark.parametrize("number", [-1, 2, 2**40])
def test_numbers_outside_are_refused(number: int) -> None:
    with pytest.raises(IndexError):
        BlockIndex(bytes(64), 2, "index.bin")[number]
