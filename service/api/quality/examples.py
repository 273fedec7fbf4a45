"""Examples of quality checks in the OpenAPI document; they work on a new server as they stand."""

from typing import Any, Final

NEW_CHECKS: Final[dict[str, Any]] = {
    "bar": {
        "summary": "The simulated bar's two markers, which turn on a circle of 146 mm radius",
        "value": {
            "id": "sim-bar",
            "kind": "point-to-point",
            "markers": [0, 1],
            "reference_mm": 292.0,
            "reference_sigma_mm": 0.05,
            "seconds": 2.0,
            "tolerance_mm": 1.0,
        },
    },
}

WATCHES: Final[dict[str, Any]] = {
    "ten-minutes": {"summary": "A value each ten minutes", "value": {"interval_s": 600.0}},
}
