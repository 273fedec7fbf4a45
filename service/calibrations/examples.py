"""Examples of calibration bodies: control points as the seeded simulated device reads them."""

from typing import Any, Final

import numpy as np

from compute.camera.stack import CameraStack
from hardware.simulated.bar import WORKING_CENTRE_MM, simulated_sensor_models

_SIDE_MM: Final = 200.0
_NAMES: Final = tuple(model.name for model in simulated_sensor_models())


def simulated_points(offsets_mm: np.typing.ArrayLike) -> list[dict[str, Any]]:
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


def _box() -> list[list[float]]:
    """Corners of a box, the middles of its four upright edges, its centre: 13 points."""
    half = _SIDE_MM / 2
    ends = (-half, half)
    upright = [[x, y, z] for x in ends for y in (-half, 0.0, half) for z in ends]
    return [*upright, [0.0, 0.0, 0.0]]


NEW_CALIBRATIONS: Final[dict[str, Any]] = {
    "box": {
        "summary": "13 points on a box, as the simulated device reads them",
        "value": {
            "id": "sim-box",
            "device": "sim",
            "points": simulated_points(_box()),
            "note": "Box of 200 mm, readings without deviations",
        },
    },
    "published-method": {
        "summary": "The same points by the published iterative DLT",
        "value": {
            "id": "sim-box-dlt",
            "device": "sim",
            "method": "dlt-iterative",
            "points": simulated_points(_box()),
        },
    },
}
