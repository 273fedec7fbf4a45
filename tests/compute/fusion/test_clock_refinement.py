"""Refinement of clocks: forgetting, the calibration's share, several bars, what is refused."""

import numpy as np
import pytest

from compute.errors import InvalidParameter
from compute.fusion.clock_errors import ClockSensitivity
from compute.fusion.clock_refinement import ClockRefinement

SIGMA_S = 20e-6


def told(errors_s: np.ndarray, information: np.ndarray, common: np.ndarray | None = None):
    """What a point tells of clock errors, without noise."""
    bars = len(errors_s)
    return ClockSensitivity(
        np.zeros((1, 3, bars)),
        information[None],
        np.zeros((1, bars)),
        (information @ errors_s)[None],
        np.zeros((1, bars, 0)) if common is None else common[None],
    )


def test_it_weighs_what_is_stated_with_what_is_seen() -> None:
    clock = ClockRefinement(np.array([SIGMA_S]))
    clock.update(told(np.array([10e-6]), np.array([[1.0 / SIGMA_S**2]])), np.zeros(1))
    assert clock.estimate.error_s[0] == pytest.approx(5e-6)
    assert clock.estimate.covariance_s2[0, 0] == pytest.approx(SIGMA_S**2 / 2.0)


def test_errors_that_are_taken_out_already_count() -> None:
    """Readings that were aligned with a part of the error show the rest only."""
    whole, rest = (ClockRefinement(np.array([SIGMA_S])) for _ in range(2))
    information = np.array([[3.0 / SIGMA_S**2]])
    whole.update(told(np.array([10e-6]), information), np.zeros(1))
    rest.update(told(np.array([4e-6]), information), np.array([6e-6]))
    assert rest.estimate.error_s[0] == pytest.approx(whole.estimate.error_s[0])


def test_it_goes_back_to_what_is_stated() -> None:
    clock = ClockRefinement(np.array([SIGMA_S]), correlation_s=10.0)
    clock.update(told(np.array([10e-6]), np.array([[99.0 / SIGMA_S**2]])), np.zeros(1))
    clock.predict(1.0)
    assert 8e-6 < clock.estimate.error_s[0] < 9.9e-6
    clock.predict(200.0)
    assert abs(clock.estimate.error_s[0]) < 1e-9
    assert clock.estimate.covariance_s2[0, 0] == pytest.approx(SIGMA_S**2)


def test_the_calibrations_errors_do_not_average_out() -> None:
    clock = ClockRefinement(np.array([SIGMA_S]))
    information = np.array([[1.0 / SIGMA_S**2]])
    # As large as an error of 2 us.
    common = information * 2e-6
    for _ in range(400):
        clock.update(told(np.zeros(1), information, common), np.zeros(1))
    sigma = np.sqrt(clock.estimate.covariance_s2[0, 0])
    assert sigma == pytest.approx(np.hypot(2e-6, SIGMA_S / np.sqrt(401.0)), rel=0.01)


def test_calibration_errors_of_motions_to_and_fro_do() -> None:
    clock = ClockRefinement(np.array([SIGMA_S]))
    information = np.array([[1.0 / SIGMA_S**2]])
    for k in range(400):
        common = information * 2e-6 * (-1.0) ** k
        clock.update(told(np.zeros(1), information, common), np.zeros(1))
    assert np.sqrt(clock.estimate.covariance_s2[0, 0]) < 1.1 * SIGMA_S / np.sqrt(401.0)


def test_it_is_never_less_certain_than_stated() -> None:
    clock = ClockRefinement(np.array([SIGMA_S]))
    information = np.array([[1.0 / SIGMA_S**2]])
    clock.update(told(np.zeros(1), information, information * 1e-3), np.zeros(1))
    assert clock.estimate.covariance_s2[0, 0] <= 1.0001 * SIGMA_S**2


def test_each_of_two_bars_has_its_own() -> None:
    clock = ClockRefinement(np.array([SIGMA_S, 2.0 * SIGMA_S]))
    errors = np.array([12e-6, -30e-6])
    information = np.array([[8e12, 1e12], [1e12, 5e12]])
    clock.update(told(errors, information), np.zeros(2))
    np.testing.assert_allclose(clock.estimate.error_s, errors, rtol=1e-3)


def test_a_bar_that_nothing_tells_of_is_as_stated() -> None:
    clock = ClockRefinement(np.array([SIGMA_S, SIGMA_S]))
    clock.update(told(np.array([5e-6, 9e-6]), np.diag([1e12, 0.0])), np.zeros(2))
    assert clock.estimate.error_s[1] == 0.0
    assert clock.estimate.covariance_s2[1, 1] == pytest.approx(SIGMA_S**2)


@pytest.mark.parametrize("sigma", [-1.0, np.inf, np.nan])
def test_uncertainties_out_of_range_are_refused(sigma: float) -> None:
    with pytest.raises(InvalidParameter, match="sigma_s"):
        ClockRefinement(np.array([sigma]))


def test_a_time_constant_out_of_range_is_refused() -> None:
    with pytest.raises(InvalidParameter, match="correlation_s"):
        ClockRefinement(np.array([1.0]), 0.0)
