"""Examples of wave captures; each works on a new server as it stands."""

from typing import Any, Final

NEW_WAVE_CAPTURES: Final[dict[str, Any]] = {
    "wand": {
        "summary": "A wand of 300 mm, whose ends are the strobed markers 0 and 1",
        "description": "Let `sim` show the scene `waved-wand` first; its default is a bar that "
        "turns in a plane, which is never enough (docs/how-to/calibration.md).",
        "value": {
            "id": "sim-wave-capture",
            "device_id": "sim",
            "target": {"kind": "wand", "position_mm": [0.0, 300.0]},
            "markers": [0, 1],
        },
    },
}
