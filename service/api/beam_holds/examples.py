"""Examples of beam holds for the OpenAPI document."""

from typing import Any, Final

NEW_BEAM_HOLDS: Final[dict[str, Any]] = {
    "chest": {
        "summary": "Three strobed markers on a chest, each within 3 mm of its place",
        "value": {
            "id": "chest",
            "device_id": "sim",
            "title": "Chest",
            "watch": {"kind": "strobed-markers", "markers": [4, 5, 6]},
            "limits": {"shift_mm": 3.0},
            "rules": {"max_gap_s": 0.1, "settle_s": 0.5, "latched": True},
        },
    },
    "head": {
        "summary": "A target 80 mm below a tool that is fixed to the head, and its place",
        "description": "The tool `patient` is that of the examples of tools.",
        "value": {
            "id": "head",
            "device_id": "sim",
            "title": "Head",
            "watch": {"kind": "tool", "tool_id": "patient", "target_mm": [45, -80, 30]},
            "limits": {"shift_mm": 1.5, "axis_mm": [1, 1, 1], "rotation_rad": 0.02},
            "reference": {
                "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
                "translation_mm": [0, 0, 1500],
            },
        },
    },
}
CHANGES: Final[dict[str, Any]] = {
    "limits": {
        "summary": "Other limits, and a hold that ends by itself",
        "value": {"limits": {"shift_mm": 2.0}, "rules": {"settle_s": 1.0, "latched": False}},
    },
}
REFERENCES: Final[dict[str, Any]] = {
    "captured": {
        "summary": "The mean of the next 20 frames of each marker",
        "description": "The device shows the markers only once its scene has them: PATCH it first, "
        "as docs/how-to/beam-holds.md says.",
        "value": {"frames": 20, "timeout_s": 5},
    },
    "given": {
        "summary": "Places from a plan",
        "value": {"given": {"positions_mm": [[0, 0, 1500], [90, 0, 1500], [0, 50, 1500]]}},
    },
}
BEAM_HOLD_IDS: Final[dict[str, Any]] = {
    "chest": {"summary": "of the first example body", "value": "chest"}
}
