"""Examples of device bodies in the OpenAPI document; each works on a fresh server as it stands."""

from typing import Any, Final

NEW_DEVICES: Final[dict[str, Any]] = {
    "simulated": {
        "summary": "A simulated bar of sensors that sees a calibration frame at rest",
        "value": {
            "id": "bench",
            "title": "Simulated bench",
            "source": {
                "kind": "simulated",
                "settings": {"scene": {"kind": "calibration-frame"}, "frame_rate_hz": 200},
            },
        },
    },
    "profile": {
        "summary": "The thesis's four cameras, simulated: their optics, light and detector",
        "value": {
            "id": "thesis-cameras",
            "title": "The thesis's cameras at 1 m",
            "source": {
                "kind": "profile",
                "profile": "thesis-5.9",
                "settings": {
                    "scene": {"kind": "still-points", "points_mm": [[0, -97, 1133]]},
                    "optics": "exact",
                    "frame_rate_hz": 10,
                },
            },
        },
    },
    "external": {
        "summary": "Four sensors that a program of yours reads",
        "value": {
            "id": "lab-bar",
            "title": "Sensor bar in the laboratory",
            "source": {
                "kind": "external",
                "sensors": [
                    {"name": name, "pixels": 2048, "pitch_um": 14}
                    for name in ("left", "middle", "right", "vertical")
                ],
            },
        },
    },
}

CHANGES: Final[dict[str, Any]] = {
    "rename": {"summary": "Another title", "value": {"title": "Simulator in the entrance hall"}},
    "autostart": {"summary": "Start it with the server", "value": {"autostart": True}},
}
