"""Wrong readings of labelled points: found, named, left out, or said to be beyond finding."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import optimize, stats

from compute.camera.stack import CameraStack
from compute.measurement.measurement_model import MeasurementModel
from compute.reconstruction.outlier_exclusion import exclude_outliers
from compute.reconstruction.point_batch import PointBatch, PointFlag
from compute.reconstruction.solver import PointSolver
from compute.reconstruction.triangulation import detectable_errors, reconstruct
from tests.compute.reconstruction.solver_scenes import parameter_spread
from validation.reliability.ring import project, ring

Array = NDArray[np.float64]
SIGMA_PX = 0.1


def solve(sensors: int, readings_px: Array) -> tuple[PointBatch, PointBatch]:
    """Points of all readings, and without those that are wrong."""
    cameras = CameraStack.of(ring(sensors)[1])
    sigma = np.full(readings_px.shape, SIGMA_PX)
    whole = reconstruct(cameras, readings_px, sigma)
    return whole, exclude_outliers(
        lambda fewer, its_sigma: reconstruct(cameras, fewer, its_sigma), whole, readings_px, sigma
    )


def readings(sensors: int, count: int = 40, seed: int = 3) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    places = 200.0 * rng.uniform(-1.0, 1.0, (count, 3))
    exact = project(ring(sensors)[0], places)
    return exact + SIGMA_PX * rng.standard_normal(exact.shape), places


def holds(points: PointBatch, flag: PointFlag) -> NDArray[np.bool_]:
    return (points.flags & int(flag)) != 0


def test_a_reading_wrong_by_a_hundred_pixels_is_left_out() -> None:
    observed, places = readings(8)
    wrong = np.arange(len(observed)) % 8
    observed[np.arange(len(observed)), wrong] += 100.0
    whole, found = solve(8, observed)
    assert np.linalg.norm(whole.position_mm - places, axis=1).min() > 5.0
    excluded = holds(found, PointFlag.READING_EXCLUDED)
    # The rest must fit at 0.01.
    assert excluded.mean() >= 0.9
    assert not found.used[np.arange(len(observed)), wrong][excluded].any()
    assert (found.used.sum(axis=1) == np.where(excluded, 7, 8)).all()
    assert np.linalg.norm(found.position_mm - places, axis=1)[excluded].max() < 0.6
    assert (holds(found, PointFlag.NOT_IDENTIFIABLE) == ~excluded).all()


def test_two_wrong_readings_of_eight_are_left_out() -> None:
    observed, places = readings(8)
    observed[:, 2] += 40.0
    observed[:, 5] -= 25.0
    _, found = solve(8, observed)
    excluded = holds(found, PointFlag.READING_EXCLUDED)
    assert excluded.mean() >= 0.9
    assert (found.used[excluded] == ~np.isin(np.arange(8), (2, 5))).all()
    assert np.linalg.norm(found.position_mm - places, axis=1)[excluded].max() < 0.8


def test_of_four_readings_the_wrong_one_is_not_to_be_known() -> None:
    observed, _ = readings(4)
    observed[:, 1] += 100.0
    whole, found = solve(4, observed)
    assert holds(found, PointFlag.INCONSISTENT).all()
    assert holds(found, PointFlag.NOT_IDENTIFIABLE).all()
    assert found.used.all()
    assert (found.position_mm == whole.position_mm).all()


def test_points_without_a_contradiction_are_returned_as_they_are() -> None:
    observed, _ = readings(6)
    whole, found = solve(6, observed)
    assert found is whole


def test_two_wrong_readings_of_six_are_not_guessed() -> None:
    """Two of six may agree with three others by chance; none of them is left out for it."""
    observed, _ = readings(6, 200)
    observed[:, 0] += 30.0
    observed[:, 3] += 30.0
    _, found = solve(6, observed)
    excluded = holds(found, PointFlag.READING_EXCLUDED)
    assert excluded.sum() <= 2
    assert holds(found, PointFlag.INCONSISTENT)[~excluded].all()


def test_the_kernel_leaves_out_the_same_readings() -> None:
    observed, _ = readings(7)
    observed[::2, 4] += 50.0
    observed[5, :4] = np.nan
    observed[6, 0] = np.nan
    observed[6, 1] += 20.0
    solver = PointSolver(ring(7)[1], device="cpu", threads=1)
    sigma = np.full(observed.shape, SIGMA_PX)
    found = exclude_outliers(solver.solve, solver.solve(observed, sigma), observed, sigma)
    _, expected = solve(7, observed)
    assert holds(expected, PointFlag.READING_EXCLUDED).sum() > 15
    assert (found.flags == expected.flags).all()
    assert (found.used == expected.used).all()
    assert found.position_mm == pytest.approx(expected.position_mm, abs=1e-8, nan_ok=True)


def test_errors_of_the_detectable_size_are_found_as_often_as_stated() -> None:
    """And move the point as far as stated."""
    matrices, models = ring(6)
    cameras, place = CameraStack.of(models), np.array([[120.0, -80.0, 60.0]])
    exact, sigma = project(matrices, place), np.full(6, SIGMA_PX)
    point = reconstruct(cameras, exact, sigma)
    detectable = detectable_errors(MeasurementModel(cameras), point, exact, sigma)[0]
    rng = np.random.default_rng(8)
    shifts = []
    for sensor in range(6):
        noisy = exact + SIGMA_PX * rng.standard_normal((4000, 6))
        noisy[:, sensor] += detectable[sensor]
        flags = reconstruct(cameras, noisy, sigma).flags
        assert ((flags & int(PointFlag.INCONSISTENT)) != 0).mean() == pytest.approx(0.8, abs=0.03)
        moved = exact.copy()
        moved[0, sensor] += detectable[sensor]
        shifts.append(np.linalg.norm(reconstruct(cameras, moved, sigma).position_mm - place))
    assert max(shifts) == pytest.approx(point.external_reliability_mm[0], rel=0.02)


def test_external_reliability_with_correlated_readings_is_the_shift_by_a_detectable_error() -> None:
    """The chi-square that an error of one reading adds says how large it is at the detectable one.

    The non-centrality is SciPy's, found by bisection.
    """
    cameras = CameraStack.of(ring(6)[1])
    rng = np.random.default_rng(6)
    covariance = parameter_spread(cameras, rng)
    place, sigma = np.array([[90.0, -150.0, 60.0]]), rng.uniform(0.05, 0.3, 6)
    exact = project(ring(6)[0], place)
    start = reconstruct(cameras, exact, sigma, covariance)
    limit = stats.chi2.isf(1e-4, 3)
    noncentrality = optimize.brentq(lambda nc: stats.ncx2.sf(limit, 3, nc) - 0.8, 1.0, 100.0)
    shifts = []
    for sensor in range(6):
        moved = exact.copy()
        moved[0, sensor] += 0.01
        found = reconstruct(cameras, moved, sigma, covariance)
        shift = np.linalg.norm(found.position_mm - start.position_mm)
        shifts.append(shift * np.sqrt(noncentrality / found.chi2[0]))
    assert start.external_reliability_mm[0] == pytest.approx(max(shifts), rel=1e-3)


def test_with_three_sensors_any_error_may_hide() -> None:
    matrices, models = ring(3)
    observed = project(matrices, np.zeros((1, 3)))
    point = reconstruct(models, observed, np.full(3, SIGMA_PX))
    model = MeasurementModel.of(models)
    assert np.isinf(detectable_errors(model, point, observed, np.full(3, SIGMA_PX))).all()
    assert np.isinf(point.external_reliability_mm).all()
    missing = np.full((1, 3), np.nan)
    none = reconstruct(models, missing, np.full(3, SIGMA_PX))
    assert np.isnan(detectable_errors(model, none, missing, np.full(3, SIGMA_PX))).all()
    assert np.isnan(none.external_reliability_mm).all()
