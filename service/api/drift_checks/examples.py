"""Examples of drift checks in the OpenAPI document; they work on a new server as they stand."""

from typing import Any, Final

from service.api.calibrations.examples import NEW_CALIBRATIONS

STILL_POINTS: Final = NEW_CALIBRATIONS["frame"]["value"]["points"][:8]

NEW_DRIFT_CHECKS: Final[dict[str, Any]] = {
    "frame": {
        "summary": "Eight markers of the calibration frame, as the simulated device reads them",
        "value": {
            "id": "sim-drift",
            "points": STILL_POINTS,
            "position_sigma_mm": 0.05,
            "note": "Readings rounded to 0.01 px",
        },
    },
}
