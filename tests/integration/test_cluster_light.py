"""Light on a real Dask cluster: the bytes of a local build, whoever is killed, and nothing left of the copy that workers read."""

import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from schemas.errors import StorageError
from schemas.settings import BuildSettings, LightSettings
from tests.integration.dask_cluster import Cluster, two_workers, wait_until
from tests.integration.files import tree_digest
from tests.integration.lighting import plain_tiff, rough
from tiler.building.build import build_layer
from tiler.building.light import build_light
from tiler.cluster.engine import DaskEngine
from tiler.stores.dataset import open_dataset

if TYPE_CHECKING:
    from tests.s3 import S3Server

pytest.importorskip("distributed", reason="the extra 'dask' is not installed: pip install 'clipmap[dev]'")

SIDE = 400
OPTIONS: dict[str, Any] = {"shadows": "soft", "sky": 4, "bounce": True, "task": 64, "codec": "png"}
TASKS = 49 + 16 + 4 + 1 + 1
"""Of 400 x 400 samples in blocks of 32 and tasks of 64: a level a task."""
COMMAND = ["--sun", "215,12", "--soft", "--sky", "4", "--bounce", "--task", "64"]


def heights() -> Any:
    found = rough(SIDE)
    found[100:140, 300:330] = np.nan
    return found


def store_heights(folder: Path, place: str, values: Any, **options: Any) -> str:
    source = plain_tiff(folder / "dem.tif", values)
    build_layer(source, place, BuildSettings(layer="height", codec="raw", block=32, spacing=30.0, **options))
    return place


def light(place: str, engine: DaskEngine | None = None, **options: Any) -> Any:
    return build_light(place, LightSettings(azimuth_deg=215, elevation_deg=12, **{**OPTIONS, **options}), engine=engine)


def records(out: Path) -> int:
    return len(list(out.glob("light/tasks/*/*/*.json")))


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Iterator[Cluster]:
    with two_workers(tmp_path_factory.mktemp("cluster"), request) as running:
        yield running


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a build on this machine's threads makes of the light."""
    folder = tmp_path_factory.mktemp("local")
    light(store_heights(folder, str(folder / "out"), heights()))
    return folder / "out"


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    return Path(store_heights(tmp_path, str(tmp_path / "out"), heights()))


def contents(out: Path) -> dict[str, str]:
    """All task records: what a task read, and what it made."""
    found = {path.relative_to(out).as_posix(): path.read_text() for path in sorted(out.glob("light/tasks/*/*/*.json"))}
    assert len(found) == TASKS
    return found


def test_the_cluster_makes_the_same_bytes(cluster: Cluster, dataset: Path, local: Path) -> None:
    """Blocks, indexes, manifest and task records; and the copy that the workers read is gone."""
    with DaskEngine(cluster.address) as engine:
        report = light(str(dataset), engine)
    assert (report.build.outcome, report.build.tasks, report.build.tasks_kept) == ("built", TASKS, 0)
    assert tree_digest(dataset) == tree_digest(local)
    assert contents(dataset) == contents(local), "digests of what was read are those of light that was not copied"
    assert report.stages_s.keys() == {"heights", "sun", "sky", "bounce", "copy"}
    assert not (dataset / "light/tasks/samples").exists()
    assert not list(dataset.glob("**/tasks/job"))


@pytest.mark.parametrize(
    "options",
    [
        {"shadows": "hard", "sky": 0, "bounce": False, "codec": "exr:float"},
        {"shadows": "none", "bits": 16},
        {"shadows": "certified", "sky": 0, "density": 2, "task": 256},
    ],
)
def test_other_kinds_of_light(cluster: Cluster, dataset: Path, tmp_path: Path, options: dict[str, Any]) -> None:
    """Floats with their voids in a mask, 16 bits with alpha, twice as fine; several layers one after the other with one engine."""
    with DaskEngine(cluster.address) as engine:
        for number in (1, 2):
            light(str(dataset), engine, **options, layer=f"light_{number}")
    here = store_heights(tmp_path, str(tmp_path / "here"), heights())
    for number in (1, 2):
        light(here, **options, layer=f"light_{number}")
    assert tree_digest(dataset) == tree_digest(Path(here))


def test_an_update_on_the_cluster(cluster: Cluster, dataset: Path, tmp_path: Path) -> None:
    options: dict[str, Any] = {"shadows": "hard", "sky": 0, "bounce": False}
    light(str(dataset), **options)
    values = heights()
    values[60, 250] += 1500
    store_heights(tmp_path, str(dataset), values, update=True)
    with DaskEngine(cluster.address) as engine:
        report = light(str(dataset), engine, update=True, **options)
        again = light(str(dataset), engine, update=True, **options)
    assert (report.build.outcome, again.build.outcome) == ("updated", "up to date")
    assert 0 < report.build.blocks_written < 60
    fresh = store_heights(tmp_path, str(tmp_path / "fresh"), values)
    light(fresh, **options)
    updated, full = open_dataset(dataset), open_dataset(fresh)
    lattice = full.manifest.layer("light").lattice
    for address in (address for level in range(lattice.levels) for address in lattice.addresses(level)):
        assert updated.block("light", address) == full.block("light", address)
    assert not list(dataset.glob("light.2/tasks*"))


def test_a_store_by_url(cluster: Cluster, s3: "S3Server", local: Path, tmp_path: Path) -> None:
    place = store_heights(tmp_path, s3.url(tmp_path), heights())
    with DaskEngine(cluster.address) as engine:
        light(place, engine)
    here, there = open_dataset(local), open_dataset(place)
    assert there.manifest == here.manifest
    lattice = here.manifest.layer("light").lattice
    for address in (address for level in range(lattice.levels) for address in lattice.addresses(level)):
        assert there.block("light", address) == here.block("light", address)
    assert not there.store.keys("light/tasks/samples")


def test_a_killed_worker_is_replaced(cluster: Cluster, dataset: Path, local: Path) -> None:
    first = cluster.workers[-2]

    def kill() -> None:
        wait_until(lambda: records(dataset) > 20)
        cluster.add_worker()
        first.kill()

    killer = threading.Thread(target=kill)
    killer.start()
    notices = list[str]()
    with DaskEngine(cluster.address, notices.append) as engine:
        report = light(str(dataset), engine)
    killer.join()
    assert report.build.tasks == TASKS
    assert tree_digest(dataset) == tree_digest(local)
    assert not list(dataset.rglob(".tmp-*"))


def run(dataset: Path, *arguments: str) -> "subprocess.Popen[str]":
    command = [sys.executable, "-c", "from cli.main import main; main()", "light", str(dataset), *COMMAND, *arguments]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    )


def kill_one(cluster: Cluster, dataset: Path) -> None:
    """Leave what a build on the cluster leaves that is killed once it has some task records."""
    killed = run(dataset, "--engine", "dask", "--scheduler", cluster.address)
    wait_until(lambda: records(dataset) > 10)
    killed.send_signal(signal.SIGKILL)
    killed.communicate()
    assert killed.returncode == -9


@pytest.mark.parametrize("engine", ["dask", "local"])
def test_a_killed_build_goes_on(cluster: Cluster, dataset: Path, local: Path, engine: str) -> None:
    """With the copy that is there, on the cluster; or without it, on this machine, which also clears it away."""
    kill_one(cluster, dataset)
    assert (dataset / "light/tasks/samples/whole").exists()
    rerun = run(dataset, *(["--engine", "dask", "--scheduler", cluster.address] if engine == "dask" else []))
    said, errors = rerun.communicate(timeout=120)
    assert rerun.returncode == 0, errors
    kept = re.search(rf"went on with .*: (\d+) of {TASKS} tasks were finished", errors)
    assert kept is not None, said + errors
    assert int(kept[1]) > 10
    assert ("heights" in said) == (engine == "local"), "what was found out before is not found out again"
    assert tree_digest(dataset) == tree_digest(local)


@pytest.mark.parametrize("harm", ["a piece is gone", "a piece is damaged", "of other heights"])
def test_a_copy_that_does_not_hold_is_made_again(cluster: Cluster, dataset: Path, local: Path, harm: str) -> None:
    kill_one(cluster, dataset)
    copy = dataset / "light/tasks/samples"
    match harm:
        case "a piece is gone":
            (copy / "256/0").unlink()
        case "a piece is damaged":
            data = bytearray((copy / "0/0").read_bytes())
            data[200] ^= 1
            (copy / "0/0").write_bytes(data)
        case _:
            (copy / "whole").write_text("0" * 32)
    with DaskEngine(cluster.address) as engine:
        report = light(str(dataset), engine)
    assert "sun" in report.stages_s
    assert tree_digest(dataset) == tree_digest(local)


def test_a_copy_that_vanishes_is_a_sentence(cluster: Cluster, dataset: Path) -> None:
    class Meddler(DaskEngine):
        def run(self, worker: Any, works: Any) -> Any:
            (dataset / "light/tasks/samples/0/0").unlink(missing_ok=True)
            return super().run(worker, works)

    with pytest.raises(StorageError, match=r"light/tasks/samples/0/0 is damaged or gone.*; give the same command again"):  # noqa: SIM117
        with Meddler(cluster.address) as engine:
            light(str(dataset), engine)
    assert open_dataset(dataset).manifest.layers.keys() == {"height"}


def test_options_that_need_each_other(capsys: pytest.CaptureFixture[str]) -> None:
    from cli.main import run as run_command

    assert run_command(["light", "out", "--sun", "270,10", "--engine", "dask"]) == 2
    assert "--engine dask needs the address of the scheduler" in capsys.readouterr().err
