"""calibrate: exact data, covariance with noise, errors."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.stats import f as f_distribution

from compute.calibration.assessment.assess import cross_validate, fitted_errors
from compute.calibration.calibrate import calibrate
from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.errors import (
    DegeneratePoints,
    DuplicatePoint,
    ImplausibleReadings,
    InvalidParameter,
    NonFiniteValue,
    ReadingOutsideSensor,
    TooFewPoints,
)
from compute.transform import rotation_matrix
from tests.compute.rig import control_points, geometry, project, rig

Array = NDArray[np.float64]


def test_exact_readings_give_the_cameras_back() -> None:
    models, points = rig(), control_points()
    found = calibrate(points, project(models, points), geometry(models))
    for model, fit in zip(models, found.sensors, strict=True):
        assert fit.rms_px < 1e-8
        assert fit.model.principal_distance_px == pytest.approx(3000.0, abs=1e-5)
        assert fit.model.principal_point_px == pytest.approx(1023.5, abs=1e-5)
        assert np.allclose(fit.model.rotation, model.rotation, atol=1e-9)


def test_seven_points_determine_the_camera() -> None:
    models, points = rig(), control_points(7)
    found = calibrate(points, project(models, points), geometry(models))
    unseen = control_points(50, seed=5)
    assert np.allclose(
        CameraStack.of(found.models).project(unseen), project(models, unseen), atol=1e-4
    )
    assert {fit.sigma_source for fit in found.sensors} == {"assumed"}


def test_each_sensor_uses_the_points_that_it_saw() -> None:
    models, points = rig(), control_points(20)
    readings = project(models, points)
    readings[:5, 0] = np.nan
    readings[8:12, 2] = np.nan
    found = calibrate(points, readings, geometry(models))
    assert [fit.points for fit in found.sensors] == [15, 20, 16, 20]
    assert found.residuals_px[0][0] is None
    assert found.residuals_px[9][2] is None
    assert found.residuals_px[9][0] is not None


@pytest.mark.slow
def test_covariance_is_honest() -> None:
    """Normalised squared errors of the 7 parameters average 7 with given deviations.

    With deviations estimated from the residuals, whose uncertainty is allowed for, they do too.
    """
    models, points = rig(1), control_points(40)
    exact = project(models, points)
    rng = np.random.default_rng(7)
    runs, sigma, freedom = 300, 0.3, 33
    given_squares, estimated_squares, estimates = [], [], []
    for _ in range(runs):
        noisy = exact + sigma * rng.standard_normal(exact.shape)
        stated = calibrate(points, noisy, geometry(models), np.full(exact.shape, sigma))
        estimated = calibrate(points, noisy, geometry(models))
        for found, squares in ((stated, given_squares), (estimated, estimated_squares)):
            error = _parameter_error(found.models[0], models[0])
            squares.append(error @ np.linalg.solve(np.array(found.covariance), error))
        estimates.append(estimated.sensors[0].sigma_px)
    # Five standard errors of the means; chi2 with 7 degrees of freedom has variance 14.
    assert np.mean(given_squares) == pytest.approx(7.0, abs=5 * np.sqrt(14 / runs))
    mean, variance = f_distribution.stats(7, freedom)
    assert np.mean(estimated_squares) == pytest.approx(
        7.0, abs=5 * 7 * np.sqrt(variance / runs) / mean
    )
    assert np.sqrt(np.mean(np.square(estimates))) == pytest.approx(
        sigma * np.sqrt(mean), rel=5 * np.sqrt(1 / (2 * freedom * runs))
    )


def _parameter_error(found: SensorModel, true: SensorModel) -> Array:
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(found.rotation @ true.rotation.T).as_rotvec()
    return np.array(
        [
            found.principal_distance_px - true.principal_distance_px,
            found.principal_point_px - true.principal_point_px,
            *turn,
            found.offset_x_mm - true.offset_x_mm,
            found.offset_z_mm - true.offset_z_mm,
        ]
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("noise_px", "count", "extent"),
    [(0.5, 19, 1.0), (5.0, 19, 1.0), (30.0, 19, 1.0), (30.0, 14, 0.3)],
)
def test_no_lower_minimum_is_known(noise_px: float, count: int, extent: float) -> None:
    """The found minimum is not above the one that a search from the true camera reaches.

    With points close together and much noise the linear solution often has points on both sides
    of the lens and is no start at all. There the minimum may also be no camera at all, which is
    refused as such.
    """
    models, geometries = rig(), geometry(rig())
    rng = np.random.default_rng(3)
    compared = 0
    for seed in range(12):
        points = [0.0, 0.0, 1500.0] + extent * (control_points(count, seed) - [0.0, 0.0, 1500.0])
        exact = project(models, points)
        noisy = exact + noise_px * rng.standard_normal(exact.shape)
        try:
            found = calibrate(points, noisy, geometries)
        except (DegeneratePoints, ImplausibleReadings):
            continue
        compared += 1
        for index, model in enumerate(models):
            from_truth = _search(model, points, noisy[:, index])
            ours = found.sensors[index].rms_px ** 2 * len(points)
            # A thousandth of the sum of squares: 1/30 of a standard error with 12 of freedom.
            assert ours <= from_truth * (1.0 + 1e-3)
    assert compared > 6


def _search(start: SensorModel, points: Array, readings: Array) -> float:
    def residuals(step: Array) -> Array:
        projected = CameraStack.of([start.retract(step)]).project(points)[:, 0]
        return np.nan_to_num(projected - readings, nan=1e6)

    return 2.0 * float(least_squares(residuals, np.zeros(7), x_scale="jac").cost)


def test_global_minimum_of_a_measured_frame_does_not_depend_on_the_world_frame() -> None:
    models, points = rig(), control_points(19)
    rng = np.random.default_rng(1)
    readings = project(models, points) + 3.0 * rng.standard_normal((19, 4))
    here = calibrate(points, readings, geometry(models))
    moved = calibrate(
        points @ rotation_matrix(np.array([0.4, -1.0, 2.0])).T + [5000.0, -70.0, 300.0],
        readings,
        geometry(models),
    )
    for first, second in zip(here.sensors, moved.sensors, strict=True):
        assert first.rms_px == pytest.approx(second.rms_px, rel=1e-6)


# --- what is refused ---------------------------------------------------------------------------


def observations() -> tuple[Array, Array]:
    points = control_points(12)
    return points, project(rig(), points)


def test_six_points_are_too_few() -> None:
    points, readings = observations()
    readings[6:, 1] = np.nan
    with pytest.raises(TooFewPoints, match=r"s2 saw 6 control points.*at least 7"):
        calibrate(points, readings, geometry(rig()))


@settings(max_examples=40)
@given(
    st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3),
    st.floats(0.0, 1e-4),
)
def test_coplanar_points_are_refused_in_any_plane(turn: list[float], relief: float) -> None:
    rng = np.random.default_rng(2)
    flat = rng.uniform(-150.0, 150.0, (15, 3)) * [1.0, 1.0, relief]
    points = flat @ rotation_matrix(np.array(turn)).T + [0.0, 0.0, 1500.0]
    with pytest.raises(DegeneratePoints, match="in one plane"):
        calibrate(points, project(rig(), points), geometry(rig()))


def test_coplanar_for_one_sensor_only_is_refused_too() -> None:
    points = control_points(20)
    points[:10, 2] = 1500.0
    readings = project(rig(), points)
    readings[10:, 3] = np.nan
    with pytest.raises(DegeneratePoints, match="s4"):
        calibrate(points, readings, geometry(rig()))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_control_points_must_be_finite(value: float) -> None:
    points, readings = observations()
    points[4, 2] = value
    with pytest.raises(NonFiniteValue, match="point 5 has Z"):
        calibrate(points, readings, geometry(rig()))


def test_readings_must_be_finite_or_absent() -> None:
    points, readings = observations()
    readings[3, 0] = np.inf
    with pytest.raises(NonFiniteValue, match="point 4 by sensor s1"):
        calibrate(points, readings, geometry(rig()))


def test_a_point_given_twice() -> None:
    points, readings = observations()
    points[7] = points[2]
    with pytest.raises(DuplicatePoint, match="points 3 and 8"):
        calibrate(points, readings, geometry(rig()))


@pytest.mark.parametrize("value", [-0.51, 2047.51])
def test_readings_outside_the_sensor(value: float) -> None:
    points, readings = observations()
    readings[5, 2] = value
    with pytest.raises(ReadingOutsideSensor, match=r"point 6 lies outside sensor s3.*2047\.5"):
        calibrate(points, readings, geometry(rig()))


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf, 1e-320, 1e5])
def test_deviations_must_be_positive(value: float) -> None:
    points, readings = observations()
    sigma = np.full(readings.shape, 0.1)
    sigma[2, 1] = value
    with pytest.raises(InvalidParameter, match="point 3 by sensor s2"):
        calibrate(points, readings, geometry(rig()), sigma)


def test_shapes_must_fit() -> None:
    points, readings = observations()
    with pytest.raises(InvalidParameter, match="shape"):
        calibrate(points, readings[:, :3], geometry(rig()))
    with pytest.raises(InvalidParameter, match="shape"):
        calibrate(points[:, :2], readings, geometry(rig()))


# --- cross-validation --------------------------------------------------------------------------


def test_left_out_points_have_larger_errors_than_fitted_ones() -> None:
    models, points = rig(), control_points(15)
    rng = np.random.default_rng(4)
    readings = project(models, points) + rng.standard_normal((15, 4))
    calibration = calibrate(points, readings, geometry(models))
    fitted = np.abs(fitted_errors(calibration, points, readings)).mean()
    left_out = cross_validate(calibration, points, readings, geometry(models), scheme="points")
    assert np.abs(np.array(left_out.differences_mm)).mean() > fitted


def test_leaving_one_of_seven_out_gives_no_figure() -> None:
    models, points = rig(), control_points(7)
    readings = project(models, points)
    calibration = calibrate(points, readings, geometry(models))
    found = cross_validate(calibration, points, readings, geometry(models), scheme="points")
    assert found.errors is None
    assert found.differences_mm == (None,) * 7


def test_leaving_out_from_the_start_nearby_is_leaving_out() -> None:
    models, points = rig(), control_points(12)
    rng = np.random.default_rng(4)
    readings = project(models, points) + rng.standard_normal((12, 4))
    calibration = calibrate(points, readings, geometry(models))
    found = cross_validate(calibration, points, readings, geometry(models), scheme="points")
    errors = np.array(found.differences_mm)
    rest = np.arange(12) != 5
    without = calibrate(points[rest], readings[rest], geometry(models))
    assert np.allclose(
        errors[5:6], fitted_errors(without, points[5:6], readings[5:6]), atol=1e-4, rtol=0
    )


@pytest.mark.parametrize("noise_px", [0.0, 0.1])
def test_a_box_seen_along_its_edges_is_refused(noise_px: float) -> None:
    """Twelve points, but a sensor that reads across the edges sees six, and many cameras fit."""
    axes = np.meshgrid([-100.0, 100.0], [-100.0, 0.0, 100.0], [1400.0, 1600.0])
    points = np.array(axes).reshape(3, -1).T
    noise = noise_px * np.random.default_rng(0).standard_normal((12, 4))
    with pytest.raises(DegeneratePoints, match="s3 cannot be calibrated"):
        calibrate(points, project(rig(), points) + noise, geometry(rig()))
    moved = points + np.random.default_rng(1).uniform(-30.0, 30.0, points.shape)
    calibrate(moved, project(rig(), moved) + noise, geometry(rig()))


def test_the_estimated_deviation_allows_for_its_own_uncertainty() -> None:
    """1/(n - 9) of the sum of squares: the mean of 1/chi2 with n - 7 degrees of freedom."""
    models, points = rig(), control_points(13)
    rng = np.random.default_rng(3)
    readings = project(models, points) + 0.2 * rng.standard_normal((13, 4))
    for fit in calibrate(points, readings, geometry(models)).sensors:
        assert fit.sigma_px == pytest.approx(fit.rms_px * np.sqrt(13 / 4))


def test_eight_points_leave_the_deviation_assumed() -> None:
    """One residual more than parameters: its size says next to nothing of the noise."""
    models, points = rig(), control_points(8)
    rng = np.random.default_rng(3)
    found = calibrate(
        points, project(models, points) + 0.05 * rng.standard_normal((8, 4)), geometry(models)
    )
    for fit in found.sensors:
        assert fit.sigma_source == "assumed"
        assert fit.sigma_px >= 1 / np.sqrt(12)
    ten = control_points(10)
    found = calibrate(ten, project(models, ten), geometry(models))
    assert {fit.sigma_source for fit in found.sensors} == {"residuals"}


def test_deviations_that_are_too_small_do_not_make_the_covariance_small() -> None:
    models, points = rig(1), control_points(40)
    rng = np.random.default_rng(5)
    readings = project(models, points) + 0.3 * rng.standard_normal((40, 1))
    right = calibrate(points, readings, geometry(models), np.full((40, 1), 0.3))
    wrong = calibrate(points, readings, geometry(models), np.full((40, 1), 0.03))
    ratio = np.array(wrong.covariance)[0][0] / np.array(right.covariance)[0][0]
    assert wrong.sensors[0].chi2_per_dof == pytest.approx(ratio * 100, rel=1e-3)
    assert ratio == pytest.approx(1.0, abs=5 * np.sqrt(2 / 33))


def test_a_frame_far_from_the_worlds_origin_is_as_good() -> None:
    models, points = rig(), control_points(19)
    rng = np.random.default_rng(6)
    readings = project(models, points) + rng.standard_normal((19, 4))
    here = calibrate(points, readings, geometry(models))
    far = calibrate(points + np.array([9e5, -9e5, 9e5]), readings, geometry(models))
    for first, second in zip(here.sensors, far.sensors, strict=True):
        assert first.rms_px == pytest.approx(second.rms_px, rel=1e-3)
