"""REST resource /api/v1/calibrations."""

from typing import Annotated

from fastapi import Body, Query
from starlette.responses import JSONResponse

from service.api.calibrations import store
from service.api.calibrations.calibration_content import result_of, run_calibration
from service.api.calibrations.examples import NEW_CALIBRATIONS
from service.api.calibrations.schema import (
    CalibrationDocument,
    CalibrationSummary,
    ComparisonDocument,
    NewCalibration,
    State,
)
from service.api.devices.device_service import DeviceServiceDep
from service.api.devices.schema import check_sensors
from service.api.devices.store import get_device, sensors_of_row
from service.api.inputs import (
    CalibrationPath,
    DatabaseDep,
    DeviceFilter,
    ExpectedActive,
    JsonTypes,
    id_in_path,
)
from service.api.openapi import ResourceRouter, raises
from service.api.paging import Page, PagingDep, page_of
from service.problems.errors import CalibrationOfAnotherDevice

router = ResourceRouter("/api/v1/calibrations", "calibrations")

NewCalibrationBody = Annotated[NewCalibration, JsonTypes(), Body(openapi_examples=NEW_CALIBRATIONS)]
OtherPath = Annotated[str, id_in_path("The other calibration's id.", "sim-frame", "frame")]
DeletedPath = Annotated[
    str, id_in_path("The calibration's id.", "sim-frame-spare", "spare", "one never used")
]
RetiredPath = Annotated[
    str, id_in_path("The calibration's id.", "sim-frame", "frame", "one that is not active")
]


@router.operation("GET", "list-calibrations", "List calibrations")
def list_calibrations(
    database: DatabaseDep,
    paging: PagingDep,
    device_id: DeviceFilter = None,
    state: Annotated[State | None, Query(description="Only those in this state.")] = None,
) -> Page[CalibrationSummary]:
    """Calibrations without their numbers, newest first."""
    with database.read() as session:
        return page_of(
            session,
            store.calibrations(device_id, state),
            paging,
            lambda row: store.summary(session, row),
        )


@router.operation(
    "POST",
    "create-calibration",
    "Calibrate a device",
    status_code=201,
    response_model=CalibrationDocument,
)
@raises("unknown-device", "calibration-exists", "sensors-changed", "too-few-points")
@raises("coplanar-points", "duplicate-point", "unknown-sensor", "reading-outside-sensor")
@raises("implausible-readings", "invalid-parameter", "no-convergence")
def create_calibration(request: NewCalibrationBody, database: DatabaseDep) -> JSONResponse:
    """Calibrate every sensor from control points. The calibration is stored, not activated.

    Each sensor needs at least seven points that do not lie in one plane. The control points are
    reconstructed with the result, and each by a calibration without it (at most 100 points).
    """
    with database.read() as session:
        sensors = sensors_of_row(get_device(session, request.device_id))
        store.CALIBRATIONS.check_unused(session, request.id)
    record = run_calibration(request, sensors)
    with database.write() as session:
        # The run held no lock: the device may have been given other sensors meanwhile.
        device = get_device(session, request.device_id, lock=True)
        check_sensors(device.id, sensors_of_row(device), sensors)
        row = store.add_calibration(session, request.device_id, record, request.note, request.id)
        made = store.document(session, row)
    location = {"Location": f"/api/v1/calibrations/{made['id']}"}
    return JSONResponse(made, 201, location)


@router.operation(
    "GET /{calibration_id}",
    "get-calibration",
    "Read a calibration",
    response_model=CalibrationDocument,
)
@raises("unknown-calibration")
def get_calibration(calibration_id: CalibrationPath, database: DatabaseDep) -> JSONResponse:
    """One calibration: models, joint covariance, residuals, control-point errors.

    What is hashed is sent as it was stored: one that an earlier version made has no members that
    came later.
    """
    with database.read() as session:
        found = store.document(session, store.CALIBRATIONS.get(session, calibration_id))
    return JSONResponse(found)


@router.operation(
    "GET /{calibration_id}/compare/{other_calibration_id}",
    "compare-calibrations",
    "Compare two calibrations",
)
@raises("unknown-calibration", "calibration-of-another-device", "sensors-changed")
def compare_calibrations(
    calibration_id: CalibrationPath, other_calibration_id: OtherPath, database: DatabaseDep
) -> ComparisonDocument:
    """Two calibrations of one device: parameters in standard deviations, positions over the control
    points' box, and which is better on the same observations.
    """
    from service.api.calibrations.comparison import compare

    with database.read() as session:
        rows = [
            store.CALIBRATIONS.get(session, name) for name in (calibration_id, other_calibration_id)
        ]
        if rows[0].device_id != rows[1].device_id:
            raise CalibrationOfAnotherDevice(
                f'calibration "{rows[1].id}" is of device "{rows[1].device_id}"; "{rows[0].id}" is '
                f'of device "{rows[0].device_id}": compare calibrations of one device',
                calibration_id=rows[1].id,
            )
        sensors = sensors_of_row(get_device(session, rows[0].device_id))
        for row in rows:
            check_sensors(row.device_id, sensors, result_of(row.content).models)
        held = [store.with_control_points(row, sensors) for row in rows]
    return ComparisonDocument(
        calibration_id=calibration_id,
        other_calibration_id=other_calibration_id,
        comparison=compare(held[0], held[1]),
    )


@router.operation(
    "POST /{calibration_id}/activate", "activate-calibration", "Activate a calibration"
)
@raises("unknown-calibration", "calibration-retired", "sensors-changed", "activation-conflict")
@raises("nominal-calibration-mismatch")
def activate_calibration(
    calibration_id: CalibrationPath,
    database: DatabaseDep,
    device_service: DeviceServiceDep,
    expected: ExpectedActive = None,
) -> CalibrationSummary:
    """Make this the active calibration of its device, in a running one from the next frame on.

    The move is written into the device's history of activations. To roll back, activate the
    previous one again. Of activations at the same moment one wins; the others get 409.
    """
    with database.read() as session:
        device = store.CALIBRATIONS.get(session, calibration_id).device_id
    with device_service.pointer_move(
        device, lambda now: now.calibration_id == calibration_id, expected
    ) as session:
        return store.summary(session, store.activate(session, calibration_id))


@router.operation("DELETE /{calibration_id}", "delete-calibration", "Delete a calibration")
@raises("unknown-calibration", "calibration-in-use")
def delete_calibration(calibration_id: DeletedPath, database: DatabaseDep) -> None:
    """Delete a calibration that was made by mistake; refused where anything refers to it.

    One that was ever active is part of the device's history: retire it.
    """
    with database.write() as session:
        store.delete_calibration(session, calibration_id)


@router.operation("POST /{calibration_id}/retire", "retire-calibration", "Retire a calibration")
@raises("unknown-calibration", "calibration-active")
def retire_calibration(calibration_id: RetiredPath, database: DatabaseDep) -> CalibrationSummary:
    """Take a calibration out of use for good. It stays readable; it cannot be activated again."""
    with database.write() as session:
        return store.summary(session, store.retire(session, calibration_id))
