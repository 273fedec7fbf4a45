"""Examples of radiometric calibrations; each works on a new server as it stands."""

from typing import Any, Final

import numpy as np

from compute.signal.radiometric_calibration import BadPixel, RadiometricCalibration
from hardware.simulated.simulated_rig import PIXELS, simulated_sensor_models

NEW_RADIOMETRIC_CAPTURES: Final[dict[str, Any]] = {
    "guided": {
        "summary": "Dark frames, then flat ones at three levels of light",
        "description": "`sim` shows a bar; give it the scene `even-light` before each capture "
        "(docs/how-to/radiometric-calibration.md).",
        "value": {
            "id": "sim-radiometric-capture",
            "device_id": "sim",
            "settings": {"frames": 64, "levels": 3},
        },
    },
}


def _document() -> dict[str, Any]:
    """Return the calibration of one simulated sensor, of which one pixel is hot."""
    pixel = np.arange(PIXELS)
    bad = np.zeros(PIXELS, np.uint8)
    bad[100] = BadPixel.HOT
    return RadiometricCalibration(
        dark_offset=np.where(pixel == 100, 300.0, 64.0),
        response=np.where(pixel % 2 == 0, 1.01, 0.99),
        gain_electrons_per_count=12.0,
        read_noise_counts=2.5,
        saturation_counts=4095,
        linearity=(0.0, 0.0),
        bad_pixels=bad,
        captures=448,
        dsnu_counts=0.0,
        prnu=0.01,
        response_sigma=0.0004,
    ).to_document()


NEW_RADIOMETRIC_CALIBRATIONS: Final[dict[str, Any]] = {
    "document": {
        "summary": "Estimated elsewhere: even and odd pixels of one sensor differ",
        "value": {
            "id": "sim-radiometric",
            "device_id": "sim",
            "source": {
                "kind": "document",
                "sensors": {simulated_sensor_models()[0].name: _document()},
            },
            "note": "As lumiline radiometric-calibration estimate writes it",
        },
    },
    "spare": {
        "summary": "The same again, to which nothing will refer",
        "value": {
            "id": "sim-radiometric-spare",
            "device_id": "sim",
            "source": {
                "kind": "document",
                "sensors": {simulated_sensor_models()[0].name: _document()},
            },
        },
    },
}
