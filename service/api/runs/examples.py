"""Examples of run bodies in the OpenAPI document; each works on a new server as it stands."""

from typing import Any, Final

import numpy as np

from compute.camera.stack import CameraStack
from hardware.simulated.simulated_rig import WORKING_CENTRE_MM, simulated_sensor_models
from service.api.calibrations.examples import NEW_CALIBRATIONS, simulated_points
from service.api.drift_checks.examples import STILL_POINTS

_POINTS: Final = NEW_CALIBRATIONS["frame"]["value"]["points"]

NEW_CALIBRATION_RUNS: Final[dict[str, Any]] = {
    "frame": {
        "summary": "The calibration frame's 19 markers, as the simulated device reads them",
        "value": {
            "id": "sim-frame-run",
            "device_id": "sim",
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
            "device_id": "sim",
            "calibration_id": "sim-nominal",
            "points": simulated_points(_GRID @ _TURNED.T),
            "note": "The simulator has no distortion: a map of nothing but rounding",
        },
    },
}

NEW_UPDATE_RUNS: Final[dict[str, Any]] = {
    "frame": {
        "summary": "Eight of the frame's markers, which stand still, read again",
        "value": {
            "id": "sim-update-run",
            "device_id": "sim",
            "calibration_id": "sim-nominal",
            "points": STILL_POINTS,
            "position_sigma_mm": 0.05,
        },
    },
}

_WAND_MM: Final = (0.0, 300.0)
_POSES: Final = 60


def simulated_wand(poses: int = _POSES) -> list[dict[str, list[float]]]:
    """Return what the simulated device reads of a wand waved through its volume, to 0.01 px."""
    generator = np.random.default_rng(20)
    ways = generator.normal(size=(poses, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    middle = np.asarray(WORKING_CENTRE_MM) + generator.uniform(-180.0, 180.0, (poses, 3))
    ends = middle[:, None] + ways[:, None] * np.array([[-150.0], [150.0]])
    models = simulated_sensor_models()
    readings = CameraStack.of(models).project(ends.reshape(-1, 3)).round(2).reshape(poses, 2, -1)
    return [
        {model.name: pose[:, place].tolist() for place, model in enumerate(models)}
        for pose in readings
    ]


NEW_SELF_CALIBRATION_RUNS: Final[dict[str, Any]] = {
    "wand": {
        "summary": "A wand of 300 mm, 60 times as the simulated device reads it",
        "value": {
            "id": "sim-wand-run",
            "device_id": "sim",
            "recordings": [
                {
                    "target": {"kind": "wand", "position_mm": list(_WAND_MM)},
                    "poses": simulated_wand(),
                }
            ],
        },
    },
}
