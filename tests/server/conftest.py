from collections.abc import Iterator
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from schemas.address import BlockAddress
from schemas.manifest import Manifest
from schemas.settings import ServerSettings
from server.app import create_app
from tests.server.datasets import write_dataset

BLANK = BlockAddress(0, 4, 3)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A folder of datasets."""
    folder = tmp_path / "datasets"
    folder.mkdir()
    return folder


@pytest.fixture
def alps(root: Path) -> Manifest:
    """The dataset ``alps``, whose block 0/4/3 of the height layer is blank."""
    return write_dataset(root / "alps", blank=[BLANK])


@pytest.fixture
def client(root: Path, alps: Manifest) -> Iterator[TestClient]:
    with TestClient(create_app(ServerSettings(roots=(root,))), raise_server_exceptions=False, follow_redirects=False) as client:
        yield client
