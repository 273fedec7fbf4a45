"""Distortion terms: recovery, covariance, automatic scale."""

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from compute.calibration.assessment.assess import cross_validate
from compute.calibration.calibrate import calibrate
from compute.calibration.settings import PRESETS, CalibrationSettings, Distortion
from compute.camera.field_distortion import all_terms, symmetric_terms
from compute.camera.model import SensorGeometry, SensorModel
from compute.camera.stack import CameraStack
from compute.errors import TooFewPoints
from tests.compute.distorted_rig import (
    MIDDLE_MM,
    distorted_rig,
    field_points,
    geometry_with_pitch,
    seen_readings,
)
from tests.compute.rig import control_points, geometry, project, rig
from validation.thesis_data import load_test

Array = NDArray[np.float64]
Data = tuple[Array, Array, list[SensorGeometry]]


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


def test_auto_without_distortion_predicts_as_well_as_cameras_without() -> None:
    models, points = rig(), field_points(60)
    exact = seen_readings(models, points)
    noisy = exact + 0.1 * np.random.default_rng(0).standard_normal(exact.shape)
    given = points, noisy, geometry_with_pitch(models), np.full(exact.shape, 0.1)
    found = calibrate(*given, CalibrationSettings("auto"))
    assert found.distortion is not None
    assert found.distortion.chosen == "auto"
    assert found.distortion.edge_px is not None
    assert found.distortion.edge_px < 1.0
    assert "show no distortion" in found.distortion.reason
    plain = calibrate(*given, CalibrationSettings("none"))
    unseen = field_points(200, seed=7)
    truth = CameraStack.of(models).project(unseen)
    error, least = (
        np.sqrt(((CameraStack.of(one.models).project(unseen) - truth) ** 2).mean())
        for one in (found, plain)
    )
    assert error < 1.5 * least


def test_auto_finds_the_size_of_the_distortion() -> None:
    models, points = distorted_rig(symmetric_terms(5)), field_points(100)
    readings = seen_readings(models, points)
    readings = readings + 0.02 * np.random.default_rng(0).standard_normal(readings.shape)
    given = points, readings, geometry_with_pitch(models)
    found = calibrate(*given, settings=CalibrationSettings("auto"))
    assert found.distortion is not None
    assert found.distortion.log_evidence_ratio is not None
    assert found.distortion.log_evidence_ratio > 100.0
    assert "the lenses distort by about" in found.distortion.reason
    unseen = field_points(200, seed=7)
    error = CameraStack.of(found.models).project(unseen) - CameraStack.of(models).project(unseen)
    assert np.sqrt((error**2).mean()) < 0.02
    checked = cross_validate(found, *given)
    assert checked.groups == 16
    assert all(rms is not None and rms < 0.05 for rms in checked.reading_rms_px)


def measured_frame() -> Data:
    """Test 5.3 as someone enters it who has no more than the pixels' pitch."""
    test = load_test("5.3")
    sensors = [SensorGeometry(f"cam{number}", 640) for number in range(1, 5)]
    return test.points_mm, np.asarray(test.readings_mm) / 0.0127, sensors


def cube_corners() -> Data:
    corners = np.array(np.meshgrid(*[[-250.0, 250.0]] * 3, indexing="ij")).reshape(3, 8).T
    return read_with_noise(MIDDLE_MM + corners, 0.05)


def slab() -> Data:
    """Sixteen points within 2 mm of a plane."""
    offsets = np.random.default_rng(0).uniform(-1.0, 1.0, (16, 3)) * [250.0, 250.0, 1.0]
    return read_with_noise(MIDDLE_MM + offsets, 0.05)


def nine_of_sixteen() -> Data:
    """The second sensor saw the nine nearest points only."""
    points = MIDDLE_MM + np.random.default_rng(0).uniform(-250.0, 250.0, (16, 3))
    points, readings, sensors = read_with_noise(points, 1.0)
    readings[points[:, 2].argsort()[9:], 1] = np.nan
    return points, readings, sensors


def read_with_noise(points: Array, sigma_px: float) -> Data:
    readings = project(rig(), points)
    noise = sigma_px * np.random.default_rng(1).standard_normal(readings.shape)
    return points, readings + noise, geometry(rig())


@pytest.mark.parametrize("data", [measured_frame, cube_corners, slab, nine_of_sixteen])
def test_auto_with_few_readings_calibrates_and_says_what_it_cannot_tell(data) -> None:
    found = calibrate(*data(), settings=CalibrationSettings("auto"))
    assert found.distortion is not None
    assert found.distortion.scale_range is not None
    assert re.search("do not tell|show no distortion|distort by about", found.distortion.reason)
    assert (np.linalg.eigvalsh(np.array(found.covariance)) > -1e-9).all()


def test_auto_with_few_readings_of_distorting_lenses_has_an_honest_covariance() -> None:
    """Fourteen points: a camera without distortion would be off by several of its sigmas."""
    models, points = distorted_rig(symmetric_terms(3)), field_points(14)
    exact = seen_readings(models, points)
    noisy = exact + 0.1 * np.random.default_rng(5).standard_normal(exact.shape)
    given = points, noisy, geometry_with_pitch(models), np.full(exact.shape, 0.1)
    unseen = field_points(100, seed=8)
    truth = CameraStack.of(models).project(unseen)

    def normalised(distortion: Distortion) -> float:
        found = calibrate(*given, CalibrationSettings(distortion))
        stack = CameraStack.of(found.models)
        by_parameter = stack.parameter_jacobian(unseen)
        blocks = stack.covariance_blocks(np.array(found.covariance))
        variance = np.einsum("nsp,spsq,nsq->ns", by_parameter, blocks, by_parameter)
        return float(((stack.project(unseen) - truth) ** 2 / variance).mean())

    assert normalised("auto") < 2.0
    assert normalised("none") > 4.0


def test_explicit_terms_that_the_points_cannot_bear_are_refused() -> None:
    models, points = distorted_rig(symmetric_terms(3)), field_points(40)
    readings = seen_readings(models, points)
    readings[18:, 1] = np.nan
    settings = CalibrationSettings(distortion="all-5")
    with pytest.raises(TooFewPoints, match=r"s2 saw 1\d control points; its 24 parameters"):
        calibrate(points, readings, geometry_with_pitch(models), settings=settings)


def test_explicit_terms_in_a_small_field_converge_with_the_covariance_of_their_prior() -> None:
    """A field of six degrees: the terms of one order are much the same there."""
    models = distorted_rig(symmetric_terms(3))
    small = MIDDLE_MM + 0.3 * (field_points(200) - MIDDLE_MM)
    readings = seen_readings(models, small)
    noisy = readings + 0.05 * np.random.default_rng(0).standard_normal(readings.shape)
    found = calibrate(
        small, noisy, geometry_with_pitch(models), settings=CalibrationSettings("all-5")
    )
    assert all(fit.rms_px < 0.06 for fit in found.sensors)
    sigma = np.sqrt(np.diag(np.array(found.covariance)))
    # Over six degrees nearly nothing tells u^5: its sigma is little below that of the prior, 9 % of
    # half the field at the pixels' edge.
    first = found.sensors[0].model
    half = 0.5 * first.pixels / first.principal_distance_px
    names = first.parameter_names
    assert 0.3 < sigma[len(names) - 1] / (0.09 / half**4) < 1.0


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
