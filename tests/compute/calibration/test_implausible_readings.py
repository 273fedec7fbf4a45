"""Readings that no sensor can have read are refused, with words; sound ones that look alike not."""

import numpy as np
import pytest

from compute.calibration.assessment.assess import calibrate_and_assess
from compute.calibration.calibrate import calibrate
from compute.calibration.result import Calibration
from compute.calibration.settings import CalibrationSettings
from compute.errors import ImplausibleReadings
from tests.compute.rig import control_points, geometry, project, rig

SIGMA = 0.1


def scene(count: int = 24, sensors: int = 4) -> tuple[np.ndarray, np.ndarray]:
    models, points = rig(sensors), control_points(count)
    noise = SIGMA * np.random.default_rng(8).standard_normal((count, sensors))
    return points, project(models, points) + noise


def run(
    points: np.ndarray, readings: np.ndarray, known: bool = False, **settings: str
) -> Calibration:
    sigma = np.full(readings.shape, SIGMA) if known else None
    sensors = geometry(rig(readings.shape[1]))
    return calibrate(points, readings, sensors, sigma, CalibrationSettings(**settings))  # type: ignore[arg-type]


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize(
    "settings", [{}, {"distortion": "auto"}, {"loss": "robust"}, {"labels": "report"}]
)
@pytest.mark.parametrize("bad", ["unrelated", "zeros", "copied", "constant"])
def test_implausible_readings_are_refused_under_all_settings(
    bad: str, settings: dict[str, str], known: bool
) -> None:
    points, readings = scene()
    if bad == "unrelated":
        readings[:, 1] = np.random.default_rng(1).uniform(0.0, 2047.0, len(points))
        words = "sensor s2 have nothing to do with the points"
    elif bad == "zeros":
        readings[[2, 5, 11], 1] = 0.0
        words = r"3 readings of sensor s2 are 0 .*points 3, 6, 12\): leave the cell empty"
    elif bad == "copied":
        readings[:, 3] = np.round(readings[:, 1], 2)
        words = "sensors s2 and s4 .* copy of the other"
    else:
        readings[:, 1] = 0.0
        words = "all 24 readings of sensor s2 are 0 px"
    with pytest.raises(ImplausibleReadings, match=words) as refused:
        run(points, readings, known, **settings)
    assert "s2" in refused.value.context["sensor" if bad != "copied" else "sensors"]


def test_readings_of_twelve_points_drawn_at_random_are_refused_where_the_noise_is_known() -> None:
    points, readings = scene(12)
    readings[:, 0] = np.random.default_rng(2).uniform(0.0, 2047.0, 12)
    with pytest.raises(ImplausibleReadings, match="sensor s1 have nothing to do"):
        run(points, readings, known=True)


def test_a_sensor_that_truly_read_0_is_accepted() -> None:
    models = rig()
    points = control_points(24)
    # Along the slit a reading is the same: three points at the lowest reading, which is made 0.
    lowest = points[np.argmin(project(models, points)[:, 1])]
    slit = models[1].rotation[1]
    points = np.vstack([points, lowest + 60.0 * slit, lowest - 80.0 * slit])
    readings = project(models, points) + SIGMA * np.random.default_rng(4).standard_normal((26, 4))
    readings[:, 1] = np.maximum(np.round(readings[:, 1] - readings[:, 1].min()), 0.0)
    assert (readings[:, 1] == 0.0).sum() > 1
    run(points, readings)
    # One zero alone is an outlier and not a habit.
    points, readings = scene()
    readings[4, 1] = 0.0
    run(points, readings, loss="robust")


def test_zeros_where_too_few_others_are_left_are_named_with_the_unrelated_readings() -> None:
    points, readings = scene(13)
    readings[:7, 1] = 0.0
    with pytest.raises(ImplausibleReadings, match="7 of them are 0: leave the cell empty"):
        run(points, readings, known=True)


def test_sensors_alike_with_noise_of_their_own_are_no_copies() -> None:
    points, readings = scene(sensors=3)
    noise = SIGMA * np.random.default_rng(3).standard_normal(len(points))
    readings[:, 2] = np.round(readings[:, 0] + noise, 2)
    readings[:, 0] = np.round(readings[:, 0], 2)
    run(points, readings)


@pytest.mark.parametrize("distortion", ["none", "auto"])
def test_one_and_two_sensors_are_calibrated_with_a_remark(distortion: str) -> None:
    points, readings = scene(sensors=2)
    for count in (1, 2):
        found = calibrate_and_assess(
            points,
            readings[:, :count],
            geometry(rig(2))[:count],
            None,
            CalibrationSettings(distortion),  # type: ignore[arg-type]
        )
        assert found.diagnosis is not None
        assert found.diagnosis.mean_sigma_mm is None
        assert any("cannot locate a marker" in remark for remark in found.diagnosis.remarks)


@pytest.mark.parametrize("labels", ["off", "report", "repair"])
def test_seven_points_are_calibrated_with_a_remark_and_their_labels_not_judged(
    labels: str,
) -> None:
    points, readings = scene(7)
    found = calibrate_and_assess(
        points,
        readings,
        geometry(rig()),
        None,
        CalibrationSettings(labels=labels),  # type: ignore[arg-type]
    )
    assert found.labels == ()
    assert found.diagnosis is not None
    said = [remark for remark in found.diagnosis.remarks if "leave no redundancy" in remark]
    assert len(said) == 4
