"""Backgrounds: a polynomial goes away exactly, peaks stay; bridges; averages."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from compute.signal.thesis_pipeline.background_subtraction import (
    InterpolatedBackground,
    PeakMask,
    PolynomialBackground,
)
from compute.signal.thesis_pipeline.filters import ButterworthFilter, FirFilter
from compute.signal.thesis_pipeline.state import average_scans
from tests.compute.signal.thesis_pipeline.pipeline_scans import compact_peak

PIXELS = 400
PEAKS = 300.0 * (compact_peak(80.3, 12.0, PIXELS) + compact_peak(250.7, 9.0, PIXELS))
polynomials = st.lists(st.floats(-200.0, 200.0), min_size=1, max_size=6)


def values_of(coefficients: list[float]) -> np.ndarray:
    return 500.0 + np.polynomial.chebyshev.chebval(np.linspace(-1.0, 1.0, PIXELS), coefficients)


@settings(max_examples=40, deadline=None)
@given(polynomials)
def test_a_polynomial_background_is_removed_exactly(coefficients: list[float]) -> None:
    line = values_of(coefficients) + PEAKS
    background, free = PolynomialBackground(degree=5).estimate(line)
    np.testing.assert_allclose(line - background, PEAKS, atol=1e-6)
    assert not (free & (PEAKS > 1e-3)).any()


def test_a_degree_too_low_leaves_something() -> None:
    line = values_of([0.0, 0.0, 0.0, 100.0]) + PEAKS
    background, _ = PolynomialBackground(degree=2).estimate(line)
    assert np.abs(line - background - PEAKS).max() > 10.0


@settings(max_examples=20, deadline=None)
@given(polynomials, st.integers(0, 2**32 - 1))
def test_what_noise_leaves_is_what_a_fit_of_a_few_parameters_may(
    coefficients: list[float], seed: int
) -> None:
    truth = values_of(coefficients)
    noisy = truth + PEAKS + np.random.default_rng(seed).normal(0.0, 2.0, PIXELS)
    background, free = PolynomialBackground(degree=5).estimate(noisy)
    basis = np.polynomial.chebyshev.chebvander(np.linspace(-1.0, 1.0, PIXELS), 5)
    spread = 2.0 * np.sqrt(
        np.einsum("ij,jk,ik->i", basis, np.linalg.inv(basis[free].T @ basis[free]), basis)
    )
    # Five deviations, and what a mask that cuts off the highest pixels draws down.
    assert (np.abs(background - truth) < 5.0 * spread + 0.2).all()


@settings(max_examples=30, deadline=None)
@given(st.floats(-3.0, 3.0), st.floats(100.0, 1000.0))
def test_bridges_are_straight(slope: float, level: float) -> None:
    ambient = level + slope * np.arange(PIXELS)
    found = InterpolatedBackground(PeakMask(degree=3))
    background, free = found.estimate(ambient + PEAKS)
    np.testing.assert_allclose(background, ambient, atol=1e-6)
    assert (background[free] == (ambient + PEAKS)[free]).all()


@pytest.mark.parametrize(
    "background",
    [
        PolynomialBackground(degree=4),
        InterpolatedBackground(PeakMask(degree=4)),
        InterpolatedBackground(PeakMask(degree=4), ButterworthFilter(4, 0.4)),
        InterpolatedBackground(PeakMask(degree=4), FirFilter(5, 0.4, "none")),
    ],
)
def test_the_adjoint_is_the_transposed_subtraction(
    background: PolynomialBackground | InterpolatedBackground,
) -> None:
    rng = np.random.default_rng(5)
    line = values_of([20.0, 50.0]) + PEAKS + rng.normal(0.0, 2.0, PIXELS)
    weights = rng.normal(size=PIXELS)
    estimate, free = background.estimate(line)
    back = background.adjoint(weights, free)
    for pixel in (0, 30, 80, 150, 250, PIXELS - 1):
        # So small that the same pixels are taken for peaks.
        moved = line.copy()
        moved[pixel] += 1e-6
        again, same = background.estimate(moved)
        assert (same == free).all()
        change = weights @ ((moved - again) - (line - estimate)) / 1e-6
        assert change == pytest.approx(back[pixel], abs=1e-5)


def test_a_batch_has_the_backgrounds_of_its_lines() -> None:
    rng = np.random.default_rng(6)
    lines = values_of([20.0, 50.0]) + PEAKS + rng.normal(0.0, 2.0, (2, 3, PIXELS))
    found = PolynomialBackground(degree=3)
    together, free = found.estimate(lines)
    assert together.shape == free.shape == lines.shape
    np.testing.assert_array_equal(together[1, 2], found.estimate(lines[1, 2])[0])


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 6), st.integers(1, 5))
def test_averages(count: int, groups: int) -> None:
    lines = np.random.default_rng(7).normal(size=(count * groups, 16))
    averaged = average_scans(lines, count)
    assert averaged.shape == (groups, 16)
    np.testing.assert_allclose(averaged[-1], lines[-count:].mean(axis=0))


def test_bad_settings_are_refused() -> None:
    for make in (
        lambda: PolynomialBackground(degree=-1),
        lambda: PolynomialBackground(degree=31),
        lambda: PeakMask(above_sigma=0.0),
        lambda: PeakMask(rounds=0),
        lambda: average_scans(np.zeros((5, 16)), 2),
        lambda: average_scans(np.zeros((1, 16)), 2),
    ):
        with pytest.raises(InvalidParameter):
            make()
