"""Exports as a user meets them: the command, what goes wrong, and that nothing half-written ever has its final name."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import rasterio
from hypothesis import given
from hypothesis import strategies as st

from cli.main import run
from schemas.address import BlockAddress
from schemas.errors import InputError, UsageError
from schemas.region import Rect
from tests.integration.export_datasets import build, exported, the_layer
from tests.integration.files import settings, tree_digest, write_tiff
from tests.reference.terrain import photo, terrain
from tiler.building.build import build_layer
from tiler.export import FORMS
from tiler.export.pyramid import Pyramid, in_order, tile_count, tiles
from tiler.stores.dataset import open_dataset

LOCAL = ["cog", "dzi", "exr"]
TARGETS = {"cog": "a.tif", "dzi": "a.dzi", "exr": "a.exr", "pmtiles": "a.pmtiles"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("exports")


@pytest.fixture(scope="module")
def both(folder: Path) -> Path:
    """A dataset of heights and imagery."""
    out = folder / "both"
    for name, pixels in (("height", terrain(70, 90, seed=1).astype(np.float32)), ("photo", photo(70, 90, seed=1))):
        build_layer([write_tiff(folder / f"{name}.tif", pixels)], out, settings(codec="raw"))
    return out


def clipmap(capfd: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    capfd.readouterr()
    code = run([str(argument) for argument in arguments])
    return code, *capfd.readouterr()


@pytest.mark.parametrize("form", FORMS)
def test_the_command(form: str, folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    dataset = build("webp", folder)
    code, out, err = clipmap(capfd, "export", dataset, form, "-o", tmp_path / "a", "--json")
    assert (code, err) == (0, "")
    report = json.loads(out)
    assert report["output"] == str(tmp_path / TARGETS[form])
    assert (report["layer"], report["form"]) == ("imagery", form)
    assert report["stored_bytes"] == sum(path.stat().st_size for path in tmp_path.rglob("*") if path.is_file())
    before = tree_digest(tmp_path)
    code, out, err = clipmap(capfd, "export", dataset, form, "-o", tmp_path / "a")
    assert (code, out) == (2, "")
    assert "exists already; add --overwrite" in err
    assert tree_digest(tmp_path) == before
    code, out, err = clipmap(capfd, "export", dataset, form, "-o", tmp_path / TARGETS[form], "--overwrite")
    assert (code, err) == (0, "")
    assert out.startswith("layer   imagery of ")
    assert tree_digest(tmp_path) == before


def test_the_forms_of_the_command_are_those_there_are(capfd: pytest.CaptureFixture[str]) -> None:
    code, _, err = clipmap(capfd, "export", "x", "nonsense", "-o", "y")
    assert code == 2
    assert all(f"'{form}'" in err for form in FORMS)


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["cog"], 2, "has height and imagery; say which one with --layer"),
        (["cog", "--layer", "height", "--half"], 2, "--half, --float and --codes are for exr"),
        (["cog", "--layer", "light"], 3, "no layer 'light' in"),
        (["dzi", "--layer", "height"], 2, "heights and normals are no pictures; export them as cog or exr"),
        (["exr", "--layer", "height", "-o", "nowhere/a.exr"], 4, "there is no folder nowhere"),
    ],
)
def test_mistakes_are_one_sentence(
    arguments: list[str],
    code: int,
    says: str,
    both: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    found, out, err = clipmap(capfd, "export", both, "-o", "a", *arguments)
    assert (found, out) == (code, "")
    assert says in err
    assert err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_the_layer_that_fits_need_not_be_named(both: Path, tmp_path: Path) -> None:
    assert exported(both, "dzi", tmp_path / "a").layer == "imagery"


def test_no_dataset(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    code, _, err = clipmap(capfd, "export", tmp_path / "none", "cog", "-o", tmp_path / "a")
    assert code == 3
    assert "no dataset there" in err


def test_a_folder_is_never_replaced(both: Path, tmp_path: Path) -> None:
    (tmp_path / "a.tif").mkdir()
    with pytest.raises(UsageError, match="is a folder"):
        exported(both, "cog", tmp_path / "a.tif", layer="height", overwrite=True)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("damage", ["bit", "cut", "missing", "index"])
def test_damage_is_named_and_nothing_is_left(form: str, damage: str, folder: Path, tmp_path: Path) -> None:
    build("webp", folder)
    build_layer([folder / "webp" / "source.tif"], tmp_path / "out", settings(codec="webp:80"))
    dataset = open_dataset(tmp_path / "out")
    layer = dataset.manifest.layer("imagery")
    key = layer.index_key(0) if damage == "index" else layer.block_key("imagery", BlockAddress(0, 2, 1))
    path = tmp_path / "out" / key
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 16
    if damage == "missing":
        path.unlink()
    else:
        path.write_bytes(data[:-3] if damage == "cut" else data)
    target = tmp_path / "exports"
    target.mkdir()
    with pytest.raises(InputError) as raised:
        exported(tmp_path / "out", form, target / TARGETS[form])
    assert str(path) in str(raised.value)
    assert not list(target.iterdir())


EXPORT = """
import resource, sys
from cli.main import main
limit = int(sys.argv.pop(1))
if limit:
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
main()
"""


def started(dataset: Path, form: str, target: Path, limit_bytes: int = 0) -> subprocess.Popen[str]:
    """Run the command in a process of its own, whose files may not grow beyond ``limit_bytes`` if that is not 0."""
    arguments = [str(limit_bytes), "export", str(dataset), form, "-o", str(target), "--workers", "1"]
    return subprocess.Popen([sys.executable, "-c", EXPORT, *arguments], text=True, stderr=subprocess.PIPE, stdout=subprocess.PIPE)


@pytest.fixture(scope="module")
def large(folder: Path) -> Path:
    """A dataset whose exports take long enough to be killed: 1200 blocks of noise."""
    noise = np.random.default_rng(1).integers(0, 255, (480, 480, 3), np.uint8)
    build_layer([write_tiff(folder / "noise.tif", noise)], folder / "large", settings(block=16, codec="raw"))
    return folder / "large"


@pytest.mark.parametrize("form", FORMS)
def test_a_full_disk_is_one_sentence_and_nothing_is_left(form: str, large: Path, tmp_path: Path) -> None:
    """The limit on a file's size stands for the full disk: EFBIG comes where ENOSPC would."""
    if form == "dzi":
        pytest.skip("its files are small; see test_the_descriptor_comes_last")
    if form == "pmtiles":
        large = build("webp", large.parent)
    process = started(large, form, tmp_path / TARGETS[form], 5_000 if form == "pmtiles" else 300_000)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 4, err
    assert "cannot be written" in err
    assert err.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("form", ["cog", "exr"])
@pytest.mark.parametrize("missing", [1, 300])
def test_a_disk_that_is_full_at_the_very_end(form: str, missing: int, folder: Path, tmp_path: Path) -> None:
    """OpenEXR writes its last bytes when its object goes and tells nobody whether it could."""
    dataset = build("webp_rgba", folder)
    whole = exported(dataset, form, folder / f"whole-{TARGETS[form]}", overwrite=True).done.stored_bytes
    process = started(dataset, form, tmp_path / TARGETS[form], whole - missing)
    _, err = process.communicate(timeout=60)
    assert (process.returncode, err.count("\n")) == (4, 1), err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("form", LOCAL)
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
def test_killed_on_the_way(form: str, how: signal.Signals, large: Path, tmp_path: Path) -> None:
    """Nothing has the final name; what a kill leaves is hidden, and the next export writes over it."""
    process = started(large, form, tmp_path / TARGETS[form])
    deadline = time.monotonic() + 60
    while not any(path.is_file() and path.stat().st_size for path in tmp_path.rglob("*")) and time.monotonic() < deadline:
        time.sleep(0.002)
    process.send_signal(how)
    process.communicate(timeout=60)
    assert process.returncode != 0, "it ended before it could be killed: make the dataset larger"
    left = [path.name for path in tmp_path.iterdir()]
    assert all(name.startswith(".tmp-") for name in left)
    assert not left or how == signal.SIGKILL
    exported(large, form, tmp_path / TARGETS[form], workers=1)
    again = tree_digest(tmp_path)
    assert not [path.name for path in tmp_path.iterdir() if path.name.startswith(".tmp-")]
    (tmp_path / "fresh").mkdir()
    exported(large, form, tmp_path / "fresh" / TARGETS[form], workers=2)
    assert tree_digest(tmp_path / "fresh") == again


def test_two_exports_to_one_file_exclude_each_other(both: Path, large: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    process = started(large, "cog", tmp_path / "a.tif")
    try:
        while not (tmp_path / ".tmp-a.tif").exists() and process.poll() is None:
            time.sleep(0.005)
        os.kill(process.pid, signal.SIGSTOP)
        code, _, err = clipmap(capfd, "export", both, "cog", "--layer", "height", "-o", tmp_path / "a.tif")
        assert code == 4
        assert "another export is writing it" in err
    finally:
        os.kill(process.pid, signal.SIGCONT)
        process.communicate(timeout=60)
    assert process.returncode == 0
    with rasterio.open(tmp_path / "a.tif") as file:
        assert file.shape == (480, 480)


def test_an_unwritable_folder(both: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("x")
    code, _, err = clipmap(capfd, "export", both, "cog", "--layer", "height", "-o", tmp_path / "file" / "a.tif")
    assert code == 4
    assert "there is no folder" in err


def test_blocks_of_an_archive_are_the_datasets(folder: Path, tmp_path: Path) -> None:
    """The reference reader of PMTiles gets every stored block."""
    from pmtiles.reader import MmapSource, Reader

    dataset = open_dataset(build("webp", folder))
    layer = dataset.manifest.layer(the_layer(dataset))
    exported(folder / "webp" / "out", "pmtiles", tmp_path / "a.pmtiles")
    with (tmp_path / "a.pmtiles").open("rb") as file:
        reader = Reader(MmapSource(file))
        for level in range(len(layer.levels)):
            for address in layer.lattice.addresses(level):
                assert reader.get(len(layer.levels) - 1 - level, address.x, address.y) == dataset.block("imagery", address)


@pytest.mark.parametrize("form", LOCAL)
def test_it_does_not_matter_where_the_dataset_lies(form: str, folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """A folder, its URL, or an archive, which is a dataset of one layer: the same bytes."""
    dataset = build("webp_rgba", folder)
    exported(dataset, "pmtiles", tmp_path / "archive")
    places = {"folder": str(dataset), "url": dataset.as_uri(), "archive": str(tmp_path / "archive.pmtiles")}
    for name, place in places.items():
        (tmp_path / name).mkdir()
        assert clipmap(capfd, "export", place, form, "-o", tmp_path / name / TARGETS[form])[0] == 0
    assert len({tree_digest(tmp_path / name) for name in places}) == 1


@given(st.data())
def test_windows_are_parts_of_the_level(data: st.DataObject) -> None:
    """Any window of any level, made ones too, is that part of the whole level; blank blocks are 0 and not valid."""
    pyramid = _PYRAMIDS[data.draw(st.sampled_from(sorted(_PYRAMIDS)))]
    level = data.draw(st.integers(0, pyramid.levels - 1))
    whole = pyramid.rect(level)
    x0, y0 = data.draw(st.integers(-40, whole.x1 - 1)), data.draw(st.integers(-40, whole.y1 - 1))
    wanted = Rect(x0, y0, data.draw(st.integers(max(1, x0 + 1), whole.x1 + 40)), data.draw(st.integers(max(1, y0 + 1), whole.y1 + 40)))
    inside = wanted & whole
    found, all_of_it = pyramid.window(level, wanted), pyramid.window(level, whole)
    part = np.s_[inside.y0 : inside.y1, inside.x0 : inside.x1]
    assert found.samples.tobytes() == all_of_it.samples[part].tobytes()
    assert (found.valid == all_of_it.valid[part]).all()


_PYRAMIDS: dict[str, Pyramid] = {}


@pytest.fixture(scope="module", autouse=True)
def pyramids(folder: Path) -> None:
    for kind in ("png_rgba_pad", "lerc", "raw_small"):
        dataset = open_dataset(build(kind, folder))
        _PYRAMIDS[kind] = Pyramid(dataset, the_layer(dataset), 1)


@given(st.integers(1, 400), st.integers(1, 400), st.sampled_from([16, 32, 128]))
def test_tiles_cover_once(width: int, height: int, side: int) -> None:
    whole = Rect(0, 0, width, height)
    covered = [tile & whole for tile in tiles(whole, side)]
    assert len(covered) == tile_count(whole, side)
    assert sum(tile.area for tile in covered) == whole.area
    assert all(covered)


@given(st.integers(0, 60), st.integers(1, 5))
def test_results_come_in_order_with_few_ahead(count: int, workers: int) -> None:
    taken: list[int] = []

    def numbers() -> object:
        for number in range(count):
            taken.append(number)
            yield number

    results = in_order(lambda number: -number, numbers(), workers)  # type: ignore[arg-type]
    for expected, result in enumerate(results):
        assert result == -expected
        assert len(taken) <= expected + 2 * workers + 1
    assert len(taken) == count
