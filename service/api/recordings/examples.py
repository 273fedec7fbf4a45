"""Examples of recordings for the OpenAPI document; all work on a new server."""

from typing import Any, Final

NEW_RECORDINGS: Final[dict[str, Any]] = {
    "whole": {
        "summary": "Lines and results, for a minute",
        "value": {"name": "first.h5", "contents": ["lines", "results"], "seconds": 60.0},
    },
}
BEGUN: Final[dict[str, Any]] = {"begun": {"summary": "begun before", "value": "first.h5"}}
FINISHED: Final[dict[str, Any]] = {
    "finished": {"summary": "one in the folder", "value": "earlier.h5"}
}
