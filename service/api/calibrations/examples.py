"""Examples of calibration bodies: control points as the seeded simulated device reads them."""

from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from compute.camera.stack import CameraStack
from hardware.simulated.calibration_target import calibration_target_points_mm
from hardware.simulated.simulated_rig import WORKING_CENTRE_MM, simulated_sensor_models

_NAMES: Final = tuple(model.name for model in simulated_sensor_models())


def simulated_points(offsets_mm: ArrayLike) -> list[dict[str, Any]]:
    """Return points around the working volume's centre with their readings, to 0.01 px.

    Args:
        offsets_mm: from the centre, shape (N, 3) [mm].
    """
    points = np.asarray(WORKING_CENTRE_MM) + np.asarray(offsets_mm, dtype=np.float64)
    readings = CameraStack.of(simulated_sensor_models()).project(points).round(2)
    return [
        {
            "name": f"P{index + 1}",
            "position_mm": point,
            "readings": dict(zip(_NAMES, row, strict=True)),
        }
        for index, (point, row) in enumerate(zip(points.tolist(), readings.tolist(), strict=True))
    ]


_FRAME: Final = simulated_points(calibration_target_points_mm())

NEW_CALIBRATIONS: Final[dict[str, Any]] = {
    "frame": {
        "summary": "The calibration frame's 19 markers, as the simulated device reads them",
        "value": {
            "id": "sim-frame",
            "device_id": "sim",
            "points": _FRAME,
            "note": "Readings rounded to 0.01 px, without standard deviations",
        },
    },
    "spare": {
        "summary": "The same again, to which nothing will refer",
        "value": {"id": "sim-frame-spare", "device_id": "sim", "points": _FRAME},
    },
}
