"""Examples of run bodies in the OpenAPI document; each works on a new server as it stands."""

from typing import Any, Final

from service.calibrations.examples import NEW_CALIBRATIONS

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
