"""Errors of control points rest on the readings that the calibration used."""

from dataclasses import replace

import numpy as np
import pytest

from compute.calibration.assessment.assess import (
    calibrate_and_assess,
    control_errors,
    fitted_errors,
)
from compute.calibration.calibrate import calibrate
from compute.calibration.result import count_readings, effective_readings
from compute.calibration.settings import CalibrationSettings, LabelPolicy
from compute.camera.stack import CameraStack
from tests.compute.rig import control_points, geometry, project, rig
from tests.oracles.least_squares_points import triangulate

SIGMA = 0.3


def exchanged() -> tuple[np.ndarray, np.ndarray, np.ndarray, list[int]]:
    """Points, right readings, readings of which two are exchanged, and which points' these are."""
    models, points = rig(), control_points(24)
    clean = project(models, points) + SIGMA * np.random.default_rng(2).standard_normal((24, 4))
    order = clean[:, 1].argsort()
    pair = [int(order[8]), int(order[16])]
    wrong = clean.copy()
    wrong[pair, 1] = clean[pair[::-1], 1]
    return points, clean, wrong, pair


@pytest.mark.slow
@pytest.mark.parametrize(("policy", "count"), [("repair", 96), ("exclude", 94)])
@pytest.mark.parametrize("known", [True, False])
def test_labels_that_were_dealt_with_spoil_no_error(
    policy: LabelPolicy, count: int, known: bool
) -> None:
    points, clean, wrong, pair = exchanged()
    rng = np.random.default_rng(5)
    right_sigma = SIGMA * rng.uniform(0.9, 1.1, clean.shape) if known else None
    sigma = None
    if right_sigma is not None:
        sigma = right_sigma.copy()
        sigma[pair, 1] = right_sigma[pair[::-1], 1]
    found = calibrate(points, wrong, geometry(rig()), sigma, CalibrationSettings(labels=policy))
    expected = clean.copy()
    if policy == "exclude":
        expected[pair, 1] = np.nan
    used, used_sigma = effective_readings(found, wrong, sigma)
    np.testing.assert_array_equal(used, expected)
    if right_sigma is not None and used_sigma is not None:
        here = np.isfinite(used)
        np.testing.assert_array_equal(used_sigma[here], right_sigma[here])
    errors, readings = control_errors(found, points, wrong, sigma)
    assert readings == count
    # Every point by least squares of its own, from the right readings.
    deviation = np.full(clean.shape, SIGMA) if right_sigma is None else right_sigma
    if right_sigma is None:
        deviation = deviation * [fit.sigma_px / SIGMA for fit in found.sensors]
    independent = triangulate(CameraStack.of(found.models).project, expected, deviation, points)
    # The calibration's covariance weighs besides: a part of the noise's effect.
    assert np.abs(errors - (independent - points)).max() < 0.1
    spoilt = np.abs(fitted_errors(found, points, wrong, sigma)).max(axis=1)
    assert (spoilt[pair] > 5.0 * np.abs(errors).max(axis=1)[pair]).all()


def test_outliers_without_weight_count_in_no_error() -> None:
    points, clean, _, _ = exchanged()
    spoilt = clean.copy()
    spoilt[[3, 17], [0, 2]] += 80.0
    settings = CalibrationSettings(loss="robust")
    found = calibrate(points, spoilt, geometry(rig()), np.full(clean.shape, SIGMA), settings)
    weights = np.array(found.reading_weights)
    assert (weights[[3, 17], [0, 2]] == 0.0).all()
    used, _ = effective_readings(found, spoilt)
    np.testing.assert_array_equal(np.isnan(used), weights == 0.0)
    sigma = np.full(clean.shape, SIGMA)
    errors, readings = control_errors(found, points, spoilt, sigma)
    assert readings == (weights > 0.0).sum()
    expected = np.where(weights > 0.0, clean, np.nan)
    independent = triangulate(CameraStack.of(found.models).project, expected, sigma, points)
    # The calibration's covariance weighs besides: a part of the noise's effect.
    assert np.abs(errors - (independent - points)).max() < 0.1


def test_outliers_without_weight_cover_no_pixels() -> None:
    points, clean, _, _ = exchanged()
    spoilt = clean.copy()
    far = int(clean[:, 0].argmax())
    spoilt[far, 0] += 200.0
    found = calibrate_and_assess(
        points, spoilt, geometry(rig()), np.full(clean.shape, SIGMA),
        CalibrationSettings(loss="robust"),
    )  # fmt: skip
    assert np.array(found.reading_weights)[far, 0] == 0.0
    assert found.diagnosis is not None
    low, high = found.diagnosis.sensors[0].pixels
    assert low == clean[:, 0].min()
    assert high == np.delete(clean[:, 0], far).max()


def test_readings_of_points_that_were_not_reconstructed_do_not_count() -> None:
    readings = np.full((3, 4), 100.0)
    readings[1, 2] = np.nan
    differences = np.zeros((3, 3))
    differences[0] = np.nan
    assert count_readings(readings, differences) == 7


@pytest.mark.slow
def test_readings_of_other_points_stay_as_they_are() -> None:
    points, _, wrong, _ = exchanged()
    found = calibrate(points, wrong, geometry(rig()), settings=CalibrationSettings(labels="repair"))
    assert found.labels
    fewer = wrong[:5]
    np.testing.assert_array_equal(effective_readings(found, fewer)[0], fewer)
    plain = replace(found, settings=None)
    np.testing.assert_array_equal(effective_readings(plain, wrong)[0], wrong)
