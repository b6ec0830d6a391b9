"""Files made, or broken, so that reading them would exhaust the machine: refused in one sentence, before anything is allocated.

All found on 2026-11-22: these headers of a few hundred bytes took up to 9.5 GB, or ended in a traceback.
"""

import os
import struct
from pathlib import Path

import pytest

from schemas.errors import InputError
from schemas.lattice import Lattice
from schemas.settings import BuildSettings
from tests.integration.files import write_png
from tests.reference.terrain import photo
from tiler.building.build import build_layer
from tiler.tasks.partition import plan_tasks, plan_tiers

LAYOUT_TAGS = {"tile": (322, 323, 324, 325), "strip": (278, None, 273, 279)}


def header_only_tiff(path: Path, side: int, chunk: int, kind: str, compression: int) -> Path:
    """Write a TIFF that declares ``side`` x ``side`` samples in tiles or strips of ``chunk``, and has 16 bytes of data."""
    size, size_too, offsets, counts = LAYOUT_TAGS[kind]
    fields: dict[int, tuple[str, list[int]]] = {
        256: ("I", [side]),
        257: ("I", [side]),
        258: ("H", [8]),
        259: ("H", [compression]),
        262: ("H", [1]),
        277: ("H", [1]),
        size: ("I", [chunk]),
        offsets: ("I", [8]),
        counts: ("I", [16]),
    }
    if size_too is not None:
        fields[size_too] = ("I", [chunk])
    entries = b"".join(
        struct.pack("<HHI", tag, 3 if kind == "H" else 4, len(values)) + struct.pack(f"<{kind}", *values).ljust(4, b"\0")
        for tag, (kind, values) in sorted(fields.items())
    )
    path.write_bytes(struct.pack("<2sHI", b"II", 42, 24) + bytes(16) + struct.pack("<H", len(fields)) + entries + bytes(4))
    return path


@pytest.mark.parametrize(
    ("side", "chunk", "kind", "compression"),
    [
        (1_000_000, 16, "strip", 1),
        (1_000_000, 65536, "tile", 1),
        (100, 1 << 20, "tile", 1),
        (1_000_000, 65536, "tile", 8),
        (100, 1 << 20, "tile", 8),
    ],
)
def test_headers_that_promise_too_much(side: int, chunk: int, kind: str, compression: int, tmp_path: Path) -> None:
    source = header_only_tiff(tmp_path / "bomb.tif", side, chunk, kind, compression)
    before = peak_bytes()
    with pytest.raises(InputError, match=r"bomb\.tif"):
        build_layer(source, tmp_path / "out", BuildSettings(layer="imagery", workers=1))
    assert not (tmp_path / "out").exists()
    assert peak_bytes() - before < 200e6


def peak_bytes() -> int:
    """Peak resident set of this process."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM:"))
    return int(line.split()[1]) * 1024


def test_a_name_that_is_not_utf8(tmp_path: Path) -> None:
    write_png(tmp_path / "a.png", photo(64, 64))
    name = os.fsencode(tmp_path) + b"/\xff.png"
    os.rename(tmp_path / "a.png", name)
    with pytest.raises(InputError, match="not UTF-8"):
        build_layer(Path(os.fsdecode(name)), tmp_path / "out", BuildSettings())


def test_bands_of_very_wide_strips_are_bounded() -> None:
    """A band of a million columns took 3.5 GB for its rows in flight."""
    lattice = Lattice(1_000_000, 5000)
    (tier, *_) = plan_tiers(lattice, 2048)
    cores = [task.core for task in plan_tasks(lattice, tier, "striped")]
    assert max(core.width for core in cores) == 32768
    assert sum(core.area for core in cores) == 1_000_000 * 5000
