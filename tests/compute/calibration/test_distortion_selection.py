"""Distortion terms: recovery, covariance, automatic selection."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from compute.calibration.assessment.assess import cross_validate
from compute.calibration.calibrate import calibrate

from compute.calibration.settings import PRESETS, CalibrationSettings
from compute.camera.field_distortion import all_terms, symmetric_terms
from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.errors import DegeneratePoints, NoConvergence, TooFewPoints
from tests.compute.distorted_rig import (
    MIDDLE_MM,
    distorted_rig,
    field_points,
    geometry_with_pitch,
    seen_readings,
)
from tests.compute.rig import control_points, geometry, project, rig

Array = NDArray[np.float64]


@pytest.mark.parametrize("terms", [symmetric_terms(3), all_terms(4)])
def test_exact_readings_give_the_lenses_back(terms: tuple[tuple[int, int], ...]) -> None:
    models, points = distorted_rig(terms), field_points(150)
    readings = seen_readings(models, points)
    found = calibrate(
        points, readings, geometry_with_pitch(models), settings=CalibrationSettings(terms)
    )
    unseen = field_points(200, seed=7)
    error = CameraStack.of(found.models).project(unseen) - seen_readings(models, unseen)
    # The rows' distances behind the lenses are those of the fits before the last.
    assert np.nanmax(np.abs(error)) < 2e-3
    for fit, model in zip(found.sensors, models, strict=True):
        assert fit.model.distortion is not None
        assert model.distortion is not None
        assert fit.model.distortion.coefficients == pytest.approx(
            model.distortion.coefficients, abs=5e-3
        )
        assert fit.model.distortion.offset_y_mm == pytest.approx(
            model.distortion.offset_y_mm, abs=2.0
        )
        assert fit.model.distortion.row_behind_mm == pytest.approx(36.0, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, False])
def test_the_covariance_of_predictions_is_honest(known: bool) -> None:
    """Errors of predicted readings squared over their variance average 1, known noise or not."""
    terms, sigma, runs = symmetric_terms(3), 0.05, 40
    models, points = distorted_rig(terms), field_points(60)
    exact = seen_readings(models, points)
    unseen = field_points(40, seed=8)
    truth = CameraStack.of(models).project(unseen)
    rng = np.random.default_rng(3)
    ratios = []
    for _ in range(runs):
        noisy = exact + sigma * rng.standard_normal(exact.shape)
        noisy = np.where((noisy > -0.5) & (noisy < 2047.5), noisy, np.nan)
        found = calibrate(
            points,
            noisy,
            geometry_with_pitch(models),
            np.full(exact.shape, sigma) if known else None,
            CalibrationSettings(distortion=terms),
        )
        stack = CameraStack.of(found.models)
        slopes = stack.parameter_jacobian(unseen)
        blocks = stack.covariance_blocks(np.array(found.covariance))
        variance = np.einsum("nsp,spsq,nsq->ns", slopes, blocks, slopes)
        ratios.append(((stack.project(unseen) - truth) ** 2 / variance).mean(axis=0))
    # Each sensor and run is one draw of a mean over ten correlated degrees of freedom.
    per_run = np.array(ratios).ravel()
    error = per_run.std() / np.sqrt(len(per_run))
    assert per_run.mean() == pytest.approx(1.0, abs=5 * error)
    assert error < 0.1


def test_powers_of_u_leave_the_offset_along_the_slit_alone() -> None:
    models, points = rig(), control_points(40)
    settings = CalibrationSettings(distortion="odd-powers")
    readings = project(models, points) + 0.1 * np.random.default_rng(0).standard_normal((40, 4))
    found = calibrate(points, readings, geometry(models), settings=settings)
    first = found.sensors[0].model
    assert first.parameter_names[7] == "offset_y_mm"
    covariance = np.array(found.covariance)
    assert (covariance[7] == 0.0).all()
    assert (np.diag(covariance)[[*range(7), 8, 9, 10]] > 0.0).all()


@pytest.mark.slow
def test_auto_takes_no_terms_where_there_is_no_distortion() -> None:
    models, points = rig(), field_points(60)
    readings = seen_readings(models, points)
    taken = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        noisy = readings + 0.1 * rng.standard_normal(readings.shape)
        noisy = np.where((noisy > -0.5) & (noisy < 2047.5), noisy, np.nan)
        found = calibrate(
            points,
            noisy,
            geometry_with_pitch(models),
            settings=CalibrationSettings("auto"),
        )
        assert found.distortion is not None
        taken.append(found.distortion.chosen)
    assert taken.count("none") >= 3


def test_the_fewest_parameters_within_one_standard_error() -> None:
    excess, error = np.array([5.0, 0.3, 0.0, 0.1]), np.array([1.0, 0.4, 0.0, 0.2])
    assert first_within_standard_error((0, 1, 2, 3), excess, error) == 1
    assert first_within_standard_error((0, 3, 2, 1), excess, error) == 3
    assert first_within_standard_error((0, 1, 2, 3), excess, error / 4.0) == 2


def test_auto_takes_what_the_lenses_have() -> None:
    terms = symmetric_terms(5)
    models, points = distorted_rig(terms), field_points(200)
    readings = seen_readings(models, points)
    readings = readings + 0.02 * np.random.default_rng(0).standard_normal(readings.shape)
    readings = np.where((readings > -0.5) & (readings < 2047.5), readings, np.nan)
    found = calibrate(
        points,
        readings,
        geometry_with_pitch(models),
        settings=CalibrationSettings("auto"),
    )
    assert found.distortion is not None
    assert found.distortion.chosen == "symmetric-5"
    table = {row.name: row for row in found.distortion.candidates}
    assert table["none"].loss is not None
    assert table["symmetric-5"].loss is not None
    assert table["none"].loss > 100.0 * table["symmetric-5"].loss
    unseen = field_points(200, seed=7)
    error = CameraStack.of(found.models).project(unseen) - CameraStack.of(models).project(unseen)
    assert np.sqrt((error**2).mean()) < 0.02
    checked = cross_validate(found, points, readings, geometry_with_pitch(models))
    assert checked.groups == 16
    assert all(rms is not None and rms < 0.05 for rms in checked.reading_rms_px)


def test_auto_falls_back_where_points_are_few_and_says_so() -> None:
    models, points = distorted_rig(symmetric_terms(3)), field_points(60)
    readings = seen_readings(models, points)
    readings[14:, 2] = np.nan
    found = calibrate(
        points,
        readings,
        geometry_with_pitch(models),
        settings=CalibrationSettings("auto"),
    )
    assert found.distortion is not None
    assert found.distortion.chosen != "none"
    assert [name for name, _ in found.distortion.reduced_terms] == ["s3"]
    few = calibrate(
        points[:11],
        readings[:11],
        geometry_with_pitch(models),
        settings=CalibrationSettings("auto"),
    )
    assert few.distortion is not None
    assert few.distortion.chosen == "none"
    assert "too few points" in few.distortion.candidates[-1].note


def test_explicit_terms_that_the_points_cannot_bear_are_refused() -> None:
    models, points = distorted_rig(symmetric_terms(3)), field_points(40)
    readings = seen_readings(models, points)
    readings[18:, 1] = np.nan
    settings = CalibrationSettings(distortion="all-5")
    with pytest.raises(TooFewPoints, match=r"s2 saw 1\d control points; its 24 parameters"):
        calibrate(points, readings, geometry_with_pitch(models), settings=settings)
    # A field of two degrees: the terms of one order are much the same there.
    small = MIDDLE_MM + 0.08 * (field_points(200) - MIDDLE_MM)
    with pytest.raises((DegeneratePoints, NoConvergence), match="take fewer"):
        calibrate(
            small,
            seen_readings(models, small),
            geometry_with_pitch(models),
            settings=CalibrationSettings(distortion="all-5"),
        )


def test_a_start_nearby_changes_nothing() -> None:
    terms = PRESETS["symmetric-3"]
    models, points = distorted_rig(terms), field_points(100)
    readings = seen_readings(models, points)
    far = tuple(_with_offset(model, 900.0) for model in models)
    given = (
        points,
        readings,
        geometry_with_pitch(models),
        None,
        CalibrationSettings(terms),
    )
    here, moved = calibrate(*given), calibrate(*given, initial_models=far)
    for one, other in zip(here.models, moved.models, strict=True):
        assert one.principal_distance_px == pytest.approx(other.principal_distance_px, rel=1e-9)


def _with_offset(model: SensorModel, by_mm: float) -> SensorModel:
    assert model.distortion is not None
    moved = replace(model.distortion, offset_y_mm=model.distortion.offset_y_mm + by_mm)
    return replace(model, distortion=moved)
