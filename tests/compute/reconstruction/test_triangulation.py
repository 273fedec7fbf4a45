"""Reconstruction: exact, honest about its errors, and clear about points it cannot have."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from compute.calibration.calibrate import calibrate
from compute.camera.stack import CameraStack
from compute.reconstruction.point_batch import PointFlag
from compute.reconstruction.triangulation import reconstruct, triangulate_linear
from tests.compute.rig import control_points, geometry, project, rig

Array = NDArray[np.float64]


@settings(deadline=None)
@given(
    st.integers(3, 8),
    st.lists(st.tuples(*[st.floats(-200.0, 200.0)] * 3), min_size=1, max_size=6),
    st.randoms(use_true_random=False),
)
def test_exact_readings_of_any_three_sensors_give_the_points(
    sensors: int, offsets: list[tuple[float, float, float]], random: "object"
) -> None:
    models = rig(sensors)
    points = np.array([0.0, 0.0, 1500.0]) + np.array(offsets)
    readings = project(models, points)
    rng = np.random.default_rng(random.getrandbits(32))  # type: ignore[attr-defined]
    for row in readings:
        hidden = rng.permutation(sensors)[: rng.integers(0, sensors - 2)]
        row[hidden] = np.nan
    linear = triangulate_linear(CameraStack.of(models), readings)
    batch = reconstruct(models, readings, np.full(sensors, 0.1))
    assert np.abs(linear - points).max() < 1e-7
    assert np.abs(batch.position_mm - points).max() < 1e-7
    assert (batch.used == np.isfinite(readings)).all()
    exact_three = batch.used.sum(axis=1) == 3
    assert ((batch.flags & PointFlag.NO_REDUNDANCY > 0) == exact_three).all()
    assert np.isnan(batch.residual_sigma()[exact_three]).all()


@pytest.mark.parametrize("sensors", [3, 4, 6])
def test_covariance_is_honest(sensors: int) -> None:
    """Normalised squared errors average 3, with sensors of unequal noise."""
    models, count = rig(sensors), 4000
    points = control_points(count)
    sigma = np.linspace(0.02, 0.5, sensors)
    rng = np.random.default_rng(5)
    readings = project(models, points) + sigma * rng.standard_normal((count, sensors))
    batch = reconstruct(models, readings, sigma)
    error = batch.position_mm - points
    squares = np.einsum("ni,nij,nj->n", error, np.linalg.inv(batch.covariance_mm2), error)
    assert squares.mean() == pytest.approx(3.0, abs=5 * np.sqrt(6 / count))
    if sensors > 3:
        freedom = sensors - 3
        assert batch.chi2.mean() == pytest.approx(freedom, abs=5 * np.sqrt(2 * freedom / count))
        flagged = (batch.flags & PointFlag.INCONSISTENT > 0).mean()
        assert flagged < 1e-3


def test_covariance_includes_the_calibration() -> None:
    """Calibrated from noisy control points and used without noise: the average is still 3."""
    models, sigma = rig(), 0.2
    frame, wanted = control_points(30), control_points(1, seed=9)
    rng = np.random.default_rng(6)
    readings = project(models, wanted)
    squares, without = [], []
    runs = 300
    for _ in range(runs):
        noisy = project(models, frame) + sigma * rng.standard_normal((30, 4))
        calibration = calibrate(frame, noisy, geometry(models), np.full((30, 4), sigma))
        measured = readings + sigma * rng.standard_normal(readings.shape)
        covariance = np.array(calibration.covariance)
        for parameters, collected in ((covariance, squares), (None, without)):
            batch = reconstruct(calibration.models, measured, np.full(4, sigma), parameters)
            error = batch.position_mm[0] - wanted[0]
            collected.append(error @ np.linalg.solve(batch.covariance_mm2[0], error))
    assert np.mean(squares) == pytest.approx(3.0, abs=5 * np.sqrt(6 / runs))
    assert np.mean(without) > np.mean(squares)


def test_a_good_sensor_counts_more_than_a_bad_one() -> None:
    models, count = rig(), 500
    points = control_points(count)
    sigma = np.array([0.02, 0.02, 0.02, 2.0])
    rng = np.random.default_rng(8)
    readings = project(models, points) + sigma * rng.standard_normal((count, 4))
    weighted = reconstruct(models, readings, sigma).position_mm - points
    equal = reconstruct(models, readings, np.ones(4)).position_mm - points
    assert (weighted**2).mean() < (equal**2).mean() / 4


def test_two_sensors_make_no_point() -> None:
    readings = project(rig(), control_points(3))
    readings[1, 2:] = np.nan
    readings[2] = np.nan
    batch = reconstruct(rig(), readings, np.ones(4))
    assert np.isfinite(batch.position_mm[0]).all()
    assert np.isnan(batch.position_mm[1:]).all()
    assert (batch.flags[1:] == PointFlag.TOO_FEW_SENSORS).all()
    estimate = batch.estimates(("s1", "s2", "s3", "s4"))[1]
    assert estimate.position_mm is None
    assert estimate.covariance_mm2 is None
    assert estimate.flags == ("too-few-sensors",)
    assert estimate.sensors == ("s1", "s2")


def test_planes_that_meet_in_a_line_make_no_point() -> None:
    from tests.compute.rig import camera

    target = np.array([0.0, 0.0, 1500.0])
    # All read horizontally in one row: nothing tells the height.
    models = tuple(
        camera(f"s{i}", np.array([x, 0.0, 0.0]), 0.0, target)
        for i, x in enumerate([-200.0, 0.0, 200.0])
    )
    points = np.array([[10.0, 40.0, 1400.0]])
    batch = reconstruct(models, project(models, points), np.ones(3))
    assert np.isnan(batch.position_mm).all()
    assert batch.flags[0] == PointFlag.DEGENERATE


def test_a_wrong_reading_is_noticed_by_the_fourth_sensor() -> None:
    readings = project(rig(), control_points(1))
    readings[0, 1] += 3.0
    batch = reconstruct(rig(), readings, np.full(4, 0.1))
    assert batch.flags[0] & PointFlag.INCONSISTENT
    assert batch.residual_sigma()[0] > 4.0


def test_no_points_at_all() -> None:
    assert len(reconstruct(rig(), np.empty((0, 4)), np.ones(4))) == 0


def test_the_share_of_the_parameters_is_their_jacobian() -> None:
    """A small change of the cameras moves the point as the covariance assumes.

    With three sensors, where there is nothing to weigh one against another.
    """
    models, points = rig(3), control_points(1)
    readings = project(models, points)
    rng = np.random.default_rng(2)
    scale = np.array([1e-1, 1e-1, 1e-5, 1e-5, 1e-5, 1e-2, 1e-2])
    step = rng.standard_normal((3, 7)) * scale
    direction = step.ravel()
    outer = np.outer(direction, direction)
    plain = reconstruct(models, readings, np.full(3, 0.1))
    share = reconstruct(models, readings, np.full(3, 0.1), outer).covariance_mm2[0]
    share -= plain.covariance_mm2[0]
    changed = tuple(model.retract(part) for model, part in zip(models, step, strict=True))
    moved = reconstruct(changed, readings, np.full(3, 0.1)).position_mm[0] - plain.position_mm[0]
    assert np.allclose(share, np.outer(moved, moved), rtol=1e-2, atol=1e-3 * (moved @ moved))


@pytest.mark.parametrize("extent", [0.5, 1.5, 2.5])
def test_chi2_knows_the_calibration(extent: float) -> None:
    """Inside and outside the frame, a good point is inconsistent no oftener than noise makes it.

    Far outside, the cameras' errors are many times the readings' noise.
    """
    models, sigma = rig(), 0.05
    frame = control_points(19)
    rng = np.random.default_rng(12)
    middle = np.array([0.0, 0.0, 1500.0])
    chi2, squares, flagged, total = [], [], 0, 0
    for _ in range(60):
        noisy = project(models, frame) + sigma * rng.standard_normal((19, 4))
        calibration = calibrate(frame, noisy, geometry(models), np.full((19, 4), sigma))
        points = middle + extent * rng.uniform(-200.0, 200.0, (50, 3))
        readings = project(models, points) + sigma * rng.standard_normal((50, 4))
        covariance = np.array(calibration.covariance)
        batch = reconstruct(calibration.models, readings, np.full(4, sigma), covariance)
        error = batch.position_mm - points
        # Points of one calibration share its errors: average them first.
        squares.append(
            np.einsum("ni,nij,nj->n", error, np.linalg.inv(batch.covariance_mm2), error).mean()
        )
        chi2.append(batch.chi2.mean())
        flagged += int((batch.flags & PointFlag.INCONSISTENT > 0).sum())
        total += 50
    for values, expected in ((chi2, 1.0), (squares, 3.0)):
        error_of_mean = np.std(values, ddof=1) / np.sqrt(len(values))
        assert np.mean(values) == pytest.approx(expected, abs=5 * error_of_mean)
    assert flagged <= 5  # 0.3 are expected of 3000


def test_a_reading_that_says_nothing_is_no_redundancy() -> None:
    readings = project(rig(), control_points(1))
    readings[0, 3] += 300.0
    batch = reconstruct(rig(), readings, np.array([0.05, 0.05, 0.05, 1e4]))
    assert batch.used[0].tolist() == [True, True, True, False]
    assert batch.flags[0] == PointFlag.NO_REDUNDANCY
    for useless in (np.inf, 0.0, -1.0, np.nan):
        again = reconstruct(rig(), readings, np.array([0.05, 0.05, 0.05, useless]))
        assert np.allclose(again.position_mm, batch.position_mm)
        assert not again.used[0, 3]


def test_a_cubic_term_corrects_readings_and_their_deviations() -> None:
    models, points = rig(), control_points(5)
    cubic = tuple(replace(model, cubic_per_px2=2e-7) for model in models)
    readings, sigma = project(models, points), np.array([0.1, 0.2, 0.1, 0.3])
    stack = CameraStack.of(cubic)
    found = reconstruct(cubic, readings, sigma)
    slope = stack.correction_derivative(readings)
    assert slope.max() > 1.05
    plain = reconstruct(models, stack.add_cubic_term(readings), sigma * slope)
    assert np.allclose(found.position_mm, plain.position_mm, atol=1e-9)
    assert np.allclose(found.covariance_mm2, plain.covariance_mm2, rtol=1e-9)
    assert np.allclose(found.chi2, plain.chi2, rtol=1e-6)
