"""Parameters that many paths and queries have: ids, filters, pages."""

from typing import Annotated, Any

from fastapi import Path, Query

from service.api.base_models import SLUG_PATTERN


def id_in_path(
    description: str, example: str, name: str, summary: str = "of the example body"
) -> Any:
    """Return the parameter of a path that is an id.

    Args:
        description: what it is the id of.
        example: an id that works on a new server, or with the example body.
        name: of the example.
        summary: where the example's id comes from.
    """
    examples: dict[str, Any] = {name: {"summary": summary, "value": example}}
    return Path(pattern=SLUG_PATTERN, description=description, openapi_examples=examples)


DevicePath = Annotated[str, id_in_path("The device's id.", "sim", "sim", "the simulated device")]
CalibrationPath = Annotated[
    str, id_in_path("The calibration's id.", "sim-nominal", "nominal", "the simulator's own")
]
DeviceFilter = Annotated[
    str | None,
    Query(pattern=SLUG_PATTERN, description="Only those of this device.", examples=["sim"]),
]
ExpectedActive = Annotated[
    str | None,
    Query(
        pattern=SLUG_PATTERN,
        description="The calibration that you believe to be active now; where another one is, "
        "nothing is changed (409).",
    ),
]
Limit = Annotated[int, Query(ge=1, le=200, description="Most items to return.")]
Offset = Annotated[int, Query(ge=0, le=2**31 - 1, description="Items to skip.")]
