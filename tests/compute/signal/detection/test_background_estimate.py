"""Background and noise of scans from a few pixels, whatever peaks and slopes they have."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from compute.signal.centroid_settings import sample_starts
from compute.signal.detection.background_estimate import (
    GROUP_DOF,
    MIN_VARIANCE,
    SQUARES_UNIT,
    estimate_background,
    lowest_squares_mean,
    variance_dof,
)
from tests.compute.signal.synthetic_scans import gaussian_counts

SIGMA = 20.0


def noise(lines: int, pixels: int, seed: int = 1) -> np.ndarray:
    values = np.random.default_rng(seed).normal(1000.0, SIGMA, (lines, pixels))
    return np.rint(values).astype(np.uint16)


@settings(max_examples=25)
@given(pixels=st.integers(64, 700), seed=st.integers(0, 2**32 - 1))
def test_whole_numbers_of_the_definition(pixels: int, seed: int) -> None:
    lines = np.random.default_rng(seed).integers(0, 65536, (3, pixels)).astype(np.uint16)
    spread = estimate_background(lines)
    starts = sample_starts(pixels)
    for number, line in enumerate(lines):
        squares, means = [], []
        for start in starts:
            group = line[start : start + 8].astype(np.float64)
            k = np.arange(8.0)
            rest = group - np.polyval(np.polyfit(k, group, 1), k)
            squares.append(float((rest**2).sum()))
            means.append(group.mean())
        lower = sorted(squares)[: len(starts) // 2]
        assert spread.squares[number] / SQUARES_UNIT == pytest.approx(sum(lower), rel=1e-9)
        assert spread.background[number] == sorted(means)[(len(starts) - 1) // 4] * 64


@pytest.mark.parametrize("pixels", [64, 130, 512, 2048])
def test_the_variance_is_unbiased_and_as_uncertain_as_stated(pixels: int) -> None:
    lines = 10000
    spread = estimate_background(noise(lines, pixels))
    ratio = spread.variance() / (SIGMA**2 + 1.0 / 12.0)
    stated = np.sqrt(2.0 / variance_dof(spread.groups))
    # 4.5 standard errors; the spread's own to 1/n of the formula for many groups.
    assert abs(ratio.mean() - 1.0) < 4.5 * stated / np.sqrt(lines)
    assert ratio.std() == pytest.approx(stated, rel=0.5 / spread.groups + 4.5 / np.sqrt(lines))


def test_the_mean_of_the_lower_half_by_draws() -> None:
    draws = np.sort(chi2.rvs(GROUP_DOF, size=(200_000, 8), random_state=3), axis=1)[:, :4].sum(
        axis=1
    )
    error = float(draws.std()) / np.sqrt(len(draws))
    assert lowest_squares_mean(8, 4) == pytest.approx(draws.mean(), abs=4.5 * error)


def test_a_slope_of_the_background_is_no_noise() -> None:
    lines = noise(200, 2048)
    sloped = lines + (np.arange(2048) * 7).astype(np.uint16)
    np.testing.assert_array_equal(
        estimate_background(sloped).squares, estimate_background(lines).squares
    )


def test_what_peaks_in_the_line_add() -> None:
    """Prints the deviation's bias by the share of the groups that lie on peaks."""
    lines = noise(1500, 2048)
    for peaks in (3, 8, 12):
        bright = lines.astype(np.float64)
        for at in np.array(sample_starts(2048))[:: 32 // peaks][:peaks] + 3.3:
            bright += gaussian_counts(2048, at, 2.0, 20000.0)
        variance = estimate_background(bright.astype(np.uint16)).variance() / (
            SIGMA**2 + 1.0 / 12.0
        )
        print(f"{peaks} of 32 groups: deviation {100 * np.sqrt(variance.mean()) - 100:+.1f} %")
        # The lowest 16 of those that are left.
        expected = lowest_squares_mean(32 - peaks, 16) / lowest_squares_mean(32, 16)
        standard = variance.std() / np.sqrt(len(lines))
        assert variance.mean() == pytest.approx(expected, abs=4.5 * standard)


@pytest.mark.parametrize("level", [0, 1000, 65535])
def test_a_constant_line_has_the_least_variance(level: int) -> None:
    spread = estimate_background(np.full((1, 100), level, np.uint16))
    assert spread.variance()[0] == MIN_VARIANCE
    assert spread.background[0] == 64 * level
