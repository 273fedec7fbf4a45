"""REST resource /api/v1/runs: a run of each kind is posted to the path of its kind."""

from collections.abc import Callable
from typing import Annotated, Any

from fastapi import Body, Depends, Response
from sqlalchemy.orm import Session

from service.api.base_models import from_attributes
from service.api.calibrations.schema import ControlPoint
from service.api.calibrations.store import CALIBRATIONS
from service.api.correction_tables import store as tables
from service.api.devices.store import get_device, sensors_of_row
from service.api.exports.examples import NEW_EXPORT_RUNS
from service.api.exports.router import ExportsDep
from service.api.exports.schema import NewExportRun
from service.api.inputs import DatabaseDep, GatewayDep, JsonTypes, RunsDep, SettingsDep
from service.api.openapi import ResourceRouter, raises
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
from service.api.runs.kinds.self_calibration_schema import NewSelfCalibrationRun
from service.api.runs.kinds.update import Request as UpdateRequest
from service.api.runs.references import (
    resolve_calibration,
    resolve_markers,
    resolve_points,
    resolve_recordings,
)
from service.api.runs.schema import (
    NewCalibrationRun,
    NewMappingRun,
    NewUpdateRun,
    Run,
    run_document,
)
from service.database.models import DeviceRow
from service.jobs import store
from service.jobs.store import Kind

router = ResourceRouter("/api/v1/runs", "runs")


class Submission:
    """Takes the runs of one request."""

    def __init__(
        self,
        database: DatabaseDep,
        runs: RunsDep,
        settings: SettingsDep,
        gateway: GatewayDep,
        response: Response,
    ) -> None:
        self._gateway = gateway
        self._database, self._runs, self._response = database, runs, response
        self._max_waiting = settings.runs_waiting

    def run(
        self,
        kind: Kind,
        device_id: str,
        run_id: str | None,
        stored: Callable[[Session, DeviceRow], dict[str, Any]],
        *,
        files: bool = False,
    ) -> Run:
        """Store a run, wake the run manager, and answer with the run's location.

        Args:
            kind: what is computed.
            device_id: of the device.
            run_id: the run's id; None: the server's choice.
            stored: checks the request, the device being locked, and returns it as it is stored.
            files: whether it reads or writes files of this server's data directory.

        Raises:
            UnknownDevice, RunExists, Busy: as they say, and what ``stored`` raises.
        """
        with self._database.write() as session:
            device = get_device(session, device_id, lock=True)
            row = store.add_run(
                session,
                kind,
                device.id,
                stored(session, device),
                self._max_waiting,
                run_id,
                self._gateway.directory_id if files and self._gateway.shared else None,
            )
            made = run_document(row)
        self._runs.submitted()
        self._response.headers["Location"] = f"/api/v1/runs/{made.id}"
        return made


SubmissionDep = Annotated[Submission, Depends()]


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
    "POST /calibration",
    "create-calibration-run",
    "Calibrate a device beside the requests",
    status_code=202,
)
@raises("unknown-device", "unknown-capture", "run-exists", "calibration-exists")
@raises("capture-of-another-device", "capture-incomplete", "too-few-points", "coplanar-points")
@raises("duplicate-point", "unknown-sensor", "reading-outside-sensor", "implausible-readings")
@raises("invalid-parameter", "busy")
def create_calibration_run(request: NewCalibrationRunBody, submission: SubmissionDep) -> Run:
    """Calibrate in a process of its own: follow the run at the header `Location`.

    The calibration is stored when it is done, under the run's `result_id`, and not activated.
    """

    def stored(session: Session, device: DeviceRow) -> dict[str, Any]:
        CALIBRATIONS.check_unused(session, request.result_id)
        points, sensors = _points(session, request), sensors_of_row(device)
        settings = request.settings()
        return calibration.request_of(
            from_attributes(
                CalibrationRequest, request, points=points, sensors=sensors, settings=settings
            )
        )

    return submission.run("calibration", request.device_id, request.id, stored)


def _points(session: Session, request: NewCalibrationRun | NewMappingRun) -> list[ControlPoint]:
    return resolve_points(
        session,
        request.device_id,
        request.points,
        request.capture_id,
        incomplete=request.allow_incomplete,
    )


@router.operation(
    "POST /mapping",
    "create-mapping-run",
    "Map the volume beside the requests",
    status_code=202,
)
@raises("unknown-device", "unknown-calibration", "unknown-capture", "run-exists")
@raises("correction-table-exists", "calibration-of-another-device", "capture-of-another-device")
@raises("capture-incomplete", "calibration-retired", "no-active-calibration", "sensors-changed")
@raises("too-few-points", "coplanar-points", "duplicate-point", "unknown-sensor")
@raises("reading-outside-sensor", "invalid-parameter", "busy")
def create_mapping_run(request: NewMappingRunBody, submission: SubmissionDep) -> Run:
    """Build a correction table in a process of its own: follow the run at the header `Location`.

    The table is stored when it is done, under the run's `result_id`, and not activated.
    """

    def stored(session: Session, device: DeviceRow) -> dict[str, Any]:
        tables.TABLES.check_unused(session, request.result_id)
        parent = resolve_calibration(session, request.device_id, request.calibration_id)
        return mapping.request_of(
            from_attributes(
                MappingRequest,
                request,
                calibration_id=parent.id,
                points=_points(session, request),
                sensors=sensors_of_row(device),
                settings=request.settings(),
            ),
            parent,
        )

    return submission.run("mapping", request.device_id, request.id, stored)


@router.operation(
    "POST /self-calibration",
    "create-self-calibration-run",
    "Calibrate a device without known coordinates",
    status_code=202,
)
@raises("unknown-device", "unknown-calibration", "unknown-wave-capture", "run-exists")
@raises("calibration-exists", "calibration-of-another-device", "capture-of-another-device")
@raises("capture-incomplete", "calibration-retired", "no-active-calibration")
@raises("sensors-changed", "too-few-points", "coplanar-points", "unknown-sensor")
@raises("reading-outside-sensor", "invalid-parameter", "busy")
def create_self_calibration_run(
    request: NewSelfCalibrationRunBody, submission: SubmissionDep
) -> Run:
    """Calibrate from a wand, a rigid body or a frame at unknown places, in a process of its own.

    Its readings are given as `recordings`, or taken by the server from the running device: see
    `/api/v1/wave-captures`.

    It starts from a calibration that is near, or, with `initial` `readings`, from nothing; the
    scale comes from the lengths given. The new calibration is stored when it is done, under the
    run's `result_id`, and not activated; warnings stand in its note and in its report.
    """

    def stored(session: Session, device: DeviceRow) -> dict[str, Any]:
        CALIBRATIONS.check_unused(session, request.result_id)
        sensors = sensors_of_row(device)
        recordings = resolve_recordings(session, request, sensors)
        start = None
        if request.initial == "start" or request.start_calibration_id is not None:
            start = resolve_calibration(session, request.device_id, request.start_calibration_id)
        return self_calibration.request_of(
            from_attributes(
                SelfCalibrationRequest,
                request,
                start_calibration_id=None if start is None else start.id,
                recordings=recordings,
                sensors=sensors,
            ),
            start,
        )

    return submission.run("self-calibration", request.device_id, request.id, stored)


@router.operation(
    "POST /update",
    "create-update-run",
    "Bring a calibration up to date by still markers",
    status_code=202,
)
@raises("unknown-device", "unknown-calibration", "unknown-capture", "unknown-drift-check")
@raises("run-exists", "calibration-exists", "calibration-of-another-device")
@raises("capture-of-another-device", "capture-incomplete", "calibration-retired")
@raises("no-active-calibration", "sensors-changed", "too-few-points", "duplicate-point")
@raises("unknown-sensor", "reading-outside-sensor", "invalid-parameter", "busy")
def create_update_run(request: NewUpdateRunBody, submission: SubmissionDep) -> Run:
    """Re-calibrate quickly: what a few still markers say has changed, and the rest as it was.

    Eight markers do where a whole frame was measured before. The new calibration names its parent;
    it is stored when it is done, under the run's `result_id`, and not activated.
    """

    def stored(session: Session, device: DeviceRow) -> dict[str, Any]:
        CALIBRATIONS.check_unused(session, request.result_id)
        sensors = sensors_of_row(device)
        parent, markers, sigma = resolve_markers(session, request, sensors)
        return update.request_of(
            from_attributes(
                UpdateRequest,
                request,
                calibration_id=parent.id,
                markers=markers,
                device_sensors=sensors,
                position_sigma_mm=sigma,
            ),
            parent,
        )

    return submission.run("update", request.device_id, request.id, stored)


@router.operation(
    "POST /export",
    "create-export-run",
    "Export a recording beside the requests",
    status_code=202,
)
@raises("unknown-device", "unknown-recording", "unknown-tool", "unknown-calibration")
@raises("unknown-correction-table", "run-exists", "export-exists", "recording-in-progress")
@raises("invalid-parameter", "insufficient-storage", "busy", "file-elsewhere")
def create_export_run(
    request: NewExportRunBody,
    submission: SubmissionDep,
    recordings: RecordingsDep,
    exports: ExportsDep,
) -> Run:
    """Follow markers and tools through a recording, in a process of its own, and write a file.

    Follow the run at the header `Location`; when it has succeeded, its `result_path` is that of
    the export, and with `/file` behind it that of the file. A calibration that is not the
    recording's makes its points, tracks and poses anew.
    """
    recordings.finished_path(request.recording_id)
    frames = recordings.get(request.recording_id).frames_written
    if frames is not None:
        export.check_length(request.recording_id, frames)
    exports.check_space()

    def stored(session: Session, device: DeviceRow) -> dict[str, Any]:
        exports.check_unused(request.result_id)
        return export.request_of(session, device, request)

    return submission.run("export", request.device_id, request.id, stored, files=True)
