"""Normals, and light between the heights, on a real Dask cluster: the bytes of a local build."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from schemas.settings import LightSettings, NormalSettings
from tests.integration.dask_cluster import Cluster
from tests.integration.files import tree_digest
from tests.integration.lighting import rough, store_heights
from tiler.building.light import build_light
from tiler.building.normals import build_normals
from tiler.cluster.engine import DaskEngine

pytest.importorskip("distributed", reason="the extra 'dask' is not installed: pip install 'clipmap[dev]'")


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    running = Cluster(tmp_path_factory.mktemp("cluster"), {})
    try:
        running.add_worker()
        yield running
    finally:
        running.stop()


def test_the_cluster_makes_the_same_bytes(cluster: Cluster, tmp_path: Path) -> None:
    """Task records too: what workers read is what this machine would have."""
    heights = rough(200)
    heights[60:90, 100:104] = np.nan
    trees, records = [], []
    for place in ("local", "cluster"):
        (tmp_path / place).mkdir()
        dataset = store_heights(tmp_path / place, heights)
        settings = NormalSettings(density=2, task=64), LightSettings(azimuth_deg=215, elevation_deg=12, density=2, task=64)
        if place == "local":
            build_normals(dataset, settings[0])
            build_light(dataset, settings[1])
        else:
            with DaskEngine(cluster.address) as engine:
                build_normals(dataset, settings[0], engine=engine)
                build_light(dataset, settings[1], engine=engine)
        assert not list(dataset.glob("*/tasks/samples"))
        trees.append(tree_digest(dataset))
        records.append({path.relative_to(dataset).as_posix(): path.read_text() for path in sorted(dataset.glob("[ln]*/tasks/*/*/*.json"))})
    assert trees[0] == trees[1]
    assert len(records[0]) > 50
    assert records[0] == records[1]
