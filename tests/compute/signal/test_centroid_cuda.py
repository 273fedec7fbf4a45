"""The kernel on CUDA against the reference; needs a CUDA device, and no plugin of pytest."""

import numpy as np
import pytest

from compute.signal.centroid_finder import CentroidFinder
from compute.signal.centroid_reference import find_peaks_reference
from compute.signal.centroid_settings import CentroidSettings
from compute.signal.sensor_noise import SensorNoise
from tests.compute.signal.synthetic_scans import NOISE, assert_same, varied_lines


@pytest.fixture(scope="module")
def device():
    import warp as wp

    if not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    return "cuda:0"


@pytest.mark.parametrize("pixels", [64, 65, 127, 300, 1023, 2048, 4096, 4097, 8192, 8193, 16384])
@pytest.mark.parametrize("weighting", ["edge-corrected", "above-threshold", "above-background"])
def test_matches_the_reference(device, pixels, weighting):
    lines = varied_lines(96, pixels, np.random.default_rng(pixels))
    options = CentroidSettings(weighting=weighting, max_peaks=5)
    expected = find_peaks_reference(lines, options, NOISE)
    assert expected.count.max() == 5
    found = CentroidFinder(len(lines), pixels, options, NOISE, device).find(lines)
    assert_same(found, expected)


@pytest.mark.parametrize("seed", range(12))
def test_matches_the_reference_with_any_settings(device, seed):
    rng = np.random.default_rng(seed)
    lines = varied_lines(64, int(rng.integers(64, 3000)), rng)
    options = CentroidSettings(
        threshold_fraction=rng.uniform(0.05, 0.95),
        detection_sigma=rng.uniform(3, 20),
        min_width_px=int(rng.integers(1, 4)),
        max_peaks=int(rng.integers(1, 24)),
    )
    noise = SensorNoise.of(rng.uniform(0.1, 50, 3), rng.uniform(0, 50, 3), 90.0, 4095)
    found = CentroidFinder(64, lines.shape[1], options, noise, device).find(lines)
    assert_same(found, find_peaks_reference(lines, options, noise))


def test_batches_of_any_size_one_after_another(device):
    lines = varied_lines(200, 512, np.random.default_rng(5))
    options = CentroidSettings(max_peaks=4)
    expected = find_peaks_reference(lines, options, NOISE)
    finder = CentroidFinder(200, 512, options, NOISE, device)
    for count in (200, 7, 1, 0, 33, 200):
        found = finder.find(lines[:count])
        assert len(found) == count
        np.testing.assert_array_equal(found.count, expected.count[:count])
        np.testing.assert_array_equal(found.flags, expected.flags[:count])
        np.testing.assert_allclose(
            found.position_px, expected.position_px[:count], rtol=0, atol=1e-9
        )


def test_many_lines_give_the_same_each_time(device):
    lines = np.tile(varied_lines(64, 1024, np.random.default_rng(8)), (100, 1))
    finder = CentroidFinder(len(lines), 1024, CentroidSettings(), NOISE, device)
    first = finder.find(lines)
    for part in np.split(first.position_px, 100):
        np.testing.assert_array_equal(part, first.position_px[:64])
    again = finder.find(lines)
    np.testing.assert_array_equal(again.position_px, first.position_px)
    np.testing.assert_array_equal(again.sigma_px, first.sigma_px)
