"""What planning saves: nothing is seen of it, a plain needs next to nothing, and the report says what was found."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from cli.main import run
from tiler.accuracy.light_planner import (
    HEADER,
    PlannerResult,
    built_in_scenes,
    measure_planner,
    planner_cells,
    planner_findings,
    planner_plot,
    planner_rows,
    planner_scenes,
    planner_section,
)
from tiler.accuracy.lightground import ground_of
from tiler.accuracy.sample import Sample, built_in


@pytest.fixture(scope="module")
def results() -> list[PlannerResult]:
    return measure_planner(built_in_scenes(96), 1)


def test_the_built_in_scenes_are_what_they_say() -> None:
    mountains, island, lidar, plain = (scene.ground for scene in built_in_scenes(128))
    assert mountains.cell_m == (90.0, 90.0)
    assert (island.heights_m == 0).mean() > 0.1
    trees = lidar.heights_m - mountains.heights_m / 90
    assert 0 < (trees > 11).mean() < 0.01
    assert plain.relief_m == pytest.approx(20, rel=1e-3)
    assert {ground.heights_m.shape for ground in (mountains, island, lidar, plain)} == {(129, 129)}
    assert max(built_in_scenes(4096)[0].ground.heights_m.shape) == 1025, "four scenes are not to take minutes"


def test_nothing_is_seen_of_what_is_left_out(results: list[PlannerResult]) -> None:
    for one in results:
        assert one.difference_codes <= one.tolerance_codes
        assert one.bound_codes <= one.tolerance_codes
        assert (one.difference_codes == 0) == (one.left_out == ())
        assert 0 < one.planning_s < one.planned_s
    mountains, *_, plain = results
    assert mountains.left_out == ()
    assert {"shadow", "penumbra", "sky", "bounce"} <= set(plain.left_out)
    assert plain.difference_codes < plain.bound_codes + 0.02


def test_what_is_said_is_what_was_found(results: list[PlannerResult], tmp_path: Path) -> None:
    said = planner_findings(results)
    assert "nothing can be left out, and no sample differs." in said[0]
    assert "left out are shadow, penumbra, sky, bounce" in said[-1]
    section = planner_section(results)
    assert all(f"<td>{one.scene}</td>" in section for one in results)
    assert {len(planner_cells(one)) for one in results} == {len(HEADER)}
    rows = json.loads(json.dumps(planner_rows(results), allow_nan=False))
    assert [row["scene"] for row in rows] == [one.scene for one in results]
    pytest.importorskip("matplotlib")
    planner_plot(results, tmp_path / "planner.svg")
    assert (tmp_path / "planner.svg").stat().st_size > 5000


def test_what_was_given_is_planned_as_well() -> None:
    sample = Sample("alps.tif", "height", np.zeros((97, 97, 1), np.float32))
    names = [scene.name for scene in planner_scenes(sample, ground_of(sample))]
    assert names[:2] == ["alps.tif", "alps.tif"]
    assert len(names) == 6
    own = built_in(96)
    assert len(planner_scenes(own, ground_of(own))) == 4


def test_the_report_has_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    assert run(["accuracy", "--light", "--crop", "96", "--runs", "1", "-o", str(tmp_path / "report")]) == 0
    assert "Planning, a plain of 20 m relief at 160 m" in capsys.readouterr().out
    page = (tmp_path / "report" / "index.html").read_text()
    assert "<h2>What planning saves</h2>" in page
    assert (tmp_path / "report" / "planner.svg").exists()
    with (tmp_path / "report" / "planner.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 4
