"""Examples of capture sessions; each works on a new server as it stands."""

from typing import Any, Final

import numpy as np

from hardware.simulated.calibration_target import calibration_target_points_mm
from hardware.simulated.simulated_rig import WORKING_CENTRE_MM

_PLACES: Final = (np.asarray(WORKING_CENTRE_MM) + calibration_target_points_mm()).round(3).tolist()

NEW_CAPTURES: Final[dict[str, Any]] = {
    "frame": {
        "summary": "The calibration frame's markers, lit one after the other, each by its number",
        "description": "The markers of `sim` are on a bar that turns, which no capture takes for "
        "resting. Put `bench` in its place, after the examples that make it and start it: then "
        "19 times `capture`, and a calibration run of the session.",
        "value": {
            "id": "sim-capture",
            "device_id": "sim",
            "targets": [
                {"name": f"P{number + 1}", "position_mm": place, "marker": number}
                for number, place in enumerate(_PLACES)
            ],
            "settings": {"frames": 20},
        },
    },
}
