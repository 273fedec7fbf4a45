"""Label errors are found and repaired; clean data have none."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.calibration.calibrate import calibrate
from compute.calibration.mislabels.detector import find_label_errors
from compute.calibration.mislabels.repair import exclude, repair
from compute.camera.field_distortion import FieldDistortion
from compute.camera.stack import CameraStack
from compute.errors import DuplicatePoint, InvalidParameter, TooFewPoints
from tests.compute.rig import control_points, geometry, project, rig
from validation.labels.case import ASKED, BESIDE, CLEAN, ask, findings_of
from validation.labels.simulated_data import Errors, LabelFrame, random_frames, wide_frames
from validation.thesis_data import DFW_V500, load_test

SENSORS = geometry(rig())


def noisy(points: np.ndarray, seed: int = 3) -> np.ndarray:
    exact = project(rig(), points)
    return exact + np.random.default_rng(seed).standard_normal(exact.shape)


def ones(readings: np.ndarray) -> np.ndarray:
    return np.ones(readings.shape)


@pytest.mark.slow
@pytest.mark.parametrize("question", ASKED, ids=lambda q: f"{q.frame}-{q.name}")
def test_errors_are_found_exactly(question: object) -> None:
    """A part of `lumiline reproduce labels`, which has 100 frames of each kind."""
    outcome = ask(question, 2, 90)  # type: ignore[arg-type]
    assert (outcome.exact, outcome.surplus) == (2, 0)


@pytest.mark.slow
@pytest.mark.parametrize("question", CLEAN, ids=lambda q: f"{q.frame}-{q.sigma_given}")
def test_clean_frames_stay_clean(question: object) -> None:
    assert ask(question, 2, 91).exact == 2  # type: ignore[arg-type]


@pytest.mark.slow
def test_exchanged_points_are_named_as_such() -> None:
    for question in (BESIDE[1], BESIDE[2]):  # two pairs of points, and one of a random frame
        assert ask(question, 1, 92).exact == 1, question


@pytest.mark.slow
def test_what_is_missed_is_less_likely_than_what_is_found() -> None:
    """Errors of just ten deviations: a search can do no better than the likeliest."""
    outcome = ask(BESIDE[-2], 4, 93)
    assert 0 < outcome.likelier == outcome.frames - outcome.exact


@pytest.mark.slow
def test_measured_frame_at_3_m() -> None:
    test = load_test("5.3")
    readings = np.column_stack([s.to_px(test.readings_mm[:, k]) for k, s in enumerate(DFW_V500)])
    sensors = [scale.geometry for scale in DFW_V500]
    report = find_label_errors(test.points_mm, readings, sensors)
    (finding,) = report.findings
    assert (finding.kind, finding.sensor, finding.points) == ("exchanged", "cam4", (14, 16))
    assert finding.probability > 0.99
    repaired, _ = repair(report.findings, sensors, readings)
    before, after = (
        calibrate(test.points_mm, each, sensors).sensors[3] for each in (readings, repaired)
    )
    assert before.rms_px > 12.0
    assert after.rms_px < 1.2
    # The middle of the sensor, 240 px: what the thesis missed.
    assert (
        abs(after.model.principal_point_px - 240.0)
        < 30.0
        < 150.0
        < abs(before.model.principal_point_px - 240.0)
    )


def test_a_cycle_of_three_labels() -> None:
    points = control_points(24)
    readings = noisy(points)
    mixed = readings.copy()
    mixed[[4, 11, 17], 1] = readings[[11, 17, 4], 1]  # the reading labelled 5 is point 12's
    (finding,) = find_label_errors(points, mixed, SENSORS, ones(mixed)).findings
    assert (finding.kind, finding.sensor, finding.points) == ("exchanged", "s2", (5, 12, 18))
    repaired, _ = repair([finding], SENSORS, mixed)
    np.testing.assert_array_equal(repaired, readings)


def test_a_wrong_label() -> None:
    points = control_points(24)
    readings = noisy(points)
    readings[9, 2] = np.nan
    mixed = readings.copy()
    mixed[9, 2], mixed[3, 2] = readings[3, 2], np.nan
    sigma = ones(mixed)
    (finding,) = find_label_errors(points, mixed, SENSORS, sigma).findings
    assert (finding.kind, finding.sensor, finding.points) == ("wrong-label", "s3", (10, 4))
    repaired, mended_sigma = repair([finding], SENSORS, mixed, sigma)
    np.testing.assert_array_equal(np.isnan(repaired), np.isnan(readings))
    assert np.nanmax(np.abs(repaired - readings)) == 0.0
    assert mended_sigma is not None


@pytest.mark.slow
def test_deviations_stated_too_small_are_no_label_errors() -> None:
    """A misfit of many deviations everywhere is the model's, not the labels'."""
    points = control_points(30)
    readings, two = noisy(points)[:, :2], SENSORS[:2]
    report = find_label_errors(points, readings, two, 0.02 * ones(readings))
    assert report.findings == ()
    assert all(0.6 < sigma < 1.6 for sigma in report.sigma_px)
    readings[[2, 8], 0] = readings[[8, 2], 0]
    (finding,) = find_label_errors(points, readings, two, 0.02 * ones(readings)).findings
    assert (finding.sensor, finding.points) == ("s1", (3, 9))


def test_what_is_off_and_by_how_much() -> None:
    points = control_points(40)
    readings = noisy(points)
    readings[6, 3] += 50.0
    (finding,) = find_label_errors(points, readings, SENSORS, ones(readings)).findings
    assert finding.kind == "outlier"
    residual_px, normalised_residual = finding.residual_px[0], finding.normalised_residual[0]
    assert residual_px is not None
    assert normalised_residual is not None
    assert 45.0 < residual_px < 55.0
    assert 30.0 < normalised_residual < residual_px  # more than a reading's own deviation, 1 px


@pytest.mark.slow
@settings(max_examples=3, deadline=None)
@given(st.integers(0, 10**6))
def test_excluding_and_repairing_leave_the_rest_alone(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frame: LabelFrame = next(iter(random_frames(rng, 1, "random", "exchanged", 2)))
    findings = findings_of(frame)
    if not frame.found_exactly(findings):
        return
    about = {(p - 1, int(str(f.sensor)[1]) - 1) for f in findings for p in f.points}
    left, _ = exclude(findings, frame.sensors, frame.readings_px)
    assert {(int(i), int(j)) for i, j in np.argwhere(np.isnan(left))} == about
    repaired, _ = repair(findings, frame.sensors, frame.readings_px)
    elsewhere = np.ones(repaired.shape, dtype=bool)
    elsewhere[tuple(np.array(sorted(about)).T)] = False
    np.testing.assert_array_equal(repaired[elsewhere], frame.readings_px[elsewhere])
    np.testing.assert_array_equal(np.sort(repaired, axis=0), np.sort(frame.readings_px, axis=0))
    models = calibrate(frame.points_mm, repaired, list(frame.sensors)).models
    assert np.abs(CameraStack.of(models).project(frame.points_mm) - repaired).max() < 5.0


def test_the_search_repeats_itself() -> None:
    rng = np.random.default_rng(8)
    frame = next(iter(random_frames(rng, 1, "thesis", "outlier", 3)))
    assert findings_of(frame) == findings_of(frame)


@pytest.mark.slow
def test_progress_is_told_and_may_stop_it() -> None:
    points = control_points(19)
    told: list[tuple[float, str]] = []
    find_label_errors(points, noisy(points), SENSORS, progress=lambda f, s: told.append((f, s)))
    assert [fraction for fraction, _ in told] == [0.0, 0.25, 0.5, 0.75]
    assert told[1][1] == "labels of s2"

    def stop(_fraction: float, _stage: str) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        find_label_errors(points, noisy(points), SENSORS, progress=stop)


def test_bad_input_is_refused() -> None:
    points = control_points(19)
    readings = noisy(points)
    with pytest.raises(TooFewPoints, match="s1"):
        find_label_errors(points[:6], readings[:6], SENSORS)
    with pytest.raises(DuplicatePoint):
        find_label_errors(np.vstack([points, points[:1]]), np.vstack([readings] * 2)[:20], SENSORS)


def test_findings_of_other_data_are_refused() -> None:
    points = control_points(24)
    readings, two = noisy(points)[:, :2], SENSORS[:2]
    readings[3, 1] += 60.0
    findings = find_label_errors(points, readings, two, ones(readings)).findings
    with pytest.raises(InvalidParameter, match="point 4; there are points 1 to 3"):
        repair(findings, two, readings[:3])
    with pytest.raises(InvalidParameter, match='sensor "s2"; the sensors are s1'):
        exclude(findings, two[:1], readings[:, :1])


@pytest.mark.slow
def test_a_lens_with_distortion_is_no_label_error() -> None:
    """Without its columns a distortion of tenths of a pixel names readings at the field's edge."""
    bent = tuple(
        replace(model, distortion=FieldDistortion(((3, 0), (1, 2)), (0.05, 0.035)))
        for model in rig()[:2]
    )
    rng = np.random.default_rng(1)
    points = np.array([0.0, 0.0, 1500.0]) + rng.uniform(-1.0, 1.0, (45, 3)) * [340.0, 340.0, 250.0]
    readings = CameraStack.of(bent).project(points)
    readings = readings + 0.1 * rng.standard_normal(readings.shape)
    readings[(readings < 0.0) | (readings > 2047.0)] = np.nan
    sigma = np.full(readings.shape, 0.1)
    report = find_label_errors(points, readings, SENSORS[:2], sigma)
    assert report.findings == ()
    assert report.sigma_px == pytest.approx((0.1, 0.1), rel=0.5)
    first, second = np.flatnonzero(np.isfinite(readings[:, 1]))[[3, 7]].tolist()
    readings[[first, second], 1] = readings[[second, first], 1]
    (finding,) = find_label_errors(points, readings, SENSORS[:2], sigma).findings
    assert (finding.kind, finding.sensor) == ("exchanged", "s2")
    assert finding.points == (first + 1, second + 1)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "number"), [("none", 0), ("exchanged", 1), ("outlier", 1)])
def test_a_wide_field_of_strong_lenses(kind: Errors, number: int) -> None:
    """A distortion of tens of pixels at 0.02 to 1 px of noise: a lens of five fixed columns fails.

    Without a fitted lens every frame has findings in it.
    """
    (frame,) = wide_frames(np.random.default_rng(7000), 1, 40, kind, number)
    sigma = np.full(frame.readings_px.shape, frame.sigma_px)
    report = find_label_errors(frame.points_mm, frame.readings_px, frame.sensors, sigma)
    assert frame.found_exactly(report.findings), report.findings
    assert report.sigma_px == pytest.approx((frame.sigma_px,) * 4, rel=0.5)
