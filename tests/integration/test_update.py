"""``--update``: after a source changed, only what that changes is built again, and the result is that of a full build."""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import rasterio.shutil
from hypothesis import HealthCheck, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from schemas.address import BlockAddress
from schemas.errors import InputError, UsageError
from schemas.lattice import support
from schemas.manifest import Layer
from schemas.region import Rect
from tests.integration.files import Picture, settings, write_tiff
from tests.reference.terrain import photo
from tiler.building.build import build_layer
from tiler.checking.diff import diff
from tiler.checking.verify import verify
from tiler.filters.kernels import DESIGNS
from tiler.stores.dataset import Dataset, open_dataset

SIDE = 600


def stored(dataset: Dataset, name: str) -> dict[BlockAddress, bytes | None]:
    """Every block of a layer, read as a client would."""
    lattice = dataset.manifest.layer(name).lattice
    return {address: dataset.block(name, address) for level in range(lattice.levels) for address in lattice.addresses(level)}


def predicted(layer: Layer, changed: Rect) -> set[BlockAddress]:
    """The blocks that see a rectangle of the source: by their samples, their pad, or the support of the filter from level to level."""
    reach = DESIGNS[layer.filter.kernel](layer.filter.radius, layer.registration).reach
    lattice, found = layer.lattice, set()
    for level in range(lattice.levels):
        for address in lattice.addresses(level):
            seen = lattice.core(address).grown(layer.pad) & lattice.level_rect(level)
            for finer in range(level - 1, -1, -1):
                seen = support(seen, reach) & lattice.level_rect(finer)
            if seen & changed:
                found.add(address)
    return found


def rewritten(folder: Path, since_ns: int) -> Iterator[str]:
    return (path.name for path in folder.rglob("*.png") if path.stat().st_mtime_ns > since_ns)


@pytest.mark.parametrize("pad", [0, 3])
@pytest.mark.parametrize("task", [64, 128, 1024])
def test_a_patch_rewrites_the_predicted_blocks_only(task: int, pad: int, tmp_path: Path) -> None:
    pixels = photo(SIDE, SIDE)
    source = write_tiff(tmp_path / "photo.tif", pixels)
    out, options = tmp_path / "out", {"codec": "png", "task": task, "pad": pad}
    build_layer(source, out, settings(**options))
    before = stored(open_dataset(out), "imagery")
    newest = max(path.stat().st_mtime_ns for path in out.rglob("*"))
    changed = Rect(130, 410, 160, 430)
    pixels[410:430, 130:160] += 77
    write_tiff(source, pixels)
    report = build_layer(source, out, settings(update=True, **options))
    build_layer(source, tmp_path / "full", settings(**options))
    dataset, full = open_dataset(out), open_dataset(tmp_path / "full")
    assert report.outcome == "updated"
    after = stored(dataset, "imagery")
    assert after == stored(full, "imagery")
    assert diff(dataset, full).same
    differing = {address for address in after if after[address] != before[address]}
    assert differing <= predicted(dataset.manifest.layer("imagery"), changed)
    assert len(set(rewritten(out, newest))) == len(differing) == report.blocks_written
    assert report.tasks_kept == 0 if task == 1024 else report.tasks_kept > report.tasks / 2
    assert verify(dataset).findings == []
    assert [path.name for path in sorted(out.iterdir())] == ["imagery", "imagery.2", "manifest.json"]


def test_an_unchanged_source_is_up_to_date(tmp_path: Path) -> None:
    """Neither the same file nor a copy of it with another date changes anything; the copy has to be read to know."""
    source = write_tiff(tmp_path / "photo.tif", photo(300, 300))
    first = build_layer(source, tmp_path / "out", settings(codec="png"))
    for update in (False, True):
        again = build_layer(source, tmp_path / "out", settings(codec="png", update=update))
        assert (again.outcome, again.manifest, again.blocks_written) == ("up to date", first.manifest, 0)
    os.utime(source, (1, 1))
    with pytest.raises(UsageError, match="the source has changed since, or is another file; add --update"):
        build_layer(source, tmp_path / "out", settings(codec="png"))
    again = build_layer(source, tmp_path / "out", settings(codec="png", update=True))
    assert (again.outcome, again.manifest, again.tasks_kept) == ("up to date", first.manifest, again.tasks)
    assert build_layer(source, tmp_path / "out", settings(codec="png")).outcome == "up to date"
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["imagery", "manifest.json"]


def test_an_update_that_was_given_up_is_cleared(tmp_path: Path) -> None:
    """The source changes, the update fails half-way, the source is put back: the dataset is up to date, and nothing else is left."""
    pixels = photo(300, 300)
    source, out = write_tiff(tmp_path / "photo.tif", pixels), tmp_path / "out"
    options = {"codec": "png", "task": 64}
    first = build_layer(source, out, settings(**options))
    state = source.stat()
    write_tiff(source, pixels ^ 0xFF)

    def fail(done: int, total: int) -> None:
        if done == total // 2:
            raise InputError("the source became unreadable")

    with pytest.raises(InputError) as failure:
        build_layer(source, out, settings(update=True, **options), fail)
    assert "tasks are finished and kept" in failure.value.__notes__[0]
    assert (out / "imagery.2").exists()
    write_tiff(source, pixels)
    os.utime(source, ns=(state.st_atime_ns, state.st_mtime_ns))
    again = build_layer(source, out, settings(**options))
    assert (again.outcome, again.manifest) == ("up to date", first.manifest)
    assert sorted(path.name for path in out.iterdir()) == ["imagery", "manifest.json"]
    assert verify(open_dataset(out)).findings == []
    os.utime(source)
    assert build_layer(source, out, settings(update=True, **options)).manifest == first.manifest


def test_a_change_behind_a_vrt_is_seen(tmp_path: Path) -> None:
    """The file that is named stays as it is; the one it refers to changes."""
    pixels = photo(300, 300)
    source = write_tiff(tmp_path / "photo.tif", pixels)
    rasterio.shutil.copy(source, tmp_path / "photo.vrt", driver="VRT")
    build_layer(tmp_path / "photo.vrt", tmp_path / "out", settings(codec="png"))
    pixels[:9, :9] ^= 0xFF
    write_tiff(source, pixels)
    with pytest.raises(UsageError, match="the source has changed since, or is another file; add --update"):
        build_layer(tmp_path / "photo.vrt", tmp_path / "out", settings(codec="png"))
    assert build_layer(tmp_path / "photo.vrt", tmp_path / "out", settings(codec="png", update=True)).outcome == "updated"


def test_an_update_of_nothing_is_a_build(tmp_path: Path) -> None:
    source = write_tiff(tmp_path / "photo.tif", photo(100, 100))
    assert build_layer(source, tmp_path / "out", settings(update=True)).outcome == "built"


@pytest.mark.parametrize(
    ("options", "difference"),
    [
        ({"radius": 2}, "radius was 3, now 2"),
        ({"codec": "webp:80"}, "codec was png, now webp:80"),
        ({"pad": 1, "clamp": "local"}, "pad was 0, now 1, clamp was none, now local"),
        ({"bands": (3, 2, 1)}, r"bands was \[1, 2, 3\], now \[3, 2, 1\]"),
    ],
)
def test_other_settings_are_refused(options: dict[str, object], difference: str, tmp_path: Path) -> None:
    source = write_tiff(tmp_path / "photo.tif", photo(100, 100))
    build_layer(source, tmp_path / "out", settings(codec="png"))
    for update in (False, True):
        with pytest.raises(UsageError, match=rf"other settings \({difference}\); add --overwrite"):
            build_layer(source, tmp_path / "out", settings(**{"codec": "png", "update": update, **options}))
    assert build_layer(source, tmp_path / "out", settings(**{"codec": "png", "overwrite": True, **options})).outcome == "built"


def test_a_source_of_another_size_is_refused(tmp_path: Path) -> None:
    source = write_tiff(tmp_path / "photo.tif", photo(100, 100))
    build_layer(source, tmp_path / "out", settings())
    write_tiff(source, photo(100, 101))
    with pytest.raises(UsageError, match=r"size was \[100, 100\], now \[101, 100\]"):
        build_layer(source, tmp_path / "out", settings(update=True))


def test_without_records_nothing_can_be_updated(tmp_path: Path) -> None:
    source = write_tiff(tmp_path / "photo.tif", photo(100, 100))
    build_layer(source, tmp_path / "out", settings(records=False))
    assert not list(tmp_path.rglob("tasks"))
    with pytest.raises(UsageError, match="no records of how it was built; add --overwrite"):
        build_layer(source, tmp_path / "out", settings(update=True))
    build_layer(source, tmp_path / "other", settings())
    assert build_layer(source, tmp_path / "other", settings(records=False)).outcome == "up to date"
    assert not list(tmp_path.rglob("tasks"))


def test_a_source_that_changes_while_it_is_read_is_not_published(tmp_path: Path) -> None:
    pixels = photo(300, 300)
    source = write_tiff(tmp_path / "photo.tif", pixels)

    def touch(done: int, total: int) -> None:
        if done == total:
            os.utime(source, (1, 1))

    with pytest.raises(InputError, match=r"photo\.tif: was changed while it was read; run the same command again"):
        build_layer(source, tmp_path / "out", settings(), touch)
    assert not (tmp_path / "out/manifest.json").exists()
    assert build_layer(source, tmp_path / "out", settings()).tasks_kept > 0


def test_a_source_that_changes_early_is_noticed_early(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tiler.building.layer._LOOK_EVERY_S", 0.0)
    source = write_tiff(tmp_path / "photo.tif", photo(600, 600))
    seen = []

    def touch(done: int, total: int) -> None:
        seen.append(done / total)
        os.utime(source, (1, 1))

    with pytest.raises(InputError, match=r"photo\.tif: was changed while it was read"):
        build_layer(source, tmp_path / "out", settings(workers=1, task=64), touch)
    assert max(seen) < 0.2


@given(
    edits=st.lists(st.tuples(st.integers(0, 270), st.integers(0, 250), st.integers(1, 90), st.integers(1, 90)), min_size=1, max_size=3),
    pad=st.sampled_from([0, 2]),
    lost=st.booleans(),
)
@hypothesis_settings(max_examples=6, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_update_after_update_is_a_full_build(
    edits: list[tuple[int, int, int, int]], pad: int, lost: bool, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Also where blocks become blank or stop being so, and where the samples between tiers were lost."""
    folder = tmp_path_factory.mktemp("updates")
    pixels: Picture = np.concatenate([photo(250, 270), np.full((250, 270, 1), 255, np.uint8)], axis=-1)
    source, options = write_tiff(folder / "photo.tif", pixels), {"codec": "png", "pad": pad, "task": 64}
    build_layer(source, folder / "out", settings(**options))
    for turn, (x, y, width, height) in enumerate(edits):
        pixels[y : y + height, x : x + width, 3] = 0 if turn % 2 == 0 else 255
        pixels[y : y + height, x : x + width, 0] += 1
        write_tiff(source, pixels)
        os.utime(source, (turn, turn))
        if lost:
            for path in folder.glob("out/imagery/tasks/*/*/*.f32"):
                path.unlink()
        build_layer(source, folder / "out", settings(update=True, **options))
        dataset = open_dataset(folder / "out")
        assert verify(dataset).findings == []
    build_layer(source, folder / "full", settings(**options))
    full = open_dataset(folder / "full")
    assert stored(dataset, "imagery") == stored(full, "imagery")
    assert diff(dataset, full).same
