"""REST resources /api/v1/tools and /api/v1/tool-captures."""

from typing import Annotated, Final, Literal

import numpy as np
from fastapi import Body, Query, Response

from compute.errors import (
    InvalidParameter,
)
from compute.pose.rigid_body import RigidBody
from service.api.base_models import SLUG_PATTERN
from service.api.devices.device_service import DeviceService, DeviceServiceDep
from service.api.devices.store import get_device
from service.api.inputs import (
    DatabaseDep,
    DeviceFilter,
    JsonTypes,
    LiveDep,
    id_in_path,
)
from service.api.openapi import ResourceRouter, raises
from service.api.paging import BY_ID, Page, PagingDep, page_of
from service.api.preconditions import OptionalIfMatch, RequiredIfMatch
from service.api.tools import concurrency_limits, store
from service.api.tools.examples import (
    CALIBRATIONS,
    CAPTURED_TOOLS,
    CHANGES,
    NEW_TOOLS,
)
from service.api.tools.pose_query import frame_of, newest_pose
from service.api.tools.rigid_bodies import check_geometry
from service.api.tools.schema import (
    NewCapturedTool,
    NewTool,
    NewToolCalibration,
    Origin,
    Pose,
    Tool,
    ToolCalibration,
    ToolChange,
)
from service.api.tools.tip_limit import max_tip_sd_mm

router = ResourceRouter("/api/v1", "tools")

NewToolBody = Annotated[NewTool, JsonTypes(), Body(openapi_examples=NEW_TOOLS)]
CapturedBody = Annotated[NewCapturedTool, JsonTypes(), Body(openapi_examples=CAPTURED_TOOLS)]
ChangeBody = Annotated[ToolChange, JsonTypes(), Body(openapi_examples=CHANGES)]
CalibrationBody = Annotated[NewToolCalibration, JsonTypes(), Body(openapi_examples=CALIBRATIONS)]
ToolPath = Annotated[str, id_in_path("The tool's id.", "pointer", "pointer")]
_CAPTURED: Final = "of the example that captures it"
SpunPath = Annotated[str, id_in_path("The tool's id.", "clamp", "clamp", _CAPTURED)]


@router.operation("GET /tools", "list-tools", "List tools")
def list_tools(
    database: DatabaseDep, paging: PagingDep, device_id: DeviceFilter = None
) -> Page[Tool]:
    """Tools by id."""
    with database.read() as session:
        return page_of(session, store.tools(device_id), paging, store.document, BY_ID)


@router.operation("POST /tools", "create-tool", "Create a tool of known geometry", status_code=201)
@raises("unknown-device", "unknown-tool", "tool-exists", "too-many-tools", "markers-taken")
@raises("invalid-parameter", "degenerate-tool", "indistinguishable-tools")
def create_tool(request: NewToolBody, device_service: DeviceServiceDep, response: Response) -> Tool:
    """Markers must not be collinear, and the tool must not look like another one of the device.

    A running device tracks it from its next frames on.
    """
    strobed = None if request.strobe_markers is None else tuple(request.strobe_markers)
    body = _body(request, strobed)
    return _add(device_service, request, body, Origin(kind="given"), response)


@router.operation(
    "POST /tool-captures", "capture-tool", "Define a tool by showing it", status_code=201
)
@raises("unknown-device", "unknown-tool", "tool-exists", "too-many-tools", "markers-taken", "busy")
@raises("device-not-running", "no-active-calibration", "calibration-switched", "nothing-seen")
@raises("not-stationary", "too-few-poses", "invalid-parameter", "degenerate-tool")
@raises("indistinguishable-tools")
def capture_tool(
    request: CapturedBody,
    database: DatabaseDep,
    live: LiveDep,
    device_service: DeviceServiceDep,
    response: Response,
) -> Tool:
    """Average what a running device sees of the tool while it is held still.

    Its origin becomes the middle of its markers, its axes their principal axes.
    """
    from service.api.tools.geometry_capture import capture_geometry

    with database.read() as session:
        get_device(session, request.device_id)
        store.check_new(session, request, request.strobe_markers)
    with concurrency_limits.captures:
        body, origin = capture_geometry(live, request)
    return _add(device_service, request, body, origin, response)


def _body(request: NewTool, strobed: tuple[int, ...] | None) -> RigidBody:
    if strobed is not None and len(strobed) != len(request.markers_mm):
        raise InvalidParameter(
            f"there are {len(request.markers_mm)} markers and {len(strobed)} strobe_markers; give "
            "one number for each marker, or null"
        )
    return RigidBody(request.id, np.array(request.markers_mm, float), strobed, request.tip_mm)


def _add(
    device_service: DeviceService,
    request: NewTool | NewCapturedTool,
    body: RigidBody,
    origin: Origin,
    response: Response,
) -> Tool:
    with device_service.tools_change(request.device_id) as session:
        store.check_new(session, request, body.strobe_markers)
        check_geometry(body, store.tools_of(session, request.device_id))
        made = store.document(store.add_tool(session, request, body, origin))
    response.headers["Location"] = f"/api/v1/tools/{made.id}"
    return made


@router.operation("GET /tools/{tool_id}", "get-tool", "Read a tool")
@raises("unknown-tool")
def get_tool(tool_id: ToolPath, database: DatabaseDep) -> Tool:
    """One tool."""
    with database.read() as session:
        return store.document(store.TOOLS.get(session, tool_id))


@router.operation(
    "PATCH /tools/{tool_id}", "change-tool", "Change a tool's title, tip, limits or reference"
)
@raises("unknown-tool", "invalid-parameter")
@raises("precondition-failed", "precondition-required", "invalid-precondition")
def change_tool(
    tool_id: ToolPath,
    request: ChangeBody,
    database: DatabaseDep,
    device_service: DeviceServiceDep,
    expected: RequiredIfMatch,
) -> Tool:
    """Change some members. Markers never change: delete the tool and create another."""
    with device_service.tools_change(_device_of(database, tool_id)) as session:
        row = store.TOOLS.get(session, tool_id)
        expected.check(store.document(row))
        return store.document(store.change_tool(session, row, request))


@router.operation("DELETE /tools/{tool_id}", "delete-tool", "Delete a tool")
@raises("unknown-tool", "tool-in-use", "precondition-failed", "invalid-precondition")
def delete_tool(
    tool_id: ToolPath,
    database: DatabaseDep,
    device_service: DeviceServiceDep,
    expected: OptionalIfMatch,
) -> None:
    """Delete a tool and its calibrations; refused while something is relative to it."""
    with device_service.tools_change(_device_of(database, tool_id)) as session:
        row = store.TOOLS.get(session, tool_id)
        expected.check(store.document(row))
        store.delete_tool(session, row)


@router.operation("GET /tools/{tool_id}/pose", "get-tool-pose", "Where a tool is now")
@raises("device-elsewhere")
@raises("unknown-tool", "invalid-parameter")
def get_tool_pose(
    tool_id: ToolPath,
    database: DatabaseDep,
    live: LiveDep,
    frame_id: Annotated[
        str | None,
        Query(
            pattern=SLUG_PATTERN,
            description="`tracker`, a tool, or a registration; left out: the tool's reference.",
        ),
    ] = None,
) -> Pose:
    """The newest pose, with its uncertainty; where there is none, the status and the reason.

    Always answered with 200: that a tool is not seen is a pose's status and no problem.
    """
    with database.read() as session:
        tool = store.TOOLS.get(session, tool_id)
        wanted = frame_of(session, tool, frame_id)
        return newest_pose(live, tool, wanted, max_tip_sd_mm(session, tool))


@router.operation(
    "POST /tools/{tool_id}/pivot-calibrations",
    "calibrate-pivot",
    "Find a tool's tip by pivoting it",
    status_code=201,
)
@raises("unknown-tool", "tool-replaced", "busy", "device-not-running", "calibration-switched")
@raises("too-few-poses", "too-little-rotation", "high-error", "no-convergence", "invalid-parameter")
def calibrate_pivot(
    tool_id: ToolPath,
    request: CalibrationBody,
    database: DatabaseDep,
    live: LiveDep,
    device_service: DeviceServiceDep,
) -> ToolCalibration:
    """Hold the tip in a dimple and turn the tool about it, in all directions, until this answers.

    What was found is kept, and given to the tool unless `apply` is false. What does not do says
    why: too few poses, too little rotation, an error too large.
    """
    return _calibrated(tool_id, "pivot", request, database, live, device_service)


@router.operation(
    "POST /tools/{tool_id}/spin-calibrations",
    "calibrate-spin",
    "Find a tool's long axis by spinning it",
    status_code=201,
)
@raises("unknown-tool", "tool-replaced", "busy", "device-not-running", "calibration-switched")
@raises("too-few-poses", "too-little-rotation", "high-error", "no-convergence", "invalid-parameter")
def calibrate_spin(
    tool_id: SpunPath,
    request: CalibrationBody,
    database: DatabaseDep,
    live: LiveDep,
    device_service: DeviceServiceDep,
) -> ToolCalibration:
    """Turn the tool about its long axis, in a hole or between fingers, until this answers."""
    return _calibrated(tool_id, "spin", request, database, live, device_service)


def _calibrated(
    tool_id: str,
    kind: Literal["pivot", "spin"],
    request: NewToolCalibration,
    database: DatabaseDep,
    live: LiveDep,
    device_service: DeviceServiceDep,
) -> ToolCalibration:
    from service.api.tools.tip_calibration import calibrate_tip

    with database.read() as session:
        tool = store.TOOLS.get(session, tool_id)
        device, reference, created = tool.device_id, tool.reference_id, tool.created_at
    with concurrency_limits.captures:
        result = calibrate_tip(live, device, tool_id, reference, kind, request)
    with device_service.tools_change(device) as session:
        tool = store.get_same_tool(session, tool_id, created)
        made = store.add_calibration(session, tool, kind, request, result)
        return store.calibration_document(made)


@router.operation(
    "GET /tools/{tool_id}/calibrations",
    "list-tool-calibrations",
    "Pivot and spin calibrations of a tool",
)
@raises("unknown-tool")
def list_tool_calibrations(
    tool_id: ToolPath, database: DatabaseDep, paging: PagingDep
) -> Page[ToolCalibration]:
    """Results of pivot and spin calibrations of a tool, newest first."""
    with database.read() as session:
        store.TOOLS.get(session, tool_id)
        return page_of(session, store.calibrations(tool_id), paging, store.calibration_document)


def _device_of(database: DatabaseDep, tool_id: str) -> str:
    with database.read() as session:
        return store.TOOLS.get(session, tool_id).device_id
