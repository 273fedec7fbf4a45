"""Two calibrations compared: in their deviations, over the volume, on the same points."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from compute.calibration.calibrate import calibrate
from compute.camera.model import SensorGeometry
from compute.camera.stack import CameraStack
from hardware.simulated.simulated_rig import WORKING_CENTRE_MM, simulated_sensor_models
from service.api.calibrations.comparison import CalibrationWithControlPoints, compare
from service.api.calibrations.examples import NEW_CALIBRATIONS

SIGMA_PX = 0.05


def measured(
    seed: int, count: int = 60, sigma_px: float = SIGMA_PX
) -> CalibrationWithControlPoints:
    generator = np.random.default_rng(seed)
    models = simulated_sensor_models()
    points = np.asarray(WORKING_CENTRE_MM) + generator.uniform(-150, 150, (count, 3))
    readings = CameraStack.of(models).project(points)
    readings += generator.normal(0, sigma_px, readings.shape)
    geometry = [SensorGeometry(model.name, model.pixels) for model in models]
    given = np.full(readings.shape, sigma_px)
    return CalibrationWithControlPoints(
        calibrate(points, readings, geometry, given), points, readings, None
    )


def test_calibrations_of_independent_readings_differ_by_their_deviations():
    squares: list[float] = []
    places: list[float] = []
    for seed in range(0, 24, 2):
        found = compare(measured(seed), measured(seed + 1))
        squares += [(row.sigmas or np.nan) ** 2 for row in found.parameters]
        assert found.positions is not None
        places.append((found.positions.rms_sigma or np.nan) ** 2)
    # 12 x 28 parameters, correlated within a sensor; 12 volumes of few independent directions.
    assert np.mean(squares) == pytest.approx(1.0, abs=0.35)
    assert np.mean(places) == pytest.approx(1.0, abs=0.5)


def test_a_calibration_is_the_same_as_itself():
    one = measured(3)
    found = compare(one, one)
    assert all(row.difference == pytest.approx(0.0, abs=1e-12) for row in found.parameters)
    assert found.positions is not None
    assert found.positions.max_mm < 1e-6
    assert [row.better for row in found.observations] == ["neither", "neither"]


def test_a_moved_frame_is_seen_as_one():
    one = measured(3)
    turn = Rotation.from_rotvec((0.0, 0.002, 0.0))
    shift = np.array([1.0, 0.0, 0.0])
    # The same cameras in a frame that is turned and shifted: x = R X + t with X = Q Y + s.
    models = []
    for model in one.calibration.models:
        moved = model.rotation @ shift
        vector = Rotation.from_matrix(model.rotation @ turn.as_matrix()).as_rotvec().tolist()
        models.append(
            replace(
                model,
                rotation_vector_rad=(vector[0], vector[1], vector[2]),
                offset_x_mm=model.offset_x_mm + float(moved[0]),
                offset_z_mm=model.offset_z_mm + float(moved[2]),
            )
        )
    fits = tuple(
        replace(fit, model=model)
        for fit, model in zip(one.calibration.sensors, models, strict=True)
    )
    other = CalibrationWithControlPoints(
        replace(one.calibration, sensors=fits), one.points_mm, one.readings_px, None
    )
    found = compare(one, other).positions
    assert found is not None
    assert found.rms_mm > 1.0
    assert found.aligned_rms_mm < 1e-6


def test_the_better_one_is_named_by_points_that_neither_was_fitted_to():
    good, bad = measured(1), measured(2, count=12, sigma_px=1.0)
    check = measured(7, count=200)
    judged = replace(bad, points_mm=check.points_mm, readings_px=check.readings_px)
    [_, on_check] = compare(good, judged).observations
    assert (on_check.of, on_check.points, on_check.better) == ("other", 200, "one")
    assert on_check.one_rms_mm < 0.5 * on_check.other_rms_mm


@pytest.mark.slow
def test_stored_calibrations_are_compared(client: Any):
    for example in NEW_CALIBRATIONS.values():
        assert client.post("/api/v1/calibrations", json=example["value"]).status_code == 201
    found = client.get("/api/v1/calibrations/sim-nominal/compare/sim-frame").json()
    assert (found["calibration_id"], found["other_calibration_id"]) == ("sim-nominal", "sim-frame")
    comparison = found["comparison"]
    names = ("vertical", "horizontal", "diagonal-rising", "diagonal-falling")
    assert {row["sensor"] for row in comparison["parameters"]} == set(names)
    # The frame's readings are exact to 0.01 px.
    assert comparison["positions"]["rms_mm"] < 0.05
    [on_frame] = comparison["observations"]
    assert (on_frame["of"], on_frame["points"], on_frame["left_out"]) == ("other", 19, True)
    sensors = [{"name": name, "pixels": 2048, "pitch_um": 14.0} for name in names]
    source = {"kind": "external", "sensors": sensors}
    client.post("/api/v1/devices", json={"id": "bar", "title": "Bar", "source": source})
    body = NEW_CALIBRATIONS["frame"]["value"] | {"id": "of-bar", "device_id": "bar"}
    assert client.post("/api/v1/calibrations", json=body).status_code == 201
    refused = client.get("/api/v1/calibrations/sim-frame/compare/of-bar")
    assert refused.json()["type"] == "/problems/calibration-of-another-device"
