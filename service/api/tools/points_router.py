"""REST resource /api/v1/tools/{id}/points: positions digitised with a tool's tip."""

from typing import Annotated

from fastapi import Body

from service.api.inputs import DatabaseDep, JsonTypes, LiveDep
from service.api.openapi import ResourceRouter, raises
from service.api.tools import concurrency_limits
from service.api.tools.dependency_check import dependencies
from service.api.tools.examples import NEW_POINTS
from service.api.tools.point_schema import MeasuredPoint, NewPoint
from service.api.tools.pose_query import frame_of
from service.api.tools.rigid_bodies import tip_of
from service.api.tools.router import ToolPath
from service.api.tools.store import TOOLS
from service.api.tools.tip_limit import tip_limit_of
from service.database.models import RegistrationRow
from service.problems.errors import (
    TipNotCalibrated,
    ToolReplaced,
)

router = ResourceRouter("/api/v1/tools", "tools")

NewPointBody = Annotated[NewPoint, JsonTypes(), Body(openapi_examples=NEW_POINTS)]


@router.operation("POST /{tool_id}/points", "measure-point", "Measure a point with a tool's tip")
@raises("unknown-tool", "tool-replaced", "registration-replaced", "tip-not-calibrated", "busy")
@raises("device-not-running", "no-active-calibration", "calibration-switched", "nothing-seen")
@raises("not-stationary", "too-few-poses", "invalid-parameter")
def measure_point(
    tool_id: ToolPath, request: NewPointBody, database: DatabaseDep, live: LiveDep
) -> MeasuredPoint:
    """Hold the tip on the point until this answers: when it was still for long enough.

    The answer has the mean place with its covariance, the tip's own included. It is not kept.
    """
    from service.api.tools.digitise import Pointer, digitise_point

    with database.read() as session:
        tool = TOOLS.get(session, tool_id)
        tip = tip_of(tool)
        if tip.position_mm is None:
            raise TipNotCalibrated(
                f'tool "{tool_id}" has no tip, and its origin is no place to touch with; pivot it '
                "(pivot-calibrations), or give it tip_mm",
                tool_id=tool_id,
            )
        frame = frame_of(session, tool, request.frame_id)
        pointer = Pointer(tool_id, tool.device_id, tip_limit_of(session, tool))
        registered = session.get(RegistrationRow, frame.name)
        relied = dependencies(
            session, [tool_id, frame.reference], [] if registered is None else [registered]
        )
    with concurrency_limits.digitisations:
        found = digitise_point(live, pointer, frame, request)
    with database.read() as session:
        relied.check(session)
        if tip_of(TOOLS.get(session, tool_id)) != tip:
            raise ToolReplaced(
                f'the tip of tool "{tool_id}" was changed while a point was measured with it; '
                "measure it again",
                tool_id=tool_id,
            )
    return MeasuredPoint.model_validate(
        found
        | {
            "name": request.name,
            "tool_id": tool_id,
            "device_id": pointer.device,
            "frame_id": frame.name,
            "tool_calibration_id": tip.tool_calibration_id,
        }
    )
