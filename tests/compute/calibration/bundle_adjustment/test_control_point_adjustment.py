"""Joint adjustment of sensors and uncertain control points."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from compute.calibration.assessment.diagnosis import diagnose
from compute.calibration.bundle_adjustment import control_point_adjustment
from compute.calibration.calibrate import calibrate
from compute.calibration.settings import CalibrationSettings
from compute.camera.model import SensorModel
from compute.errors import NoConvergence
from tests.compute.rig import control_points, geometry, project, rig


def parameter_error(found: SensorModel, true: SensorModel) -> list[float]:
    turn = Rotation.from_matrix(found.rotation @ true.rotation.T).as_rotvec()
    return [
        found.principal_distance_px - true.principal_distance_px,
        found.principal_point_px - true.principal_point_px,
        *turn.tolist(),
        found.offset_x_mm - true.offset_x_mm,
        found.offset_z_mm - true.offset_z_mm,
    ]


@pytest.mark.slow
def test_the_joint_covariance_is_honest_and_joint() -> None:
    """All 28 parameters' errors squared over the joint covariance average 28.

    Taken sensor by sensor the covariance says nothing of what they share: the points' errors.
    """
    models, points = rig(), control_points(40)
    runs, sigma_px, sigma_mm = 60, 0.05, 0.2
    rng = np.random.default_rng(2)
    settings = CalibrationSettings(position_sigma_mm=sigma_mm)
    joint, correlation = [], []
    for _ in range(runs):
        readings = project(models, points) + sigma_px * rng.standard_normal((40, 4))
        given = points + sigma_mm * rng.standard_normal(points.shape)
        found = calibrate(given, readings, geometry(models), np.full((40, 4), sigma_px), settings)
        error = np.concatenate(
            [parameter_error(a, b) for a, b in zip(found.models, models, strict=True)]
        )
        covariance = np.array(found.covariance)
        joint.append(error @ np.linalg.solve(covariance, error))
        scale = np.sqrt(np.diag(covariance))
        correlation.append(np.abs((covariance / np.outer(scale, scale))[:7, 7:]).max())
    # chi2 with 28 degrees of freedom has variance 56.
    assert np.mean(joint) == pytest.approx(28.0, abs=5 * np.sqrt(56 / runs))
    assert min(correlation) > 0.05


def test_points_move_to_where_the_readings_say_they_are() -> None:
    models, points = rig(), control_points(40)
    given = points.copy()
    given[7] += [1.5, 0.0, 0.0]
    readings = project(models, points) + 0.02 * np.random.default_rng(1).standard_normal((40, 4))
    found = calibrate(
        given,
        readings,
        geometry(models),
        np.full((40, 4), 0.02),
        CalibrationSettings(position_sigma_mm=0.3),
    )
    assert found.point_shifts_mm is not None
    assert found.point_shifts_mm[7][0] == pytest.approx(-1.5, abs=0.3)
    others = np.delete(np.array(found.point_shifts_mm), 7, axis=0)
    assert np.abs(others).max() < 0.5
    exact = calibrate(given, readings, geometry(models), np.full((40, 4), 0.02))
    assert exact.point_shifts_mm is None
    worst = [max(abs(fit.rms_px) for fit in one.sensors) for one in (found, exact)]
    assert worst[0] < 0.1 * worst[1]


def test_without_deviations_of_readings_the_rest_of_the_residuals_is_theirs() -> None:
    models, points = rig(), control_points(60)
    rng = np.random.default_rng(4)
    readings = project(models, points) + 0.5 * rng.standard_normal((60, 4))
    given = points + 0.05 * rng.standard_normal(points.shape)
    settings = CalibrationSettings(position_sigma_mm=0.05)
    found = calibrate(given, readings, geometry(models), None, settings)
    for fit in found.sensors:
        assert fit.sigma_source == "residuals"
        # Standard error of a deviation from 53 of freedom: 10 %.
        assert fit.rms_px == pytest.approx(0.5, rel=0.4)


def test_noise_far_below_the_points_uncertainty_is_told_by_the_sensors_agreement() -> None:
    """Points wrong by 1 px, readings by 0.05: what four sensors agree on is the points' error."""
    models, points = rig(), control_points(120)
    rng = np.random.default_rng(4)
    readings = project(models, points) + 0.05 * rng.standard_normal((120, 4))
    given = points + 0.5 * rng.standard_normal(points.shape)
    settings = CalibrationSettings(position_sigma_mm=0.5)
    found = calibrate(given, readings, geometry(models), None, settings)
    sigma = np.array([fit.sigma_px for fit in found.sensors])
    # 92 readings more than unknowns tell all: 23 of each sensor, a deviation to 15 % at best.
    assert np.sqrt((sigma**2).mean()) == pytest.approx(0.05, rel=0.35)
    assert sigma.max() < 0.12


def test_readings_that_count_as_less_certain_than_given_are_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    models, points = rig(), control_points(40)
    rng = np.random.default_rng(1)
    readings = project(models, points) + 0.02 * rng.standard_normal((40, 4))
    given = points + 0.3 * rng.standard_normal(points.shape)
    settings = CalibrationSettings(position_sigma_mm=0.3)
    observed = given, readings, geometry(models), np.full((40, 4), 0.02)
    as_given = calibrate(*observed, settings)
    assert {fit.sigma_source for fit in as_given.sensors} == {"given"}
    assert not any("count as" in r for r in diagnose(as_given, given, readings).remarks)
    adjust, tried = control_point_adjustment.adjust, []

    def fail_first(*arguments, **options):  # type: ignore[no-untyped-def]
        tried.append(1)
        if len(tried) == 1:
            raise NoConvergence("too narrow")
        return adjust(*arguments, **options)

    monkeypatch.setattr(control_point_adjustment, "adjust", fail_first)
    widened = calibrate(*observed, settings)
    for fit in widened.sensors:
        assert fit.sigma_source == "assumed"
        assert fit.sigma_px > 0.02
    remarks = diagnose(widened, given, readings).remarks
    assert sum("count as uncertain by" in remark for remark in remarks) == 4
