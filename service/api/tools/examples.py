"""Examples of tools and registrations for the OpenAPI document."""

from typing import Any, Final

_LIVE: Final = (
    "`sim` shows no tool until its scene has one: "
    "PATCH it first with the scene of docs/how-to/tools.md."
)

NEW_TOOLS: Final[dict[str, Any]] = {
    "pointer": {
        "summary": "A pointer with four strobed markers, and a tip 150 mm in front of them",
        "value": {
            "id": "pointer",
            "device_id": "sim",
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
            "device_id": "sim",
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
            "device_id": "sim",
            "title": "Clamp",
            "strobe_markers": [4, 5, 6],
            "duration_s": 1,
        },
    },
}
CHANGES: Final[dict[str, Any]] = {
    "limit": {
        "summary": "Poses relative to the tracker, and a limit",
        "value": {"reference_id": None, "limits": {"tip_sd_mm": 0.5}},
    },
}
CALIBRATIONS: Final[dict[str, Any]] = {
    "calibration": {
        "summary": "Ten seconds of poses",
        "description": _LIVE,
        "value": {"duration_s": 10, "poses": 500, "apply": True},
    },
}
_BOX_MM: Final = [[x, y, z] for z in (-120, 0) for y in (-100, 100) for x in (-70, 70)]
_BOX: Final = [
    [0, 1, 3], [0, 3, 2], [4, 5, 7], [4, 7, 6], [0, 1, 5], [0, 5, 4],
    [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 3, 7], [1, 7, 5],
]  # fmt: skip
_ON_THE_BOX_MM: Final = [
    (-50, -80, 0), (50, -80, 0), (-50, 80, 0), (50, 80, 0), (0, 0, 0), (20, 50, 0),
    (-70, -80, -20), (-70, 80, -20), (-70, 10, -100), (70, -80, -20), (70, 80, -100),
    (70, 0, -60), (-50, -100, -20), (50, -100, -100), (0, 100, -20), (40, 100, -90),
]  # fmt: skip
NEW_REGISTRATIONS: Final[dict[str, Any]] = {
    "image": {
        "summary": "Five fiducials of an image, touched with the pointer",
        "value": {
            "id": "image",
            "device_id": "sim",
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
    "plate": {
        "summary": "Three markers on a plate, measured before",
        "value": {
            "id": "plate",
            "kind": "three-markers",
            "device_id": "sim",
            "measured_mm": [[10, -20, 1500], [110, -20, 1500], [10, 60, 1500]],
            "measured_sigma_mm": 0.05,
        },
    },
    "plate-now": {
        "summary": "Three strobed markers, held still for a second",
        "description": _LIVE,
        "value": {
            "id": "plate-now",
            "kind": "three-markers",
            "device_id": "sim",
            "strobe_markers": [4, 5, 6],
        },
    },
    "image-by-skin": {
        "summary": "The first example, refined by points on a surface of twelve triangles",
        "description": "A real surface has some thousand triangles, and the points are some "
        "hundred. Post the first example before.",
        "value": {
            "id": "image-by-skin",
            "kind": "surface",
            "device_id": "sim",
            "parent_id": "image",
            "surface": {"kind": "mesh", "vertices_mm": _BOX_MM, "triangles": _BOX},
            "points_mm": [
                [round(x + 10.3, 1), round(y - 20.2, 1), round(z + 1500.1, 1)]
                for x, y, z in _ON_THE_BOX_MM
            ],
        },
    },
}
NEW_POINTS: Final[dict[str, Any]] = {
    "landmark": {
        "summary": "A landmark in the tracker's frame, the tip held on it for half a second",
        "description": _LIVE,
        "value": {"name": "nasion", "frame_id": "tracker"},
    },
}
