import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from schemas.address import BlockAddress
from schemas.errors import InputError, StorageError
from viewer import blocks as blocks_module
from viewer.blocks import BlockKey, BlockLoader
from viewer.decode import Block, HeightBlock

Make = Callable[..., BlockLoader]


def key(number: int) -> BlockKey:
    return BlockKey("height", BlockAddress(0, number, 0))


def decode(data: bytes | None) -> Block:
    """A block of 40 bytes: 8 heights and their mask."""
    value = 0.0 if data is None else float(data.decode())
    return HeightBlock(np.full((2, 4), value, np.float32), np.ones((2, 4), np.bool_))


@pytest.fixture
def make() -> Iterator[Make]:
    made: list[BlockLoader] = []

    def build(read: Callable[[str, BlockAddress], bytes | None], workers: int = 2, capacity_bytes: int = 10**6) -> BlockLoader:
        made.append(BlockLoader(read, {"height": decode}, workers, capacity_bytes))
        return made[-1]

    yield build
    for loader in made:
        loader.close()


def settle(loader: BlockLoader, keys: list[BlockKey]) -> None:
    deadline = time.monotonic() + 10
    while loader.request(keys) and time.monotonic() < deadline:
        loader.wait(0.1)


def test_what_is_requested_is_loaded(make: Make) -> None:
    loader = make(lambda _, address: str(address.x).encode() if address.x else None)
    assert loader.get(key(3)) is None
    settle(loader, [key(number) for number in range(8)])
    block = loader.get(key(3))
    assert isinstance(block, HeightBlock)
    assert block.z[0, 0] == 3
    assert (loader.counts.blocks, loader.counts.blank, loader.pending) == (8, 1, 0)
    assert loader.held_bytes == 8 * 40


def test_the_most_urgent_come_first_and_the_unwanted_are_forgotten(make: Make) -> None:
    order: list[int] = []
    started, gate = threading.Event(), threading.Event()

    def read(_: str, address: BlockAddress) -> bytes:
        order.append(address.x)
        started.set()
        gate.wait(5)
        return b"1"

    loader = make(read, workers=1)
    loader.request([key(9)])
    assert started.wait(5)
    loader.request([key(1), key(2), key(3)])
    loader.request([key(7), key(5), key(6), key(7)])
    assert loader.pending == 4
    gate.set()
    settle(loader, [key(7), key(5), key(6)])
    assert order == [9, 7, 5, 6]


def test_no_more_blocks_are_under_way_than_workers(make: Make) -> None:
    lock, now, most = threading.Lock(), 0, 0

    def read(_: str, __: BlockAddress) -> bytes:
        nonlocal now, most
        with lock:
            now += 1
            most = max(most, now)
        time.sleep(0.01)
        with lock:
            now -= 1
        return b"1"

    loader = make(read, workers=3)
    settle(loader, [key(number) for number in range(20)])
    assert most == 3


def test_the_least_recently_used_go_first_and_the_wanted_never(make: Make) -> None:
    loader = make(lambda *_: b"1", workers=1, capacity_bytes=4 * 40)
    settle(loader, [key(number) for number in range(4)])
    loader.get(key(0))
    settle(loader, [key(8)])
    assert loader.get(key(1)) is None
    assert loader.get(key(0)) is not None
    assert (loader.held_bytes, loader.counts.evicted) == (160, 1)
    wanted = [key(number) for number in range(20, 30)]
    settle(loader, wanted)
    assert all(loader.get(one) is not None for one in wanted)
    assert loader.held_bytes == 400


def test_a_failed_read_is_tried_again_later(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blocks_module, "RETRY_S", 0.05)
    tries: list[int] = []

    def read(_: str, __: BlockAddress) -> bytes:
        tries.append(1)
        if len(tries) == 1:
            raise StorageError("disk unplugged")
        return b"4"

    loader = make(read)
    loader.request([key(1)])
    assert loader.wait(5)
    assert [str(error) for error in loader.failures.values()] == ["disk unplugged"]
    settle(loader, [key(1)])
    assert loader.get(key(1)) is not None
    assert loader.failures == {}


def test_a_damaged_block_is_not_tried_again(make: Make) -> None:
    tries: list[int] = []

    def read(_: str, __: BlockAddress) -> bytes:
        tries.append(1)
        raise InputError("damaged")

    loader = make(read)
    for _ in range(3):
        assert loader.request([key(1)]) == 1
        assert loader.wait(1)
    assert len(tries) == 1
    assert list(loader.failures) == [key(1)]
    loader.request([])
    assert loader.failures == {}


def test_a_defect_in_a_worker_is_raised_where_it_is_seen(make: Make) -> None:
    loader = make(lambda *_: b"not a number")
    loader.request([key(1)])
    with pytest.raises(ValueError, match="not a number"):
        loader.wait(5)
