"""Examples of tools and registrations for the OpenAPI document."""

from typing import Any, Final

_LIVE: Final = (
    "`sim` shows no tool until its scene has one: PATCH it first with the scene of docs/tools.md."
)

NEW_TOOLS: Final[dict[str, Any]] = {
    "pointer": {
        "summary": "A pointer with four strobed markers, and a tip 150 mm in front of them",
        "value": {
            "id": "pointer",
            "device": "sim",
            "title": "Pointer",
            "markers_mm": [[0, 0, 0], [80, 0, 0], [0, 60, 0], [20, 15, 40]],
            "strobe_markers": [0, 1, 2, 3],
            "tip_mm": [-150, 0, 0],
        },
    },
    "patient": {
        "summary": "A reference that is fixed to the patient, its markers lit together",
        "value": {
            "id": "patient",
            "device": "sim",
            "title": "Patient reference",
            "markers_mm": [[0, 0, 0], [110, 0, 0], [0, 70, 0], [45, 50, 30]],
        },
    },
}
CAPTURED_TOOLS: Final[dict[str, Any]] = {
    "clamp": {
        "summary": "A clamp with three strobed markers, held still for a second",
        "description": _LIVE,
        "value": {
            "id": "clamp",
            "device": "sim",
            "title": "Clamp",
            "strobe_markers": [4, 5, 6],
            "seconds": 1,
        },
    },
}
CHANGES: Final[dict[str, Any]] = {
    "limit": {
        "summary": "Poses relative to the tracker, and a limit",
        "value": {"reference": None, "limits": {"tip_sd_mm": 0.5}},
    },
}
CALIBRATIONS: Final[dict[str, Any]] = {
    "calibration": {
        "summary": "Ten seconds of poses",
        "description": _LIVE,
        "value": {"seconds": 10, "poses": 500, "apply": True},
    },
}
TOOL_IDS: Final[dict[str, Any]] = {
    "pointer": {"summary": "of the example body", "value": "pointer"}
}
SPUN_IDS: Final[dict[str, Any]] = {
    "clamp": {"summary": "of the example that captures it", "value": "clamp"}
}
NEW_REGISTRATIONS: Final[dict[str, Any]] = {
    "image": {
        "summary": "Five fiducials of an image, touched with the pointer",
        "value": {
            "id": "image",
            "device": "sim",
            "fiducials": [
                {"name": name, "frame_mm": frame, "measured_mm": measured}
                for name, frame, measured in (
                    ("nasion", [0, 0, 0], [10.1, -20.0, 1500.0]),
                    ("left", [-70, 10, -90], [-60.0, -10.1, 1410.0]),
                    ("right", [70, 10, -90], [80.0, -9.9, 1410.1]),
                    ("crown", [0, 120, -80], [10.0, 100.0, 1420.0]),
                    ("chin", [0, -100, 15], [10.0, -120.0, 1514.9]),
                )
            ],
            "measured_sigma_mm": 0.1,
            "targets": [{"name": "target", "frame_mm": [0, 30, -60]}],
        },
    },
}
REGISTRATION_IDS: Final[dict[str, Any]] = {
    "image": {"summary": "of the example body", "value": "image"}
}
