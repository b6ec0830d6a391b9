import errno
import json
from pathlib import Path

import imagecodecs
import moderngl
import numpy as np
import pytest

from cli.commands import view
from cli.main import run
from schemas.errors import StorageError
from tests.viewer.scenes import rough
from tests.viewer.writer import LayerSpec, write_dataset
from viewer.gl import headless

PLACE = (30.0, 0.0, 1000.0, 0.0, -30.0, 5000.0)


@pytest.fixture
def dataset(tmp_path: Path, context: moderngl.Context) -> Path:
    y, x = np.mgrid[0:65, 0:65]
    z = np.maximum(0, 500 - 20 * np.hypot(x - 40, y - 30)) + rough(x, y, 0) * 0.1
    colours = np.random.default_rng(0).integers(60, 200, (64, 64, 3), np.uint8)
    root = tmp_path / "hills"
    write_dataset(
        root, [LayerSpec("height", "height", z, PLACE, ground_spacing_m=(30.0, 30.0)), LayerSpec("imagery", "imagery", colours, PLACE)]
    )
    return root


def test_a_picture_is_written_and_reported(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "hills.png"
    assert run(["view", str(dataset), "--headless", "--out", str(out), "--size", "160x90", "--grid", "63", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["width"], report["height"]) == (160, 90)
    assert report["pictures"][0]["path"] == str(out)
    assert report["pictures"][0]["triangles"] > 1000
    assert report["blocks"] > 10
    assert report["renderer"]
    assert [(one["name"], one["runs"]) for one in report["pictures"][0]["effects"]] == [
        ("haze", False),
        ("curvature", False),
        ("geomorph", True),
    ]
    picture = imagecodecs.png_decode(out.read_bytes())
    assert picture.shape == (90, 160, 3)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 200
    again = tmp_path / "again.png"
    assert (
        run(["view", str(dataset), "--out", str(again), "--size", "160x90", "--grid", "63", f"--view={report['pictures'][0]['view']}"]) == 0
    )
    text = capsys.readouterr().out
    assert "triangles" in text
    assert "haze       left out: not asked for\n" in text
    assert "curvature  left out: it moves ground by up to " in text
    assert f"--view={report['pictures'][0]['view']}" in text
    difference = np.abs(imagecodecs.png_decode(again.read_bytes()).astype(int) - picture)
    assert np.median(difference) <= 1


def test_every_option_changes_the_picture(dataset: Path, tmp_path: Path) -> None:
    options: list[list[str]] = [
        [], ["--no-light"], ["--sun", "90,20"], ["--haze", "1"], ["--exaggeration", "2"], ["--fov", "70"], ["--wireframe"],
        ["--color-by-level"], ["--look-at", "1900,4000"], ["--samples", "0"], ["--imagery", "imagery", "--view", "2000,3000,600,0,-20"],
    ]  # fmt: skip
    pictures = []
    for number, extra in enumerate(options):
        out = tmp_path / f"{number}.png"
        assert run(["view", str(dataset), "--out", str(out), "--size", "128x72", "--grid", "63", *extra]) == 0
        pictures.append(out.read_bytes())
    assert len(set(pictures)) == len(pictures)


def test_frames_go_round(dataset: Path, tmp_path: Path) -> None:
    assert run(["view", str(dataset), "--out", str(tmp_path / "f_%02d.png"), "--frames", "3", "--size", "64x48", "--grid", "63"]) == 0
    assert len({(tmp_path / f"f_0{number}.png").read_bytes() for number in range(3)}) == 3


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["--size", "big"], 2, "expected WIDTHxHEIGHT"),
        (["--size", "8x8"], 2, "from 16 to 16384"),
        (["--view", "1,2,3"], 2, "expected numbers X,Y,Z,YAW,PITCH"),
        (["--view", "1,2,3,4,nan"], 2, "expected numbers"),
        (["--view", "1,2,3,4,5", "--look-at", "1,2"], 2, "give one of them"),
        (["--sun", "0,100"], 2, "from -90 to 90"),
        (["--view", "1e300,0,1000,0,-30"], 2, "1e+300,0: more than a million times as far away"),
        (["--view", "0,0,1e300,0,-90"], 2, "view height 1e+300 m: more than a million times"),
        (["--look-at", "-1e308,1e308"], 2, "-1e+308,1e+308: more than a million times"),
        (["--exaggeration", "0"], 2, "greater than 0"),
        (["--haze", "-1"], 2, "positive distance"),
        (["--samples", "64"], 2, "at most"),
        (["--out", "x.jpg"], 2, "ends in .png"),
        (["--size", "9" * 5000 + "x100"], 2, "expected WIDTHxHEIGHT"),
        (["--out", "x_%s.png", "--frames", "2"], 2, "give it once, as %d or %04d"),
        (["--height", "imagery"], 2, "is of kind imagery, not height"),
        (["--imagery", "nothing"], 3, "no layer 'nothing'"),
        (["--out", "/nowhere/x.png"], 4, "cannot be written"),
    ],
)
def test_mistakes_end_in_a_sentence(dataset: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], code: int, words: str) -> None:
    assert run(["view", str(dataset), "--headless", *arguments]) == code
    message = capsys.readouterr().err
    assert words in message
    assert "Traceback" not in message


def test_a_damaged_block_ends_in_a_sentence(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    victim = next((dataset / "height" / "0").glob("*.raw"))
    for block in victim.parent.glob("*.raw"):
        block.write_bytes(b"short")
    assert run(["view", str(dataset), "--out", str(tmp_path / "x.png"), "--size", "64x48"]) == 3
    assert capsys.readouterr().err.startswith("clipmap: ")
    for block in victim.parent.glob("*.raw"):
        block.unlink()
    assert run(["view", str(dataset), "--out", str(tmp_path / "x.png"), "--size", "64x48"]) == 3
    assert "rebuild the layer" in capsys.readouterr().err
    assert not (tmp_path / "x.png").exists()


def test_what_does_not_exist_ends_in_a_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["view", str(tmp_path / "nothing")]) == 3
    assert "no such directory" in capsys.readouterr().err


def test_area_registered_heights_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_dataset(tmp_path / "d", [LayerSpec("height", "height", np.zeros((20, 20), np.float32), PLACE, registration="area")])
    assert run(["view", str(tmp_path / "d"), "--out", str(tmp_path / "x.png")]) == 2
    assert "only point-registered heights" in capsys.readouterr().err


def test_a_machine_without_opengl_is_told_what_to_install(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(**_: object) -> None:
        raise OSError("libEGL.so: cannot open shared object file")

    monkeypatch.setattr(moderngl, "create_context", fail)
    assert run(["view", str(dataset), "--out", str(tmp_path / "x.png")]) == 2
    assert "libegl1 and libgl1-mesa-dri" in capsys.readouterr().err


def test_a_missing_moderngl_is_told_how_to_get(dataset: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    assert run(["view", str(dataset), "--headless"]) == 2
    assert "pip install 'clipmap[view]'" in capsys.readouterr().err


@pytest.mark.parametrize(
    "name",
    ["%s.png", "%x.png", "%.png", "50%.png", "%%d.png", "%d_%d.png", "%4d.png", "%-3d.png", "%0999999999d.png", "%(a)d.png", "%20s.png"],
)
@pytest.mark.parametrize("frames", [1, 3])
def test_only_numbers_have_a_place_in_names(
    name: str, frames: int, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """2026-11-22: %x, %20s and the like were taken, and an impossible width ended in a MemoryError after the dataset was loaded."""
    monkeypatch.setattr("viewer.source.open_source", lambda *_: pytest.fail("the dataset was opened"))
    assert run(["view", str(tmp_path), "--out", str(tmp_path / name), "--frames", str(frames)]) == 2
    assert "a % in the name marks the place of the frame's number; give it once, as %d or %04d" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_frames_without_a_place_are_numbered_at_the_end() -> None:
    """2026-11-22: they were refused once everything was loaded."""
    assert headless.frame_paths(Path("a%s/b.c.PNG"), 2) == [Path("a%s/b.c_0000.PNG"), Path("a%s/b.c_0001.PNG")]
    assert headless.frame_paths(Path("%d.png"), 11)[10] == Path("10.png")
    assert headless.frame_paths(Path("b_%010d.png"), 1) == [Path("b_0000000000.png")]


@pytest.mark.parametrize(
    ("dataset", "name"), [("a/b/", "b.png"), ("http://h/my%20set", "my_20set.png"), ("/", "view.png"), ("50%d", "50_d.png")]
)
def test_pictures_are_called_after_the_dataset(dataset: str, name: str) -> None:
    """2026-11-22: a % in a URL was taken for the place of a frame's number."""
    assert view._default_name(dataset) == name


def test_a_picture_appears_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """2026-11-22: a full disk left half a picture where a whole one had been."""
    out, pixels = tmp_path / "x.png", np.zeros((4, 4, 3), np.uint8)
    headless.write_png(out, pixels)
    whole = out.read_bytes()
    put = Path.write_bytes

    def full(path: Path, data: bytes) -> int:
        put(path, data[:20])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(StorageError, match=r"x\.png: cannot be written: No space left on device"):
        headless.write_png(out, pixels + 1)
    monkeypatch.setattr(Path, "write_bytes", put)

    def interrupted(*_: Path) -> Path:
        assert [path.parent for path in tmp_path.iterdir()] == [tmp_path, tmp_path]
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        headless.write_png(out, pixels + 1)
    assert out.read_bytes() == whole
    assert [path.name for path in tmp_path.iterdir()] == ["x.png"]


def test_a_rebuilt_or_confused_dataset_ends_in_a_sentence(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """2026-11-22: a block copied over another of the same layer was drawn where it does not belong."""
    finest = sorted((dataset / "height" / "0").glob("*.raw"))
    for block in finest[1:]:
        block.write_bytes(finest[0].read_bytes())
    assert run(["view", str(dataset), "--out", str(tmp_path / "x.png"), "--size", "64x48"]) == 3
    message = capsys.readouterr().err
    assert "holds other bytes than the index says" in message
    assert "height-0-" in message
    assert message.count("\n") == 1


@pytest.mark.parametrize("step", [1e308, 1e-320])
@pytest.mark.parametrize("spacing", [None, (30.0, 30.0)])
def test_an_absurd_spacing_ends_in_a_sentence(
    step: float, spacing: tuple[float, float] | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """2026-11-22: LinAlgError and ZeroDivisionError."""
    place = (step, 0.0, 0.0, 0.0, -step, 0.0)
    write_dataset(tmp_path / "d", [LayerSpec("height", "height", np.zeros((20, 20), np.float32), place, ground_spacing_m=spacing)])
    assert run(["view", str(tmp_path / "d"), "--out", str(tmp_path / "x.png")]) == 3
    message = capsys.readouterr().err
    assert "world units apart, which cannot be drawn" in message
    assert message.count("\n") == 1


def test_pictures_are_numbered() -> None:
    assert headless.frame_paths(Path("a/b_%03d.png"), 2) == [Path("a/b_000.png"), Path("a/b_001.png")]
    assert headless.frame_paths(Path("b.png"), 1) == [Path("b.png")]
