"""What a user must be able to trust: real files with voids verify, and heights decoded from colour equal plain heights."""

from pathlib import Path

import numpy as np
import pytest

from schemas.settings import BuildSettings
from tests.integration.files import assemble, settings, write_tiff
from tests.reference.terrain import terrain
from tiler.building.build import build_layer
from tiler.checking.verify import Checks, verify
from tiler.stores.dataset import open_dataset


@pytest.mark.parametrize(
    ("name", "options", "valid_share"),
    [
        ("dem/mt_everest_90m.tif", {}, 0.909),
        ("dem/slovenia_lidar_nan.tif", {}, 0.9999),
        ("nasty/float_57pct_nan.tif", {}, 0.43),
        ("nasty/all_nodata.tif", {"layer": "imagery", "bands": (1, 2, 3)}, 0.0),
    ],
)
def test_real_files_with_voids_build_and_verify(
    name: str, options: dict[str, object], valid_share: float, data_dir: Path, tmp_path: Path
) -> None:
    report = build_layer(data_dir / name, tmp_path / "out", BuildSettings.model_validate({"pad": 4, **options}))
    layer = report.manifest.layers[report.layer]
    assert layer.statistics.valid / (layer.width * layer.height) == pytest.approx(valid_share, abs=0.005)
    found = verify(open_dataset(tmp_path / "out"), checks=Checks(seams=True))
    assert found.findings == []


@pytest.mark.parametrize(("encoding", "step_m"), [("terrarium", 1 / 256), ("terrain-rgb", 0.1)])
def test_decoded_heights_have_the_error_of_plain_ones(encoding: str, step_m: float, tmp_path: Path) -> None:
    """On every level the difference to the plain build is the encoding's rounding, at most half a step times the filter's gain.

    Averaging the colours instead is off by metres, or by kilometres where a channel wraps.
    """
    heights = terrain(200, 200, seed=4)[..., 0]
    code = np.rint((heights + (32768 if encoding == "terrarium" else 10000)) / step_m).astype(np.int64)
    colours = np.stack([code >> 16, code >> 8 & 255, code & 255], axis=-1).astype(np.uint8)
    build_layer(write_tiff(tmp_path / "plain.tif", heights[..., np.newaxis].astype(np.float32)), tmp_path / "plain", settings())
    build_layer(write_tiff(tmp_path / "colour.tif", colours), tmp_path / "decoded", settings(decode=encoding))
    plain, decoded = (open_dataset(tmp_path / name) for name in ("plain", "decoded"))
    for level in plain.manifest.layer("height").levels:
        (expected, valid), (found, _) = (assemble(dataset, "height", level.level) for dataset in (plain, decoded))
        assert np.abs(found - expected)[valid].max() <= step_m / 2 * 1.87**level.level + 1e-3
