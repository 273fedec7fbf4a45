"""Parameters that many paths and queries have: ids, filters, pages."""

from typing import Annotated

from fastapi import Path, Query

from service.api.base_models import SLUG_PATTERN

DevicePath = Annotated[
    str,
    Path(
        pattern=SLUG_PATTERN,
        description="The device's id.",
        openapi_examples={"sim": {"summary": "the simulated device", "value": "sim"}},
    ),
]
CalibrationPath = Annotated[
    str,
    Path(
        pattern=SLUG_PATTERN,
        description="The calibration's id.",
        openapi_examples={"nominal": {"summary": "the simulator's own", "value": "sim-nominal"}},
    ),
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
