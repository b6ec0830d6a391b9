"""Estimates: exact where all is known, honest where windows stand for the rest, and without a trace on the disk."""

from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from schemas.errors import InputError, UsageError
from schemas.estimates import BuildEstimate
from schemas.lattice import Lattice
from tests.integration.files import settings, write_png, write_tiff
from tests.reference.terrain import photo
from tiler.building.build import BuildReport, build_layer
from tiler.building.plan import Plan, plan_layer
from tiler.estimate import build as estimate
from tiler.estimate import trial
from tiler.estimate.build import estimate_build, plan_from_headers
from tiler.estimate.memory import task_windows
from tiler.samples.opening import open_headers
from tiler.tasks.partition import Tier

SIDE = 1024


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A photo whose right half is void, so that blocks there are blank, and the rest is of uneven detail."""
    pixels = photo(SIDE, SIDE, seed=3)
    pixels[: SIDE // 2, : SIDE // 4] = 90
    alpha = np.full((SIDE, SIDE, 1), 255, np.uint8)
    alpha[:, SIDE // 2 :] = 0
    return write_tiff(
        tmp_path_factory.mktemp("sources") / "photo.tif", np.concatenate([pixels, alpha], axis=-1), photometric="RGB", alpha="YES"
    )


def listing(folder: Path) -> dict[str, tuple[int, int]]:
    """Everything in and above a folder, with size and time of change."""
    paths = [folder, *folder.rglob("*")]
    return {str(path): (path.stat().st_size, path.stat().st_mtime_ns) for path in paths}


def files_of(folder: Path, suffix: str = "") -> list[Path]:
    return [path for path in folder.rglob(f"*{suffix}") if path.is_file()]


def check_counts(found: BuildEstimate, built: BuildReport, folder: Path) -> None:
    """What does not depend on the content must be right to the last file."""
    space, layer = found.space, built.manifest.layers[built.layer]
    assert (found.layer, found.codec, found.standing.tasks) == (built.layer, layer.codec, built.tasks)
    assert [(level.width, level.height, level.columns, level.rows) for level in found.levels] == [
        (level.width, level.height, level.columns, level.rows) for level in layer.levels
    ]
    pieces = files_of(folder, ".f32")
    assert space.piece_bytes == sum(path.stat().st_size for path in pieces)
    assert space.index_bytes == sum(path.stat().st_size for path in files_of(folder, "index.bin"))
    assert space.folders == 1 + sum(path.is_dir() for path in folder.rglob("*"))
    assert abs(space.record_bytes / sum(path.stat().st_size for path in files_of(folder, ".json") if "tasks" in path.parts) - 1) < 0.3


def test_a_source_that_is_tried_as_a_whole_is_known_exactly(source: Path, tmp_path: Path) -> None:
    options = settings(codec="png", task=128)
    found = estimate_build([source], tmp_path / "out", options)
    built = build_layer(source, tmp_path / "out", options)
    check_counts(found, built, tmp_path / "out")
    layer = built.manifest.layers["imagery"]
    assert [(level.stored, level.stored_bytes) for level in found.levels] == [(level.stored, level.stored_bytes) for level in layer.levels]
    space = found.space
    assert space.stored_bytes_low == space.stored_bytes == space.stored_bytes_high == sum(level.stored_bytes for level in layer.levels)
    assert space.sampled_share == 1
    assert space.files == len(files_of(tmp_path / "out"))
    assert found.time_s > 0
    assert found.memory_bytes > 100 << 20


@pytest.mark.parametrize("codec", ["png", "webp:80"])
def test_the_truth_lies_in_the_range_that_windows_give(codec: str, source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trial, "_SIDE", 128)
    options = settings(block=32, codec=codec, task=128)
    found = estimate_build([source], tmp_path / "out", options)
    assert found.space.sampled_share <= 0.75
    built = build_layer(source, tmp_path / "out", options)
    check_counts(found, built, tmp_path / "out")
    stored_bytes = sum(level.stored_bytes for level in built.manifest.layers["imagery"].levels)
    assert found.space.stored_bytes_low <= stored_bytes <= found.space.stored_bytes_high
    assert found.space.stored_bytes_low < found.space.stored_bytes < found.space.stored_bytes_high
    assert abs(found.space.files / len(files_of(tmp_path / "out")) - 1) < 0.25
    assert [level.encoded > 0 for level in found.levels] == [True] * 3 + [False] * 3


def test_ranges_hold_the_truth_nineteen_times_of_twenty(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Over 8 pictures of patches as different as flat and noisy, all with few windows."""
    monkeypatch.setattr(trial, "_SIDE", 64)
    chance = np.random.default_rng(20261122)
    inside = 0
    for number in range(8):
        noise = chance.integers(0, 2 ** chance.integers(0, 8, (8, 8, 1)), (8, 8, 64 * 64 * 3), endpoint=False)
        pixels = noise.reshape(8, 8, 64, 64, 3).transpose(0, 2, 1, 3, 4).reshape(512, 512, 3).astype(np.uint8)
        path = write_tiff(tmp_path / f"{number}.tif", pixels)
        options = settings(block=32, codec="png", task=512)
        space = estimate_build([path], tmp_path / "out", options).space
        report = build_layer(path, tmp_path / f"out{number}", options)
        truth = sum(level.stored_bytes for level in report.manifest.layers["imagery"].levels)
        inside += space.stored_bytes_low <= truth <= space.stored_bytes_high
    assert inside >= 7


def test_a_layer_without_a_valid_sample_takes_nothing(tmp_path: Path) -> None:
    path = write_tiff(tmp_path / "void.tif", np.full((300, 300, 1), -32768, np.int16), nodata=-32768)
    found = estimate_build([path], tmp_path / "out", settings())
    assert [(level.stored, level.stored_bytes) for level in found.levels] == [(0, 0)] * len(found.levels)


def test_nothing_is_written(source: Path, tmp_path: Path) -> None:
    before = listing(source.parent)
    estimate_build([source], tmp_path / "deep/er/out", settings())
    assert list(tmp_path.iterdir()) == []
    build_layer(source, tmp_path / "out", settings(codec="png"))
    (tmp_path / "out/imagery/.tmp-1").write_bytes(b"left")
    there = listing(tmp_path)
    for options in ({"codec": "png"}, {}, {"overwrite": True}, {"update": True, "codec": "png"}):
        estimate_build([source], tmp_path / "out", settings(**options))
    assert listing(tmp_path) == there
    assert listing(source.parent) == before


def test_what_a_build_refuses_a_plan_refuses(source: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        estimate_build([tmp_path / "none.tif"], tmp_path / "out", settings())
    with pytest.raises(UsageError, match="lies inside"):
        estimate_build([source], source.parent, settings())
    with pytest.raises(UsageError, match=r"codec|lerc"):
        estimate_build([source], tmp_path / "out", settings(codec="lerc"))
    with pytest.raises(UsageError, match="--mosaic"):
        estimate_build([source, source], tmp_path / "out", settings())


def test_a_plan_from_headers_decodes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "picture.png"
    write_png(path, photo(300, 200))
    path.write_bytes(path.read_bytes()[:4000])  # its pixels could not be read
    plan = plan_from_headers([path], tmp_path / "out", settings(codec="png", stretch=None, linear_light=True))
    assert (plan.lattice.width, plan.lattice.height) == (200, 300)
    with pytest.raises(InputError, match=r"picture\.png"):
        estimate_build([path], tmp_path / "out", settings(codec="png"))


def planned(width: int, height: int, tmp_path: Path, **options: Any) -> Plan:
    profile: dict[str, Any] = {"tiled": options.pop("tiled", True)}
    if not profile["tiled"]:
        profile |= {"blockxsize": None, "blockysize": 16}
    path = write_tiff(tmp_path / "grid.tif", np.zeros((height, width, 1), np.uint8), compress="deflate", **profile)
    source = open_headers([path], settings(layer="imagery", codec="png", **options))
    return plan_layer(source, None, settings(layer="imagery", codec="png", **options))


@pytest.mark.parametrize("tiled", [True, False])
@pytest.mark.parametrize(("width", "height"), [(700, 300), (64, 64), (1000, 70)])
def test_sums_over_all_tasks_are_those_of_one_row_and_one_column(width: int, height: int, tiled: bool, tmp_path: Path) -> None:
    plan = planned(width, height, tmp_path, tiled=tiled, task=128, pad=2)
    for tier in plan.tiers:
        tasks = list(plan.tasks(tier))
        held = [task_windows(plan, task)[0] for task in tasks]
        assert estimate._all_held(plan, tier) == sum(window.area for window in held)
        assert len(tasks) == np.prod(estimate._task_grid(plan, tier))
        if tier.first == 0:
            assert estimate._all_decoded(plan) == sum(estimate._decoded_samples(plan.source.info, window) for window in held)


@given(st.integers(1, 5000), st.integers(1, 5000), st.sampled_from([16, 64, 256, 2048]))
@example(1, 1, 256)
@example(5000, 1, 16)
@hypothesis_settings(max_examples=200)
def test_windows_are_distinct_tasks_of_the_layer(width: int, height: int, block: int) -> None:
    lattice = Lattice(width, height, block)
    plan: Any = SimpleNamespace(lattice=lattice, source=SimpleNamespace(info=SimpleNamespace(layout="tiled")))
    cells = trial._Cells(plan)
    found = list(cells.spread())
    assert len(set(found)) == len(found) >= min(cells.count, 8)
    assert cells.count > 128 or len(found) == cells.count
    whole = lattice.level_rect(0)
    cores = [cells.task(cell).core for cell in found]
    assert all(core and whole.contains(core) for core in cores)
    assert all(core.x0 % block == core.y0 % block == 0 for core in cores)
    assert cells.task(found[0]).tier == Tier(0, cells.task(found[0]).tier.count, carry=False)


def test_the_first_windows_are_spread_over_the_picture() -> None:
    """2026-11-22: eight windows, spread by multiples of one number, left out a sixth of the columns; they were void."""
    plan: Any = SimpleNamespace(lattice=Lattice(96 * 1024, 96 * 1024), source=SimpleNamespace(info=SimpleNamespace(layout="tiled")))
    first = list(islice(trial._Cells(plan).spread(), 16))
    assert {x // 6 for x, _ in first} == {y // 6 for _, y in first} == set(range(16))
    assert {(x // 24, y // 24) for x, y in first} == {(x, y) for x in range(4) for y in range(4)}
