"""What an independent review of resume, update and repair found on 2026-11-22; each of these tests failed before."""

import json
import os
import random
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tiler.tasks.overlap
from schemas.errors import InputError, StorageError, UsageError
from schemas.manifest import MANIFEST_NAME, Patch, parse_manifest
from tests.integration.files import Picture, settings, tree_digest, write_png, write_tiff
from tests.reference.terrain import photo
from tiler.building.build import build_layer
from tiler.checking.diff import diff
from tiler.checking.repair import verify_and_repair
from tiler.checking.verify import Checks, verify
from tiler.stores.dataset import open_dataset
from tiler.stores.directory import DirectoryStore

OPTIONS: dict[str, Any] = {"codec": "png", "block": 32, "task": 128}


def rgba(width: int, height: int) -> Picture:
    return np.concatenate([photo(width, height), np.full((width, height, 1), 255, np.uint8)], axis=-1)


def changed(path: Path, pixels: Picture, time_s: int) -> Path:
    write_tiff(path, pixels)
    os.utime(path, (time_s, time_s))
    return path


class Stop(BaseException):
    """Ends a build as a kill would: nothing is cleaned up."""


def stop_at(monkeypatch: pytest.MonkeyPatch, method: str, key: str) -> None:
    """Make a build end at the first call of a store's method whose argument contains ``key``."""
    original = getattr(DirectoryStore, method)

    def stopping(self: DirectoryStore, argument: Any, *more: Any) -> Any:
        listed = argument if isinstance(argument, str) else list(argument)
        if key in str(listed):
            monkeypatch.setattr(DirectoryStore, "exclusive", DirectoryStore.exclusive)
            raise Stop
        return original(self, listed, *more)

    monkeypatch.setattr(DirectoryStore, method, stopping)


@pytest.mark.parametrize("codec", ["exr:half", "lerc:0.5"])
def test_a_change_that_no_block_shows_is_published_with_its_indexes(codec: str, tmp_path: Path) -> None:
    """The index holds the range of the samples before they are encoded; a new manifest named an index that nobody had written."""
    heights = (1000 + 50 * np.random.default_rng(0).normal(size=(300, 300, 1))).astype(np.float32)
    source, out = write_tiff(tmp_path / "heights.tif", heights), tmp_path / "out"
    build_layer(source, out, settings(codec=codec))
    heights.reshape(-1)[heights.argmax()] += 0.001
    build_layer(changed(source, heights, 5), out, settings(codec=codec, update=True))
    assert verify(open_dataset(out)).findings == []
    build_layer(source, tmp_path / "full", settings(codec=codec))
    assert diff(open_dataset(out), open_dataset(tmp_path / "full")).same


def test_another_file_with_the_same_size_and_time_is_noticed(tmp_path: Path) -> None:
    for name, seed in (("a", 1), ("b", 2)):
        changed(tmp_path / f"{name}.tif", photo(200, 200, seed=seed), 9)
    build_layer(tmp_path / "a.tif", tmp_path / "out", settings(**OPTIONS))
    with pytest.raises(UsageError, match="or is another file; add --update"):
        build_layer(tmp_path / "b.tif", tmp_path / "out", settings(**OPTIONS))
    build_layer(tmp_path / "b.tif", tmp_path / "out", settings(**OPTIONS, update=True))
    build_layer(tmp_path / "b.tif", tmp_path / "full", settings(**OPTIONS))
    assert diff(open_dataset(tmp_path / "out"), open_dataset(tmp_path / "full")).same


def test_many_lost_pieces_of_an_object_store_are_made_again(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """They were made on the threads that read, which then waited for themselves."""
    monkeypatch.setattr(tiler.tasks.overlap, "is_remote", lambda location: True)
    source, out = write_tiff(tmp_path / "photo.tif", photo(1000, 1000)), tmp_path / "out"
    build_layer(source, out, settings(codec="png", block=8, task=32, workers=2))
    whole = tree_digest(out)
    for path in out.glob("imagery/tasks/*/*/*.f32"):
        path.unlink()
    next(out.glob("imagery/6/*.png")).write_bytes(b"damaged")
    report = verify_and_repair(open_dataset(out), None, Checks(workers=2))
    assert (report.findings, report.notes) == ([], [])
    assert tree_digest(out) == whole


def test_a_rebuild_that_fails_at_once_forgets_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The unfinished build before it was left without a lock: its folder then looked like a stranger's."""
    source, out = write_tiff(tmp_path / "photo.tif", photo(500, 400)), tmp_path / "out"

    def stop(done: int, total: int) -> None:
        if done > total * 3 // 4:
            raise Stop

    with pytest.raises(Stop):
        build_layer(source, out, settings(**OPTIONS, workers=1), stop)
    write = DirectoryStore.write

    def full(self: DirectoryStore, key: str, data: bytes) -> None:
        if key.startswith("imagery.2/"):
            raise StorageError(f"{key}: cannot be written: No space left on device")
        write(self, key, data)

    with monkeypatch.context() as patch:
        patch.setattr(DirectoryStore, "write", full)
        with pytest.raises(StorageError, match="No space left"):
            build_layer(source, out, settings(**{**OPTIONS, "radius": 2, "overwrite": True}))
    report = build_layer(source, out, settings(**OPTIONS))
    assert (report.outcome, report.tasks_kept > 0) == ("continued", True)
    assert sorted(path.name for path in out.iterdir()) == ["imagery", MANIFEST_NAME]


@pytest.mark.parametrize("update", [False, True])
def test_an_unfinished_rebuild_outlives_other_builds(update: bool, tmp_path: Path) -> None:
    """A plain build found the layer up to date and deleted the rebuild; an update took its folder for its own."""
    pixels = photo(500, 400)
    source, out = changed(tmp_path / "photo.tif", pixels, 3), tmp_path / "out"
    build_layer(source, out, settings(**OPTIONS))

    def stop(done: int, total: int) -> None:
        if done > total // 2:
            raise Stop

    rebuilt = settings(**{**OPTIONS, "codec": "webp:80", "overwrite": True})
    with pytest.raises(Stop):
        build_layer(source, out, rebuilt, stop)
    if update:
        changed(source, pixels ^ 0x0F, 4)
    report = build_layer(source, out, settings(**OPTIONS, update=update))
    assert report.outcome == ("updated" if update else "up to date")
    assert any("an unfinished rebuild of the layer lies under imagery.2" in remark for remark in report.remarks)
    assert verify(open_dataset(out)).findings == []
    if not update:
        assert build_layer(source, out, rebuilt).outcome == "continued"
        assert sorted(path.name for path in out.iterdir()) == ["imagery.2", MANIFEST_NAME]


@pytest.mark.parametrize("level", [0, 2])
def test_an_update_replaces_a_damaged_index(level: int, tmp_path: Path) -> None:
    pixels = photo(500, 400)
    source, out = write_tiff(tmp_path / "photo.tif", pixels), tmp_path / "out"
    build_layer(source, out, settings(**OPTIONS))
    (out / f"imagery/{level}/index.bin").write_bytes(b"damaged")
    pixels[:20, :20] ^= 0xFF
    build_layer(changed(source, pixels, 5), out, settings(**OPTIONS, update=True))
    assert verify(open_dataset(out)).findings == []
    build_layer(source, tmp_path / "full", settings(**OPTIONS))
    assert diff(open_dataset(out), open_dataset(tmp_path / "full")).same


def test_a_nodata_value_of_nan_survives_in_the_records(tmp_path: Path) -> None:
    heights = photo(200, 200)[..., :1].astype(np.float32)
    heights[:50] = -9999
    source, out = write_tiff(tmp_path / "heights.tif", heights, nodata=-9999), tmp_path / "out"
    build_layer(source, out, settings(nodata=float("nan"), codec="raw"))
    whole = tree_digest(out)
    next(out.glob("height/0/*.raw")).write_bytes(b"damaged")
    report = verify_and_repair(open_dataset(out), None, Checks())
    assert (report.findings, report.notes) == ([], [])
    assert tree_digest(out) == whole


@pytest.mark.parametrize("seed", range(6))
def test_flipped_bits_in_records_are_noticed(seed: int, tmp_path: Path) -> None:
    """They ended in tracebacks, or in indexes that were not those of the blocks."""
    source, out = write_tiff(tmp_path / "photo.tif", photo(500, 400)), tmp_path / "out"
    build_layer(source, out, settings(**OPTIONS))
    chance = random.Random(seed)
    for path in sorted(out.glob("imagery/tasks/*/*/*.json"))[::2]:
        data = bytearray(path.read_bytes())
        data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        path.write_bytes(data)
    os.utime(source, (7, 7))
    report = build_layer(source, out, settings(**OPTIONS, update=True))
    assert report.outcome == "up to date"
    assert verify(open_dataset(out)).findings == []
    plan = out / "imagery/tasks/plan.json"
    edited = json.loads(plan.read_bytes())
    edited["record"]["partition"]["task"] = 64
    plan.write_text(json.dumps(edited))
    with pytest.raises(UsageError, match="no records of how it was built"):
        build_layer(source, out, settings(**OPTIONS, update=True))


def test_blocks_that_became_blank_meanwhile_leave_no_files(tmp_path: Path) -> None:
    pixels = rgba(500, 400)
    source, out = write_tiff(tmp_path / "photo.tif", pixels), tmp_path / "out"

    def stop(done: int, total: int) -> None:
        if done > total // 2:
            raise Stop

    with pytest.raises(Stop):
        build_layer(source, out, settings(**OPTIONS, workers=1), stop)
    pixels[:100, :, 3] = 0
    build_layer(changed(source, pixels, 5), out, settings(**OPTIONS))
    assert verify(open_dataset(out)).findings == []


@pytest.mark.parametrize("method", ["delete", "delete_prefix"])
@pytest.mark.parametrize("then", ["height", "update"])
def test_an_update_that_is_killed_before_it_has_deleted_leaves_nothing_for_ever(method: str, then: str, tmp_path: Path) -> None:
    pixels = rgba(500, 400)
    source, out = changed(tmp_path / "photo.tif", pixels, 1), tmp_path / "out"
    build_layer(source, out, settings(**OPTIONS))
    for turn in (2, 3):
        pixels[100:200, 100:200, 3] = 0 if turn == 2 else 255
        pixels[100:200, 100:200, 0] ^= 0xFF
        changed(source, pixels, turn)
        with pytest.MonkeyPatch.context() as patch:
            stop_at(patch, method, "imagery")
            with pytest.raises(Stop):
                build_layer(source, out, settings(**OPTIONS, update=True))
    (out / "imagery/0/.tmp-1-2-imagery-0-0.png").write_bytes(b"half")
    if then == "height":
        build_layer(write_tiff(tmp_path / "h.tif", photo(100, 100)[..., :1].astype(np.float32)), out, settings())
    else:
        build_layer(source, out, settings(**OPTIONS, update=True))
    assert verify(open_dataset(out)).findings == []
    layer = open_dataset(out).manifest.layer("imagery")
    assert {path.name for path in out.iterdir()} - {"height"} == {MANIFEST_NAME, *layer.paths}
    assert not list(out.rglob(".tmp-*"))
    assert not [path for path in layer.paths[1:] if (out / path / "tasks").exists()]


def test_files_of_others_beside_the_blocks_are_never_deleted(tmp_path: Path) -> None:
    pixels = photo(500, 400)
    source, out = changed(tmp_path / "photo.tif", pixels, 1), tmp_path / "out"
    build_layer(source, out, settings(**OPTIONS))
    mine = [
        out / "imagery" / name for name in ("0/imagery-0-0220.jpg", "notes/imagery-0-0220.png", "0/height-0-0220.lerc", "0/imagery-9.png")
    ]
    for path in mine:
        path.parent.mkdir(exist_ok=True)
        path.write_text("precious")
    with pytest.MonkeyPatch.context() as patch:
        stop_at(patch, "delete", "imagery")
        with pytest.raises(Stop):
            build_layer(changed(source, pixels ^ 0xFF, 2), out, settings(**OPTIONS, update=True))
    build_layer(source, out, settings(**OPTIONS, update=True))
    assert [path.read_text() for path in mine] == ["precious"] * 4


def test_many_updates_are_put_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tiler.building.publish._MANY_PATCHES", 3)
    pixels = photo(300, 300)
    source, out = changed(tmp_path / "photo.tif", pixels, 1), tmp_path / "out"
    build_layer(source, out, settings(**OPTIONS))
    for turn in range(8):
        pixels[32 * turn : 32 * turn + 4, 32 * turn : 32 * turn + 4] ^= 0xFF
        build_layer(changed(source, pixels, turn + 2), out, settings(**OPTIONS, update=True))
    layer = open_dataset(out).manifest.layer("imagery")
    assert len(layer.patches) < 4
    assert {path.name for path in out.iterdir()} == {MANIFEST_NAME, *layer.paths}
    assert verify(open_dataset(out)).findings == []
    build_layer(source, tmp_path / "full", settings(**OPTIONS))
    assert diff(open_dataset(out), open_dataset(tmp_path / "full")).same


def test_a_manifest_with_patches_without_end_is_refused(tmp_path: Path) -> None:
    build_layer(write_tiff(tmp_path / "photo.tif", photo(100, 100)), tmp_path / "out", settings(**OPTIONS))
    manifest = open_dataset(tmp_path / "out").manifest
    layer = manifest.layers["imagery"]
    patches = [Patch(path=f"imagery.{number}", levels=["all"] * len(layer.levels)) for number in range(2, 100)]
    raw = json.loads(manifest.to_json())
    raw["layers"]["imagery"]["patches"] = [patch.model_dump() for patch in patches]
    with pytest.raises(InputError, match="98 patches of a layer of 4 x 4 blocks are more than are supported"):
        parse_manifest(json.dumps(raw).encode(), "here")


def test_a_file_called_like_the_layer_is_not_in_the_way(tmp_path: Path) -> None:
    source, out = write_tiff(tmp_path / "photo.tif", photo(100, 100)), tmp_path / "out"
    build_layer(write_tiff(tmp_path / "h.tif", photo(100, 100)[..., :1].astype(np.float32)), out, settings())
    (out / "imagery").write_text("precious")
    assert build_layer(source, out, settings(**OPTIONS)).manifest.layer("imagery").path == "imagery.2"
    assert (out / "imagery").read_text() == "precious"


def test_another_place_is_not_called_another_source(tmp_path: Path) -> None:
    source = tmp_path / "photo.png"
    write_png(source, photo(100, 100))
    build_layer(source, tmp_path / "out", settings(**OPTIONS, spacing=10))
    with pytest.raises(UsageError, match="already, and lies elsewhere in the world now; add --update"):
        build_layer(source, tmp_path / "out", settings(**OPTIONS, spacing=20))
    report = build_layer(source, tmp_path / "out", settings(**OPTIONS, spacing=20, update=True))
    assert (report.outcome, report.blocks_written) == ("updated", 0)
    assert report.manifest.layer("imagery").transform[0] == 20


def test_a_source_that_was_moved_can_be_repaired_from_its_new_place(tmp_path: Path) -> None:
    source, out = write_tiff(tmp_path / "photo.tif", photo(200, 200)), tmp_path / "out"
    build_layer(source, out, settings(**OPTIONS))
    (tmp_path / "moved").mkdir()
    moved = shutil.move(source, tmp_path / "moved/photo.tif")
    assert build_layer(Path(moved), out, settings(**OPTIONS, update=True)).outcome == "up to date"
    next(out.glob("imagery/0/*.png")).unlink()
    assert verify_and_repair(open_dataset(out), None, Checks()).findings == []
