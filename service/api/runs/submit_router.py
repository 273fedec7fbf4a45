"""REST resources that submit runs: /api/v1/calibration-runs, /mapping-runs, ..."""

from typing import Annotated, Any

from fastapi import APIRouter, Body
from sqlalchemy.orm import Session

from compute.errors import (
    DegeneratePoints,
    DuplicatePoint,
    InvalidParameter,
    ReadingOutsideSensor,
    TooFewPoints,
    UnknownSensor,
)
from service.api.calibrations.schema import ControlPoint
from service.api.calibrations.store import check_unused
from service.api.correction_tables import store as tables
from service.api.devices.store import sensors_of_row
from service.api.exports.examples import NEW_EXPORT_RUNS
from service.api.exports.router import ExportsDep
from service.api.exports.schema import NewExportRun
from service.api.json_body import JsonRoute, JsonTypes
from service.api.openapi import raises
from service.api.recordings.recording_manager import RecordingsDep
from service.api.runs.examples import (
    NEW_CALIBRATION_RUNS,
    NEW_MAPPING_RUNS,
    NEW_SELF_CALIBRATION_RUNS,
    NEW_UPDATE_RUNS,
)
from service.api.runs.kinds import calibration, export, mapping, self_calibration, update
from service.api.runs.kinds.calibration import Request as CalibrationRequest
from service.api.runs.kinds.mapping import Request as MappingRequest
from service.api.runs.kinds.self_calibration import Request as SelfCalibrationRequest
from service.api.runs.kinds.update import Request as UpdateRequest
from service.api.runs.references import resolve_calibration, resolve_markers, resolve_points
from service.api.runs.schema import NewCalibrationRun, NewMappingRun, NewUpdateRun, Run
from service.api.runs.self_calibration_schema import NewSelfCalibrationRun
from service.api.runs.submission import SubmissionDep
from service.database.models import DeviceRow
from service.problems.errors import (
    Busy,
    CalibrationExists,
    CalibrationOfAnotherDevice,
    CalibrationRetired,
    CaptureIncomplete,
    CaptureOfAnotherDevice,
    CorrectionTableExists,
    ExportExists,
    InsufficientStorage,
    NoActiveCalibration,
    RecordingInProgress,
    RunExists,
    SensorsChanged,
    UnknownCalibration,
    UnknownCapture,
    UnknownCorrectionTable,
    UnknownDevice,
    UnknownDriftCheck,
    UnknownRecording,
    UnknownTool,
)

router = APIRouter(prefix="/api/v1", route_class=JsonRoute)

NewCalibrationRunBody = Annotated[
    NewCalibrationRun, JsonTypes(), Body(openapi_examples=NEW_CALIBRATION_RUNS)
]
NewMappingRunBody = Annotated[NewMappingRun, JsonTypes(), Body(openapi_examples=NEW_MAPPING_RUNS)]
NewUpdateRunBody = Annotated[NewUpdateRun, JsonTypes(), Body(openapi_examples=NEW_UPDATE_RUNS)]
NewExportRunBody = Annotated[NewExportRun, JsonTypes(), Body(openapi_examples=NEW_EXPORT_RUNS)]
NewSelfCalibrationRunBody = Annotated[
    NewSelfCalibrationRun, JsonTypes(), Body(openapi_examples=NEW_SELF_CALIBRATION_RUNS)
]


@router.operation(
    "POST /calibration-runs",
    "create-calibration-run",
    "Calibrate a device beside the requests",
    tags=["runs"],
    status_code=202,
)
@raises(UnknownDevice, UnknownCapture, RunExists, CalibrationExists, CaptureOfAnotherDevice)
@raises(CaptureIncomplete, TooFewPoints, DegeneratePoints, DuplicatePoint, UnknownSensor)
@raises(ReadingOutsideSensor, InvalidParameter, Busy)
def create_calibration_run(request: NewCalibrationRunBody, acceptance: SubmissionDep) -> Run:
    """Calibrate in a process of its own: follow the run at the header `Location`.

    The calibration is stored when it is done, under the run's `result_id`, and not activated.
    """

    def stored(session: Session, device: DeviceRow) -> dict[str, Any]:
        check_unused(session, request.result_id)
        return calibration.request_of(
            CalibrationRequest(
                points=_points(session, request),
                sensors=sensors_of_row(device),
                settings=request.settings(),
                result_id=request.result_id,
                capture=request.capture,
                note=request.note,
            )
        )

    return acceptance.run("calibration", request, stored)


def _points(session: Session, request: NewCalibrationRun | NewMappingRun) -> list[ControlPoint]:
    return resolve_points(
        session,
        request.device,
        request.points,
        request.capture,
        incomplete=request.allow_incomplete,
    )


@router.operation(
    "POST /mapping-runs",
    "create-mapping-run",
    "Map the volume beside the requests",
    tags=["runs"],
    status_code=202,
)
@raises(UnknownDevice, UnknownCalibration, UnknownCapture, RunExists, CorrectionTableExists)
@raises(CalibrationOfAnotherDevice, CaptureOfAnotherDevice, CaptureIncomplete, CalibrationRetired)
@raises(NoActiveCalibration, SensorsChanged, TooFewPoints, DegeneratePoints, DuplicatePoint)
@raises(UnknownSensor, ReadingOutsideSensor, InvalidParameter, Busy)
def create_mapping_run(request: NewMappingRunBody, acceptance: SubmissionDep) -> Run:
    """Build a correction table in a process of its own: follow the run at the header `Location`.

    The table is stored when it is done, under the run's `result_id`, and not activated.
    """

    def stored(session: Session, device: DeviceRow) -> dict[str, Any]:
        tables.check_unused(session, request.result_id)
        parent = resolve_calibration(session, request.device, request.calibration)
        return mapping.request_of(
            MappingRequest(
                calibration=parent.id,
                points=_points(session, request),
                sensors=sensors_of_row(device),
                settings=request.settings(),
                point_sigma_mm=request.point_sigma_mm,
                result_id=request.result_id,
                capture=request.capture,
                note=request.note,
            ),
            parent,
        )

    return acceptance.run("mapping", request, stored)


@router.operation(
    "POST /self-calibration-runs",
    "create-self-calibration-run",
    "Calibrate a device without known coordinates",
    tags=["runs"],
    status_code=202,
)
@raises(UnknownDevice, UnknownCalibration, RunExists, CalibrationExists, CalibrationOfAnotherDevice)
@raises(CalibrationRetired, NoActiveCalibration, SensorsChanged, TooFewPoints, DegeneratePoints)
@raises(UnknownSensor, ReadingOutsideSensor, InvalidParameter, Busy)
def create_self_calibration_run(
    request: NewSelfCalibrationRunBody, acceptance: SubmissionDep
) -> Run:
    """Calibrate from a wand, a rigid body or a frame at unknown places, in a process of its own.

    It starts from a calibration that is near; the scale comes from the lengths given. The new
    calibration is stored when it is done, under the run's `result_id`, and not activated.
    """

    def stored(session: Session, device: DeviceRow) -> dict[str, Any]:
        check_unused(session, request.result_id)
        start = resolve_calibration(session, request.device, request.start)
        return self_calibration.request_of(
            SelfCalibrationRequest(
                start=start.id,
                recordings=request.recordings,
                sensors=sensors_of_row(device),
                datum=request.datum,
                result_id=request.result_id,
                note=request.note,
            ),
            start,
        )

    return acceptance.run("self-calibration", request, stored)


@router.operation(
    "POST /update-runs",
    "create-update-run",
    "Bring a calibration up to date by still markers",
    tags=["runs"],
    status_code=202,
)
@raises(UnknownDevice, UnknownCalibration, UnknownCapture, UnknownDriftCheck, RunExists)
@raises(CalibrationExists, CalibrationOfAnotherDevice, CaptureOfAnotherDevice, CaptureIncomplete)
@raises(CalibrationRetired, NoActiveCalibration, SensorsChanged, TooFewPoints, DuplicatePoint)
@raises(UnknownSensor, ReadingOutsideSensor, InvalidParameter, Busy)
def create_update_run(request: NewUpdateRunBody, acceptance: SubmissionDep) -> Run:
    """Re-calibrate quickly: what a few still markers say has changed, and the rest as it was.

    Eight markers do where a whole frame was measured before. The new calibration names its parent;
    it is stored when it is done, under the run's `result_id`, and not activated.
    """

    def stored(session: Session, device: DeviceRow) -> dict[str, Any]:
        check_unused(session, request.result_id)
        sensors = sensors_of_row(device)
        parent, markers, sigma = resolve_markers(session, request, sensors)
        return update.request_of(
            UpdateRequest(
                calibration=parent.id,
                markers=markers,
                device_sensors=sensors,
                position_sigma_mm=sigma,
                sensors=request.sensors,
                allowance=request.allowance,
                result_id=request.result_id,
                capture=request.capture,
                drift_check=request.drift_check,
                note=request.note,
            ),
            parent,
        )

    return acceptance.run("update", request, stored)


@router.operation(
    "POST /export-runs",
    "create-export-run",
    "Export a recording beside the requests",
    tags=["recordings"],
    status_code=202,
)
@raises(UnknownDevice, UnknownRecording, UnknownTool, UnknownCalibration, UnknownCorrectionTable)
@raises(RunExists, ExportExists, RecordingInProgress, InvalidParameter, InsufficientStorage, Busy)
def create_export_run(
    request: NewExportRunBody,
    acceptance: SubmissionDep,
    recordings: RecordingsDep,
    exports: ExportsDep,
) -> Run:
    """Follow markers and tools through a recording, in a process of its own, and write a file.

    Follow the run at the header `Location`; when it has succeeded, its `result` is the export, and
    `result` with `/file` behind it the file. A calibration that is not the recording's makes its
    points, tracks and poses anew.
    """
    recordings.finished_path(request.recording)
    frames = recordings.get(request.recording).frames
    if frames is not None:
        export.check_length(request.recording, frames)
    exports.check_space()

    def stored(session: Session, device: DeviceRow) -> dict[str, Any]:
        exports.check_unused(request.result_id)
        return export.request_of(session, device, request)

    return acceptance.run("export", request, stored)
