"""A stored calibration with its control points as arrays."""

import numpy as np

from service.api.calibrations.calibration_content import result_of
from service.api.calibrations.comparison import CalibrationWithControlPoints
from service.api.calibrations.observations import observations
from service.api.calibrations.schema import ControlPoint
from service.api.devices.sensor import Sensor
from service.database.models import CalibrationRow


def with_control_points(row: CalibrationRow, sensors: list[Sensor]) -> CalibrationWithControlPoints:
    """Return a calibration of these sensors with the points that it is judged on."""
    points = [ControlPoint.model_validate(point) for point in row.content["points"]]
    held = observations(points, sensors)
    left_out = row.errors["leave_one_out"]
    return CalibrationWithControlPoints(
        result_of(row.content),
        np.array([point.position_mm for point in points], dtype=np.float64).reshape(-1, 3),
        held.readings_px,
        None
        if left_out is None
        else np.array(
            [(np.nan,) * 3 if row is None else row for row in left_out["differences_mm"]],
            dtype=np.float64,
        ).reshape(-1, 3),
    )
