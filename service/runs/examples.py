"""Examples of run bodies in the OpenAPI document; each works on a new server as it stands."""

from typing import Any, Final

import numpy as np

from service.calibrations.examples import NEW_CALIBRATIONS, simulated_points

_POINTS: Final = NEW_CALIBRATIONS["frame"]["value"]["points"]

NEW_CALIBRATION_RUNS: Final[dict[str, Any]] = {
    "frame": {
        "summary": "The calibration frame's 19 markers, as the simulated device reads them",
        "value": {
            "id": "sim-frame-run",
            "device": "sim",
            "points": _POINTS,
            "note": "Readings rounded to 0.01 px, without standard deviations",
        },
    },
}

# A grid around the working volume's centre: turned, so that no sensor sees points in line.
_TURNED: Final = np.array([[0.96, -0.20, 0.20], [0.23, 0.96, -0.15], [-0.16, 0.19, 0.97]])
_GRID: Final = np.stack(
    np.meshgrid(*[np.linspace(-120.0, 120.0, 5)] * 3, indexing="ij"), axis=-1
).reshape(-1, 3)

NEW_MAPPING_RUNS: Final[dict[str, Any]] = {
    "grid": {
        "summary": "125 places in the working volume, as the simulated device reads them",
        "value": {
            "id": "sim-map-run",
            "device": "sim",
            "calibration": "sim-nominal",
            "points": simulated_points(_GRID @ _TURNED.T),
            "note": "The simulator has no distortion: a map of nothing but rounding",
        },
    },
}
