"""Examples of radiometric calibrations; each works on a new server as it stands."""

from typing import Any, Final

import numpy as np

from compute.signal.capture_statistics import CaptureStatistics
from service.api.radiometric_calibrations.content import estimate_sensors
from service.api.radiometric_calibrations.frame_statistics import FrameStatistics

NEW_RADIOMETRIC_CAPTURES: Final[dict[str, Any]] = {
    "guided": {
        "summary": "Dark frames, then flat ones at three levels of light",
        "description": "`sim` shows a bar; give it the scene `even-light` before each capture.",
        "value": {
            "id": "sim-radiometric-capture",
            "device": "sim",
            "settings": {"frames": 64, "levels": 3},
        },
    },
}
