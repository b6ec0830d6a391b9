"""The synthetic inputs are what they claim: deterministic, of the stated spectrum, of the stated shapes."""

import numpy as np
import pytest

from tests.reference.terrain import (
    adversarial_heights,
    adversarial_masks,
    checkerboard,
    coast,
    int16_extremes,
    offset_noise,
    photo,
    power_law_field,
    random_mask,
    terrain,
)


@pytest.mark.parametrize(("height", "width", "exponent"), [(64, 64, 3.0), (33, 90, 2.0), (128, 31, 4.0)])
def test_the_spectrum_is_the_power_law_itself(height: int, width: int, exponent: float) -> None:
    field = power_law_field(height, width, 3, exponent)
    power = np.abs(np.fft.fft2(field)) ** 2
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.fftfreq(width)[None, :])
    frequency[0, 0] = 1.0
    flat = power * frequency**exponent
    assert flat.ravel()[1:] == pytest.approx(flat[0, 1], rel=1e-7)
    assert field.mean() == pytest.approx(0.0, abs=1e-12)
    assert field.std() == pytest.approx(1.0)


def test_terrain_has_the_stated_mean_and_rms_and_depends_on_the_seed() -> None:
    heights = terrain(60, 80, seed=4, rms_m=250.0, mean_m=900.0)
    assert heights.shape == (60, 80, 1)
    assert heights.mean() == pytest.approx(900.0)
    assert heights.std() == pytest.approx(250.0)
    assert heights.tolist() == terrain(60, 80, seed=4, rms_m=250.0, mean_m=900.0).tolist()
    assert np.abs(heights - terrain(60, 80, seed=5, rms_m=250.0, mean_m=900.0)).max() > 100


def test_a_coast_is_part_flat_sea_part_land() -> None:
    heights = coast(64, 64)
    assert heights.min() == 0.0
    assert 0.2 < (heights == 0).mean() < 0.8


def test_a_photo_uses_the_range_of_bytes_and_is_mostly_luminance() -> None:
    image = photo(96, 128)
    assert image.shape == (96, 128, 3)
    assert image.dtype == np.uint8
    assert image.min() < 10
    assert image.max() > 230
    pixels = image.reshape(-1, 3).astype(np.float64)
    correlation = np.asarray(np.corrcoef(pixels[:, 0], pixels[:, 2]))[0, 1]
    assert 0.8 < correlation < 0.99


def test_hard_inputs_are_hard() -> None:
    assert checkerboard(3, 3, -1, 2)[:, :, 0].tolist() == [[-1, 2, -1], [2, -1, 2], [-1, 2, -1]]
    assert checkerboard(2, 4, cell=2)[:, :, 0].tolist() == [[0, 0, 1, 1], [0, 0, 1, 1]]
    assert set(int16_extremes(20, 20).ravel().tolist()) == {-32768.0, 32767.0}
    noise = offset_noise(20, 20)
    assert np.abs(noise.astype(np.float32) - noise).max() > 0.4


@pytest.mark.parametrize("name", adversarial_heights(8, 8))
def test_hard_heights_have_one_shape(name: str) -> None:
    heights = adversarial_heights(37, 50)[name]
    assert heights.shape == (37, 50, 1)
    assert heights.dtype == np.float64
    assert np.isfinite(heights).all()
    assert (np.ptp(heights) > 0) == (name != "constant")


@pytest.mark.parametrize("name", adversarial_masks(8, 8))
def test_masks_have_one_shape_and_are_neither_full_nor_empty_by_accident(name: str) -> None:
    mask = adversarial_masks(37, 50)[name]
    assert mask.shape == (37, 50)
    assert mask.dtype == np.bool_
    assert not mask.all()
    assert mask.any() == (name != "empty")
    if name.startswith("random"):
        assert mask.mean() == pytest.approx(float(name.split()[1]) / 100, abs=0.03)


def test_random_masks_repeat() -> None:
    assert random_mask(9, 9, 0.5, 3).tolist() == random_mask(9, 9, 0.5, 3).tolist()
