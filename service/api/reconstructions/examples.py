"""Examples of reconstruction bodies, with readings of the seeded simulated device."""

from typing import Any, Final

from service.api.calibrations.examples import simulated_points

_POINTS: Final = [
    {"name": point["name"], "readings": point["readings"]}
    for point in simulated_points([[0.0, 0.0, 0.0], [146.0, 0.0, 0.0], [0.0, 100.0, -250.0]])
]

NEW_RECONSTRUCTIONS: Final[dict[str, Any]] = {
    "check": {
        "summary": "Three points, readings without standard deviations, the active calibration",
        "value": {"id": "sim-check", "device_id": "sim", "points": _POINTS},
    },
    "weighted": {
        "summary": "One point, each reading with its standard deviation, a named calibration",
        "value": {
            "device_id": "sim",
            "calibration_id": "sim-nominal",
            "points": [
                {
                    "name": "tip",
                    "readings": {
                        sensor: {"position_px": reading, "sigma_px": 0.05}
                        for sensor, reading in _POINTS[1]["readings"].items()
                    },
                }
            ],
        },
    },
}
