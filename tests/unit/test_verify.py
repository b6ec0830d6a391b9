"""Verification finds every planted fault, says where it is, and finds nothing else."""

import random
import shutil
from pathlib import Path

import numpy as np
import pytest

from schemas.address import BlockAddress
from schemas.blockindex import BlockRecord
from schemas.errors import NotFoundError, StorageError, UsageError
from schemas.findings import Finding, VerifyReport
from tests.integration.files import settings, write_tiff
from tests.reference.terrain import photo, terrain
from tests.unit.tampering import (
    block_path,
    change_samples,
    edit_layer,
    edit_level,
    edit_record,
    manifest_of,
    record_of,
    replace_bytes,
)
from tiler.building.build import build_layer
from tiler.checking import verify as verify_module
from tiler.checking.verify import Checks, verify
from tiler.codecs import Mask, Samples
from tiler.stores.dataset import Dataset, open_dataset
from tiler.stores.directory import DirectoryStore

PAD = 2
SEAMS = Checks(seams=True, workers=2)


@pytest.fixture(scope="module")
def heights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Heights with a void that leaves some blocks of 16 x 16 blank."""
    pixels = terrain(150, 310, seed=3).astype(np.float32)
    pixels[30:90, 100:190] = np.nan
    return write_tiff(tmp_path_factory.mktemp("source") / "height.tif", pixels)


@pytest.fixture(scope="module")
def picture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiff(tmp_path_factory.mktemp("source") / "photo.tif", photo(120, 200, seed=3))


@pytest.fixture(scope="module")
def built(heights: Path, picture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of both in lossless blocks of 16 with a pad; level 0 of the heights has 20 x 10 blocks. Not to be changed."""
    folder = tmp_path_factory.mktemp("built") / "survey"
    for source, codec in ((heights, "lerc:0"), (picture, "png")):
        build_layer(source, folder, settings(block=16, pad=PAD, codec=codec))
    return folder


@pytest.fixture
def survey(built: Path, tmp_path: Path) -> Path:
    """A copy of it to be damaged."""
    return Path(shutil.copytree(built, tmp_path / "survey"))


def checked(folder: Path, checks: Checks = SEAMS) -> VerifyReport:
    return verify(open_dataset(folder), checks=checks)


def places(report: VerifyReport) -> list[tuple[str, str]]:
    return [(found.kind, found.place) for found in report.findings]


def only(report: VerifyReport) -> Finding:
    (found,) = report.findings
    return found


def stored_blocks(folder: Path, name: str) -> list[BlockAddress]:
    dataset = open_dataset(folder)
    lattice = dataset.manifest.layers[name].lattice
    addresses = (address for level in range(lattice.levels) for address in lattice.addresses(level))
    return [address for address in addresses if not dataset.record(name, address).blank]


@pytest.mark.parametrize("codec", ["raw", "lerc:0", "lerc:0.01", "lerc:5", "png16:0.1,-500", "exr:float", "exr:half"])
@pytest.mark.parametrize("pad", [0, 3])
def test_built_heights_are_intact(codec: str, pad: int, heights: Path, tmp_path: Path) -> None:
    build_layer(heights, tmp_path / "out", settings(codec=codec, pad=pad))
    report = checked(tmp_path / "out")
    assert report.findings == []
    (layer,) = report.layers
    levels = manifest_of(tmp_path / "out").layers["height"].levels
    assert layer.blocks == sum(level.columns * level.rows for level in levels)
    assert layer.stored_bytes == sum(level.stored_bytes for level in levels)
    assert layer.decoded
    assert (layer.seams_compared or 0) > 0 if pad else layer.seams_compared == 0
    if codec in ("raw", "lerc:0", "exr:float") and pad:
        assert (layer.seam_tolerance, layer.seam_largest) == (0, 0)


@pytest.mark.parametrize("codec", ["raw", "png", "rgb565", "jpeg:85", "webp:85"])
def test_built_pictures_are_intact(codec: str, picture: Path, tmp_path: Path) -> None:
    build_layer(picture, tmp_path / "out", settings(codec=codec, pad=2))
    report = checked(tmp_path / "out")
    assert report.findings == []
    (layer,) = report.layers
    assert layer.seams_compared
    assert layer.seam_tolerance == {"raw": 0, "png": 0, "rgb565": 8}.get(codec)
    assert (layer.seam_largest == 0) == (codec in ("raw", "png", "rgb565"))


@pytest.mark.parametrize(("codec", "dtype"), [("png", "uint16"), ("webp:80", "uint8"), ("raw", "uint8")])
def test_pictures_with_alpha_are_intact(codec: str, dtype: str, tmp_path: Path) -> None:
    colours = photo(90, 140, seed=5)
    alpha = np.where(np.add.outer(np.arange(90), np.arange(140)) > 90, 255, 0).astype(np.uint8)
    pixels = np.concatenate([colours, alpha[..., np.newaxis]], axis=-1).astype(dtype) * (257 if dtype == "uint16" else 1)
    source = write_tiff(tmp_path / "rgba.tif", pixels, photometric="RGB", alpha="YES")
    build_layer(source, tmp_path / "out", settings(codec=codec, pad=2, layer="imagery"))
    assert manifest_of(tmp_path / "out").layers["imagery"].alpha
    assert checked(tmp_path / "out").findings == []


@pytest.mark.parametrize("checks", [Checks(decode=False), Checks(), SEAMS, Checks(seams=True, workers=7)])
def test_twenty_damaged_blocks_are_named_and_nothing_else(checks: Checks, survey: Path) -> None:
    draw = random.Random(20)
    blocks = [(name, address) for name in ("height", "imagery") for address in stored_blocks(survey, name)]
    expected = []
    for number, (name, address) in enumerate(draw.sample(blocks, 20)):
        path = block_path(survey, name, address)
        data = bytearray(path.read_bytes())
        if number % 4 == 0:
            data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
        elif number % 4 == 1:
            del data[draw.randrange(len(data)) :]
        elif number % 4 == 2:
            data = bytearray(len(data))
        path.write_bytes(data)
        if number % 4 == 3:
            path.unlink()
        expected.append((("digest", "length", "digest", "missing")[number % 4], f"{name}/{address}"))
    report = checked(survey, checks)
    assert sorted(places(report)) == sorted(expected)
    assert {found.file for found in report.findings} == {
        block_path(survey, found.layer, BlockAddress(found.level or 0, found.x or 0, found.y or 0)).relative_to(survey).as_posix()
        for found in report.findings
    }
    assert all("clipmap build --overwrite" in found.remedy for found in report.findings)


@pytest.mark.parametrize("held_bytes", [1, 1 << 18, 1 << 26])
def test_patches_and_threads_change_nothing(held_bytes: int, survey: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A seam between the patches of 16 blocks is compared like any other, however narrow they are."""
    change_samples(survey, "height", BlockAddress(0, 16, 8), lambda samples, mask: _add(samples, 8, 0, 1))
    change_samples(survey, "height", BlockAddress(0, 15, 8), lambda samples, mask: _add(samples, 8, -1, 1))
    monkeypatch.setattr(verify_module, "_HELD_BYTES", held_bytes)
    reports = [checked(survey, Checks(seams=True, workers=workers)) for workers in (1, 5)]
    assert reports[0] == reports[1]
    assert places(reports[0]) == [("seam", "height/0/15/8"), ("seam", "height/0/16/8")]
    clean = sum(layer.seams_compared or 0 for layer in reports[0].layers)
    lattice = manifest_of(survey).layers["height"].lattice
    stored = {(name, address) for name in ("height", "imagery") for address in stored_blocks(survey, name)}
    lattices = {name: layer.lattice for name, layer in manifest_of(survey).layers.items()}
    assert lattice.block_counts(0) == (20, 10)
    assert clean == sum(lattices[name].contains(other) for name, address in stored for other in address.neighbours())


def _add(samples: Samples, row: int, column: int, by: float) -> None:
    samples[row, column] += by


@pytest.mark.parametrize(
    ("row", "column", "neighbour"), [(8, 0, "0/2/8"), (0, 8, "0/3/7"), (-1, 9, "0/3/9"), (5, -2, "0/4/8"), (1, 1, "0/2/7")]
)
def test_one_wrong_sample_in_a_border(row: int, column: int, neighbour: str, survey: Path) -> None:
    change_samples(survey, "height", BlockAddress(0, 3, 8), lambda samples, mask: _add(samples, row, column, 0.001))
    assert checked(survey, Checks()).findings == []
    found = only(checked(survey))
    assert (found.kind, found.place) == ("seam", "height/0/3/8")
    assert f"the border differs from the core of {neighbour} in 1 of " in found.what
    side = 16 + 2 * PAD
    sample = 3 * 16 - PAD + column % side, 8 * 16 - PAD + row % side
    assert f"first at sample {sample[0]},{sample[1]}" in found.what


def test_one_wrong_code_in_a_border_of_a_picture(survey: Path) -> None:
    change_samples(survey, "imagery", BlockAddress(1, 1, 1), lambda samples, mask: np.bitwise_xor.at(samples, (0, 7, 1), np.uint8(1)))
    found = only(checked(survey))
    assert (found.kind, found.place) == ("seam", "imagery/1/1/1")
    assert "by up to 1," in found.what


def test_a_wrong_sample_in_a_core_shows_in_the_borders_around(survey: Path) -> None:
    """The corner of a core lies in the borders of three neighbours; the middle in none."""

    def corner(samples: Samples, mask: Mask) -> None:
        samples[PAD, PAD] = np.nextafter(samples[PAD, PAD], samples[PAD + 1, PAD + 1])

    change_samples(survey, "height", BlockAddress(0, 3, 8), corner)
    report = checked(survey)
    assert places(report) == [("seam", f"height/0/{x}/{y}") for x, y in ((2, 7), (3, 7), (2, 8))]
    assert all("the core of 0/3/8 in 1 of" in found.what for found in report.findings)


def test_a_void_in_a_border_that_is_none(survey: Path) -> None:
    def hole(samples: Samples, mask: Mask) -> None:
        mask[7, 0] = False

    change_samples(survey, "height", BlockAddress(0, 3, 8), hole)
    found = only(checked(survey))
    assert (found.kind, found.place) == ("seam", "height/0/3/8")
    assert "in 1 of 32 samples, first" in found.what


def test_a_blank_neighbour_has_nothing_in_a_border(survey: Path) -> None:
    dataset = open_dataset(survey)
    blank = next(a for a in dataset.manifest.layers["height"].lattice.addresses(0) if dataset.record("height", a).blank)
    beside = BlockAddress(0, blank.x - 1, blank.y)
    assert not dataset.record("height", beside).blank

    def ground(samples: Samples, mask: Mask) -> None:
        mask[8, -1] = True

    change_samples(survey, "height", beside, ground)
    found = only(checked(survey))
    assert (found.kind, found.place) == ("seam", f"height/{beside}")
    assert f"the core of {blank} in 1 of" in found.what


@pytest.mark.parametrize(("error_m", "count"), [(0.001, 0), (1.0, 1)])
def test_bounded_codecs_may_differ_by_twice_their_bound(error_m: float, count: int, heights: Path, tmp_path: Path) -> None:
    build_layer(heights, tmp_path / "out", settings(block=16, pad=2, codec="lerc:0.05"))
    change_samples(tmp_path / "out", "height", BlockAddress(0, 3, 8), lambda samples, mask: _add(samples, 8, 0, error_m))
    report = checked(tmp_path / "out")
    assert [found.kind for found in report.findings] == ["seam"] * count
    assert report.layers[0].seam_tolerance == 0.1


def test_codecs_without_a_bound_are_told_but_do_not_fail(picture: Path, tmp_path: Path) -> None:
    build_layer(picture, tmp_path / "out", settings(pad=2, codec="jpeg:85"))
    before = checked(tmp_path / "out").layers[0].seam_largest or 0
    change_samples(tmp_path / "out", "imagery", BlockAddress(0, 1, 1), lambda samples, mask: samples.__setitem__(np.s_[:8], 255))
    report = checked(tmp_path / "out")
    assert report.findings == []
    assert (report.layers[0].seam_largest or 0) > before + 20
    assert report.layers[0].seam_tolerance is None


def test_files_that_belong_to_no_block(survey: Path) -> None:
    dataset = open_dataset(survey)
    lattice = dataset.manifest.layers["height"].lattice
    blank = next(a for a in lattice.addresses(0) if dataset.record("height", a).blank)
    some = block_path(survey, "height", BlockAddress(0, 0, 0))
    strays = [
        survey / name for name in ("height/notes.txt", "height/9/index.bin", f"height/1/{some.name}", "height/0/a/b", "height/0/x.lerc")
    ]
    for path in [*strays, survey / "height/0/.tmp-1", survey / "elsewhere.txt"]:
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"x")
    block_path(survey, "height", blank).write_bytes(some.read_bytes())
    for checks in (SEAMS, Checks(decode=False)):
        report = checked(survey, checks)
        assert {found.kind for found in report.findings} == {"stray"}
        files = {path.relative_to(survey).as_posix() for path in [*strays, block_path(survey, "height", blank)]}
        assert {found.file for found in report.findings} == files
        assert [found.place for found in report.findings if "blank" in found.what] == [f"height/{blank}"]


@pytest.mark.parametrize(
    ("damage", "what"),
    [("gone", "the index is missing"), ("flipped", "differs from the digest in the manifest"), ("short", "bytes instead of")],
)
def test_a_damaged_index_is_one_finding_and_the_other_levels_are_checked(damage: str, what: str, survey: Path) -> None:
    path = survey / "height/0/index.bin"
    data = path.read_bytes()
    if damage == "gone":
        path.unlink()
    else:
        path.write_bytes(data[:-1] if damage == "short" else bytes([data[0] ^ 1]) + data[1:])
    block_path(survey, "height", BlockAddress(1, 0, 0)).unlink()
    report = checked(survey)
    assert places(report) == [("index", "height/0"), ("missing", "height/1/0/0")]
    assert what in report.findings[0].what
    assert "200 blocks were not checked" in report.findings[0].what
    assert report.findings[0].file == "height/0/index.bin"


@pytest.mark.parametrize(
    ("change", "kind", "what"),
    [
        ({"stored": 7}, "counts", "stored of level 1 is 7, but the index has "),
        ({"blank": 7}, "counts", "blank of level 1 is 7, but the index has "),
        ({"stored_bytes": 7}, "counts", "stored_bytes of level 1 is 7, but the index has "),
        ({"availability": "bm9uc2Vuc2U="}, "availability", "the availability of level 1 is damaged"),
        ({"availability": "all"}, "availability", "availability of level 1 contradicts the index for "),
    ],
)
def test_a_manifest_that_contradicts_the_index(change: dict[str, object], kind: str, what: str, survey: Path) -> None:
    edit_level(survey, "height", 1, **change)
    found = only(checked(survey))
    assert (found.kind, found.place, found.file) == (kind, "height/1", "manifest.json")
    assert what in found.what


@pytest.mark.parametrize(("field", "value"), [("valid", 5), ("min", [-9.0]), ("max", [])])
def test_statistics_that_contradict_the_index(field: str, value: object, survey: Path) -> None:
    statistics = manifest_of(survey).layers["height"].statistics.model_dump() | {field: value}
    edit_layer(survey, "height", statistics=statistics)
    found = only(checked(survey))
    assert (found.kind, found.place) == ("statistics", "height")
    assert f"statistics.{field} is " in found.what


@pytest.mark.parametrize(("change", "what"), [({"valid": 9}, "9"), ({"min": -1e4}, "smallest"), ({"max": 1e4}, "largest")])
def test_records_that_contradict_the_samples(change: dict[str, float], what: str, survey: Path) -> None:
    address = BlockAddress(1, 1, 4)
    old = record_of(survey, "height", address)
    fields = {"valid": old.valid, "min": old.min, "max": old.max} | change
    edit_record(survey, "height", address, BlockRecord(old.digest, old.length_bytes, int(fields["valid"]), fields["min"], fields["max"]))
    found = only(checked(survey))
    assert (found.kind, found.place) == ("statistics", f"height/{address}")
    assert what in found.what
    assert checked(survey, Checks(decode=False)).findings == []


@pytest.mark.parametrize("codec", ["png16:0.01,0", "lerc:0.01"])
def test_overshoot_is_recorded_as_readers_see_it(codec: str, tmp_path: Path) -> None:
    """2026-11-22: beside a cliff over its whole range, the index of png16 had overshoot that no reader could get."""
    cliff = np.where(np.arange(128) < 64, 0.0, 655.35).astype(np.float32)
    source = write_tiff(tmp_path / "cliff.tif", np.broadcast_to(cliff, (96, 128))[..., np.newaxis].copy())
    build_layer(source, tmp_path / "out", settings(codec=codec, pad=1))
    highest = max(record_of(tmp_path / "out", "height", BlockAddress(1, x, 0)).max for x in (0, 1))
    assert highest > 660 if codec.startswith("lerc") else highest == pytest.approx(655.35)
    assert checked(tmp_path / "out").findings == []


def test_bytes_that_cannot_be_decoded_although_their_digest_is_right(survey: Path) -> None:
    replace_bytes(survey, "imagery", BlockAddress(0, 1, 1), b"not a picture at all")
    assert checked(survey, Checks(decode=False)).findings == []
    found = only(checked(survey))
    assert (found.kind, found.place) == ("undecodable", "imagery/0/1/1")


def test_a_valid_sample_that_is_no_number(heights: Path, tmp_path: Path) -> None:
    build_layer(heights, tmp_path / "out", settings(codec="raw"))
    change_samples(tmp_path / "out", "height", BlockAddress(0, 0, 0), lambda samples, mask: samples.__setitem__((3, 3), np.nan))
    assert "not a finite number" in only(checked(tmp_path / "out")).what


def test_a_codec_that_nobody_knows_does_not_stop_the_rest(survey: Path) -> None:
    edit_layer(survey, "height", codec="wavelet:9")
    block_path(survey, "height", BlockAddress(0, 0, 0)).unlink()
    block_path(survey, "imagery", BlockAddress(0, 0, 0)).unlink()
    report = checked(survey)
    assert places(report) == [("codec", "height"), ("missing", "height/0/0/0"), ("missing", "imagery/0/0/0")]
    assert [layer.decoded for layer in report.layers] == [False, True]


def test_a_codec_that_is_not_as_the_manifest_says(survey: Path) -> None:
    edit_layer(survey, "height", max_error=0.5)
    assert "max_error is 0.5, but that of codec lerc:0 is 0.0" in only(checked(survey, Checks())).what


def test_a_block_that_cannot_be_read(survey: Path) -> None:
    broken = block_path(survey, "height", BlockAddress(0, 1, 0))

    class FailingStore(DirectoryStore):
        def read(self, key: str) -> bytes:
            if key.endswith(broken.name):
                raise StorageError(f"{survey}/{key}: cannot be read: Input/output error")
            return super().read(key)

    found = only(verify(Dataset(FailingStore(survey), manifest_of(survey)), checks=SEAMS))
    assert (found.kind, found.what) == ("unreadable", "cannot be read: Input/output error")


def test_only_the_layers_asked_for(survey: Path) -> None:
    block_path(survey, "height", BlockAddress(0, 0, 0)).unlink()
    assert verify(open_dataset(survey), ["imagery"]).findings == []
    with pytest.raises(NotFoundError, match="no layer 'light' in the dataset; it has height, imagery"):
        verify(open_dataset(survey), ["light"])


def test_seams_need_decoding(survey: Path) -> None:
    with pytest.raises(UsageError, match="leave out one of them"):
        checked(survey, Checks(decode=False, seams=True))


def test_a_dataset_that_is_rebuilt_meanwhile(survey: Path, heights: Path) -> None:
    dataset = open_dataset(survey)
    build_layer(heights, survey, settings(block=16, overwrite=True))
    with pytest.raises(StorageError, match="was rebuilt while it was checked"):
        verify(dataset)


def test_progress_reaches_the_end(built: Path) -> None:
    seen: list[tuple[int, int]] = []
    report = verify(open_dataset(built), on_progress=lambda done, total: seen.append((done, total)))
    total = sum(layer.blocks for layer in report.layers)
    assert [done for done, _ in seen] == sorted({done for done, _ in seen})
    assert seen[-1] == (total, total)
