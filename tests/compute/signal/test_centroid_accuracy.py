"""How good the positions are, and whether their standard deviations say so."""

import numpy as np
import pytest

from compute.signal.centroid_finder import CentroidFinder
from compute.signal.centroid_settings import CentroidSettings
from tests.compute.signal.synthetic_scans import (
    GAIN,
    NOISE,
    OFFSET,
    READ,
    gaussian_counts,
    measured,
)

LINES, PIXELS = 4000, 128


def errors(width_px, height, weighting="edge-corrected", seed=0):
    """Errors and standard deviations of peaks at all positions within a pixel."""
    rng = np.random.default_rng(seed)
    position = 60.0 + rng.uniform(0.0, 4.0, LINES)
    lines = measured(gaussian_counts(PIXELS, position, width_px, height), rng)
    options = CentroidSettings(weighting=weighting)
    found = CentroidFinder(LINES, PIXELS, options, NOISE, "cpu").find(lines)
    assert (found.count == 1).all()
    return found.position_px[:, 0] - position, found.sigma_px[:, 0]


@pytest.mark.parametrize("width_px", [1.5, 2.0, 3.0, 5.0])
@pytest.mark.parametrize("height", [100.0, 1000.0])
def test_standard_deviations_are_honest(width_px, height):
    # The mean of 4000 squared normal deviates is 1 +- 0.022; the noise model's first order and
    # the error within a pixel are worth the rest.
    error, sigma = errors(width_px, height)
    assert 0.85 < np.mean((error / sigma) ** 2) < 1.15
    assert abs(np.mean(error)) < 5 * sigma.mean() / np.sqrt(LINES)


@pytest.mark.parametrize("weighting", ["edge-corrected", "above-threshold", "above-background"])
def test_standard_deviations_of_bright_peaks_hold_on_average_over_widths(weighting):
    # There the error within a pixel rules, which depends on where the widths put the run's ends.
    squares = []
    for width_px in np.arange(1.0, 4.0, 0.25):
        error, sigma = errors(width_px, 30000.0, weighting)
        squares.append(np.mean((error / sigma) ** 2))
    assert 0.7 < np.mean(squares) < 1.4
    assert np.max(squares) < 2.5


def test_error_within_a_pixel_is_what_the_settings_say():
    # Without noise: what is left is the position within the pixel. CentroidSettings quotes these.
    position = 60.0 + np.arange(0.0, 1.0, 0.01)
    worst = {"edge-corrected": 0.0, "above-threshold": 0.0, "above-background": 0.0}
    for width_px in np.arange(1.0, 3.01, 0.1):
        counts = gaussian_counts(PIXELS, position, width_px, 60000.0)
        lines = np.rint(counts + OFFSET).astype(np.uint16)
        for weighting in worst:
            options = CentroidSettings(weighting=weighting)
            finder = CentroidFinder(len(lines), PIXELS, options, NOISE, "cpu")
            error = finder.find(lines).position_px[:, 0] - position
            worst[weighting] = max(worst[weighting], np.sqrt(np.mean(error**2)))
    assert worst["edge-corrected"] < 0.01 < worst["above-threshold"] < 0.04
    assert 0.1 < worst["above-background"] < 0.14


def test_the_default_comes_near_the_best_that_the_light_allows():
    # Cramer-Rao: I = sum (dmu/dx)^2 / variance. The pixels below a third are not used.
    width_px, height = 2.0, 1000.0
    step = 1e-4
    slope = (
        gaussian_counts(PIXELS, 64.3 + step, width_px, height)
        - gaussian_counts(PIXELS, 64.3 - step, width_px, height)
    ) / (2 * step)
    mean = gaussian_counts(PIXELS, 64.3, width_px, height) + 20.0
    bound = 1 / np.sqrt((slope**2 / (mean / GAIN + (READ / GAIN) ** 2 + 1 / 12)).sum())
    error, _ = errors(width_px, height)
    assert bound < np.std(error) < 1.4 * bound


def test_empty_lines_yield_no_peaks():
    # 33 million pixels of ambient light and noise; by chance one in 10^9 is 6 sigma up.
    rng = np.random.default_rng(3)
    finder = CentroidFinder(1000, 2048, CentroidSettings(), NOISE, "cpu")
    block = measured(np.full((1000, 2048), 30.0), rng)
    for _ in range(16):
        assert finder.find(block).count.sum() == 0
        # Rows of the same noise at other places are other lines to the finder.
        block = rng.permuted(block, axis=1, out=block)


def test_faint_peaks_are_found_and_bright_ones_have_no_companions():
    rng = np.random.default_rng(4)
    finder = CentroidFinder(2000, 256, CentroidSettings(), NOISE, "cpu")
    position = rng.uniform(100.0, 150.0, 2000)
    # Noise of an empty pixel: 2.5 counts. Twelve times that is found, three times is not.
    for height, share in ((30.0, (0.999, 1.0)), (7.5, (0.0, 0.02))):
        found = finder.find(measured(gaussian_counts(256, position, 2.0, height), rng))
        assert share[0] <= np.mean(found.count == 1) <= share[1]
    for height in (300.0, 3000.0, 30000.0):
        found = finder.find(measured(gaussian_counts(256, position, 2.0, height), rng))
        assert (found.count == 1).all()
