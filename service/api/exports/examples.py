"""Examples of exports for the OpenAPI document; each works on a new server as it stands."""

from typing import Any, Final

NEW_EXPORT_RUNS: Final[dict[str, Any]] = {
    "table": {
        "summary": "Points, tracks and poses as rows of a CSV file",
        "value": {
            "id": "earlier-export",
            "device_id": "sim",
            "recording_id": "earlier.h5",
            "format": "csv",
            "result_id": "earlier-table",
        },
    },
}
EXPORT_IDS: Final[dict[str, Any]] = {"made": {"summary": "one that was made", "value": "walk"}}
