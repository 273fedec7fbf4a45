"""Clock errors in points: against a joint fit of point and clock, and over runs of a hall."""

from dataclasses import replace

import numpy as np
import pytest

from compute.fusion.clock_errors import PeakRates, PointReadings, clock_sensitivity, correct_points
from compute.fusion.clock_refinement import ClockRefinement
from compute.measurement.measurements import Measurements
from compute.reconstruction.point_batch import PointFlag
from compute.reconstruction.triangulation import reconstruct
from tests.compute.fusion.hall import BAR, SIGMA_PX, align_run, fuse, model, refine
from tests.oracles.ideal_sensors import locate
from tests.oracles.two_bars import course, draw, point_and_clock, sensors

CLOCK_S = 20e-6
RUNS = 16


def normalised(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    return np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)


def test_a_point_with_a_clock_of_its_own_is_that_of_a_joint_fit() -> None:
    """With what one exposure tells of its clock: position, covariance and misfit."""
    run = draw(np.random.default_rng(1), 12, 2000.0, SIGMA_PX, 60e-6)
    aligned = align_run(run).readings
    none = np.zeros(aligned.rate_px_s.shape)
    # Rates as if they were known.
    readings = replace(aligned, rate_variance_px2_s2=none, covariance_px2_s=none)
    cameras = model()
    points = reconstruct(cameras.cameras, readings.position_px, readings.sigma_px)
    sensitivity = clock_sensitivity(cameras, points, readings, BAR)
    for n, at in enumerate(points.position_mm):
        one = points.part(n, n + 1)
        its = clock_sensitivity(
            cameras,
            one,
            PointReadings(*(values[n : n + 1] for values in vars(readings).values())),
            BAR,
        )
        clock = ClockRefinement(np.array([CLOCK_S]))
        clock.update(its, np.zeros(1))
        estimate = clock.estimate
        found = correct_points(one, its, estimate.error_s, estimate.covariance_s2)
        position, error_s, covariance, squares = point_and_clock(
            readings.position_px[n],
            readings.sigma_px[n],
            readings.rate_px_s[n],
            BAR == 0,
            CLOCK_S,
            at,
        )
        assert estimate.error_s[0] == pytest.approx(error_s, abs=2e-9)
        np.testing.assert_allclose(found.position_mm[0], position, atol=2e-6)
        np.testing.assert_allclose(
            found.covariance_mm2[0], covariance[:3, :3], rtol=1e-3, atol=1e-8
        )
        # Not knowing the clock is as good as knowing its uncertainty, as far as the misfit goes.
        prior = correct_points(one, its, np.zeros(1), np.array([[CLOCK_S**2]]))
        assert prior.chi2[0] == pytest.approx(squares, rel=1e-3)
    np.testing.assert_array_less(0.0, sensitivity.information[:, 0, 0])


def test_readings_of_points_are_the_nearest_ones() -> None:
    cameras = model()
    truth = course(np.array([0.1]), 500.0)
    readings = cameras.linearise(truth)[0]
    points = reconstruct(cameras.cameras, readings, np.full(readings.shape, SIGMA_PX))
    two = np.stack([readings[0] + 40.0, readings[0]], axis=1)
    two[3] = np.nan
    measurements = Measurements.of(two, np.full(two.shape, SIGMA_PX))
    rate = np.stack([np.zeros(8), np.arange(8.0)], axis=1)
    found = PointReadings.nearest(
        cameras, points, measurements, PeakRates(rate, 0.0 * rate, 0.0 * rate)
    )
    expected = np.where(np.arange(8) == 3, np.nan, readings[0])
    np.testing.assert_allclose(found.position_px[0], expected)
    np.testing.assert_allclose(found.rate_px_s[0], np.where(np.arange(8) == 3, np.nan, rate[:, 1]))


@pytest.mark.parametrize("speed_mm_s", [0.0, 2000.0])
def test_fused_points_are_as_good_as_synchronous_ones_and_honest(speed_mm_s: float) -> None:
    """The clock exactly known: within 1 % RMS of eight sensors on one clock."""
    rng = np.random.default_rng(7)
    run = draw(rng, 402, speed_mm_s, SIGMA_PX, 0.0)
    kept, points, _ = fuse(run, 0.0)
    truth = run.position_mm[kept]
    error = points.position_mm - truth
    together = locate(sensors(), run.together_px[kept], np.full(8, SIGMA_PX), truth) - truth
    ratio = np.sqrt((error**2).sum() / (together**2).sum())
    assert ratio < 1.01
    nees = normalised(error, points.covariance_mm2)
    # 400 chi-squares of 3, not quite independent.
    assert np.mean(nees) == pytest.approx(3.0, abs=0.55)


@pytest.mark.parametrize("speed_mm_s", [0.0, 2000.0])
def test_their_covariance_holds_the_clocks_uncertainty(speed_mm_s: float) -> None:
    rng = np.random.default_rng(8)
    without, with_clock = [], []
    for _ in range(RUNS):
        run = draw(rng, 22, speed_mm_s, SIGMA_PX, CLOCK_S * rng.standard_normal())
        kept, points, grown = fuse(run, CLOCK_S)
        error = points.position_mm - run.position_mm[kept]
        without.append(normalised(error, points.covariance_mm2).mean())
        with_clock.append(normalised(error, grown.covariance_mm2).mean())
    if speed_mm_s == 0.0:
        assert np.mean(with_clock) == pytest.approx(3.0, abs=0.5)
        np.testing.assert_allclose(with_clock, without, rtol=1e-3)
    else:
        # One of three dimensions has a chi-square of the clock's, the same in a whole run.
        assert np.mean(with_clock) == pytest.approx(3.0, abs=0.9)
        assert np.mean(without) > 4.0


def test_a_moving_marker_refines_the_clock() -> None:
    """Estimated to better than stated, honestly; a marker at rest tells nothing."""
    rng = np.random.default_rng(9)
    squares = []
    for _ in range(RUNS):
        error_s = CLOCK_S * rng.standard_normal()
        run = draw(rng, 122, 2000.0, SIGMA_PX, error_s)
        estimate = refine(run, CLOCK_S).estimate
        sigma = np.sqrt(estimate.covariance_s2[0, 0])
        assert sigma < 0.6 * CLOCK_S
        assert not estimate.contradicted[0]
        squares.append((estimate.error_s[0] - error_s) ** 2 / sigma**2)
    assert 0.4 < np.mean(squares) < 1.9


def test_a_marker_at_rest_tells_nothing_of_the_clock() -> None:
    """Nor does the noise of its rates, which goes with that of its readings."""
    run = draw(np.random.default_rng(13), 202, 0.0, SIGMA_PX, CLOCK_S)
    still = refine(run, CLOCK_S).estimate
    assert abs(still.error_s[0]) < 0.05 * CLOCK_S
    assert np.sqrt(still.covariance_s2[0, 0]) == pytest.approx(CLOCK_S, rel=0.01)


def test_slow_markers_do_not_pull_the_clock() -> None:
    """Rates of some times their noise, whose errors add up while the exposures keep their phase."""
    rng = np.random.default_rng(14)
    errors = []
    for _ in range(RUNS):
        run = draw(rng, 122, 110.0, SIGMA_PX, 0.0)
        estimate = refine(run, 400e-6).estimate
        errors.append(estimate.error_s[0] / np.sqrt(estimate.covariance_s2[0, 0]))
    assert np.sqrt(np.mean(np.square(errors))) < 1.5


def test_a_clock_that_is_off_by_more_than_stated_is_told() -> None:
    run = draw(np.random.default_rng(10), 402, 2000.0, SIGMA_PX, 200e-6)
    assert refine(run, 10e-6).estimate.contradicted[0]


def test_inconsistent_points_that_the_clock_explains_are_not() -> None:
    run = draw(np.random.default_rng(11), 42, 2000.0, SIGMA_PX, 600e-6)
    _, points, grown = fuse(run, 600e-6)
    inconsistent = int(PointFlag.INCONSISTENT)
    assert np.count_nonzero(points.flags & inconsistent) > 10
    assert np.count_nonzero(grown.flags & inconsistent) == 0


def test_points_without_a_position_stay_so() -> None:
    run = draw(np.random.default_rng(12), 12, 2000.0, SIGMA_PX, 0.0)
    readings = align_run(run).readings
    readings.position_px[2, :6] = np.nan
    cameras = model()
    points = reconstruct(cameras.cameras, readings.position_px, readings.sigma_px)
    sensitivity = clock_sensitivity(cameras, points, readings, BAR)
    grown = correct_points(points, sensitivity, np.zeros(1), np.array([[CLOCK_S**2]]))
    assert np.isnan(grown.position_mm[2]).all()
    assert np.isfinite(np.delete(grown.position_mm, 2, axis=0)).all()
    np.testing.assert_array_equal(sensitivity.information[2], 0.0)
