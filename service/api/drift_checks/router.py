"""REST resources /api/v1/drift-checks and /api/v1/calibrations/{id}/drift-checks."""

from typing import Annotated

from fastapi import Body, Query, Response

from service.api.base_models import SLUG_PATTERN
from service.api.calibrations.calibration_content import result_of
from service.api.calibrations.store import get_calibration
from service.api.devices.schema import check_sensors
from service.api.devices.store import get_device, sensors_of_row
from service.api.drift_checks import store
from service.api.drift_checks.examples import NEW_DRIFT_CHECKS
from service.api.drift_checks.marker_references import resolve_stationary_markers
from service.api.drift_checks.schema import DriftCheckDocument, DriftCheckSummary, NewDriftCheck
from service.api.drift_checks.stationary_markers import marker_arrays
from service.api.inputs import (
    CalibrationPath,
    DatabaseDep,
    DeviceFilter,
    JsonTypes,
    id_in_path,
)
from service.api.openapi import ResourceRouter, raises
from service.api.paging import Page, PagingDep, page_of
from service.api.webhooks.dispatcher import WebhooksDep

router = ResourceRouter("/api/v1", "drift-checks")

NewDriftCheckBody = Annotated[NewDriftCheck, JsonTypes(), Body(openapi_examples=NEW_DRIFT_CHECKS)]
DriftCheckPath = Annotated[str, id_in_path("The check's id.", "sim-drift", "frame")]


@router.operation(
    "POST /calibrations/{calibration_id}/drift-checks",
    "create-drift-check",
    "Is a calibration still good?",
    status_code=201,
)
@raises("unknown-calibration", "unknown-capture", "drift-check-exists", "capture-of-another-device")
@raises("capture-incomplete", "sensors-changed", "too-few-points", "duplicate-point")
@raises("unknown-sensor", "reading-outside-sensor", "invalid-parameter")
def create_drift_check(
    calibration_id: CalibrationPath,
    request: NewDriftCheckBody,
    database: DatabaseDep,
    webhooks: WebhooksDep,
    response: Response,
) -> DriftCheckDocument:
    """Test readings of stationary markers against the calibration, within both errors.

    The verdict says which sensors moved, and how, and is kept in the device's history. Correction
    tables take no part. A calibration that does not hold is brought up to date by an update run.
    """
    from compute.calibration.drift.drift_detection import check_drift

    with database.read() as session:
        store.DRIFT_CHECKS.check_unused(session, request.id)
        calibration = get_calibration(session, calibration_id)
        sensors = sensors_of_row(get_device(session, calibration.device_id))
        result = result_of(calibration.content)
        check_sensors(calibration.device_id, sensors, result.models)
        markers = resolve_stationary_markers(session, calibration, sensors, request)
    found = check_drift(result, marker_arrays(markers, sensors, result, request.position_sigma_mm))
    with database.write() as session:
        calibration = get_calibration(session, calibration_id)
        get_device(session, calibration.device_id, lock=True)
        made = store.document(store.add_drift_check(session, calibration, request, markers, found))
    if not found.good:
        webhooks.emit(
            "drift.detected",
            {
                "device_id": made.device_id,
                "calibration_id": made.calibration_id,
                "drift_check_id": made.id,
                "status": made.status,
                "moved": made.moved,
                "in_words": made.in_words,
            },
        )
    response.headers["Location"] = f"/api/v1/drift-checks/{made.id}"
    return made


@router.operation("GET /drift-checks", "list-drift-checks", "List drift checks")
def list_drift_checks(
    database: DatabaseDep,
    paging: PagingDep,
    device_id: DeviceFilter = None,
    calibration_id: Annotated[
        str | None, Query(pattern=SLUG_PATTERN, description="Only those of this calibration.")
    ] = None,
    good: Annotated[
        bool | None, Query(description="Only those that found it good, or did not.")
    ] = None,
) -> Page[DriftCheckSummary]:
    """A device's drift over time, newest first, without the readings."""
    with database.read() as session:
        return page_of(
            session, store.drift_checks(device_id, calibration_id, good), paging, store.summary
        )


@router.operation("GET /drift-checks/{drift_check_id}", "get-drift-check", "Read a drift check")
@raises("unknown-drift-check")
def get_drift_check(drift_check_id: DriftCheckPath, database: DatabaseDep) -> DriftCheckDocument:
    """One check with its readings."""
    with database.read() as session:
        return store.document(store.DRIFT_CHECKS.get(session, drift_check_id))


@router.operation(
    "DELETE /drift-checks/{drift_check_id}", "delete-drift-check", "Delete a drift check"
)
@raises("unknown-drift-check")
def delete_drift_check(drift_check_id: DriftCheckPath, database: DatabaseDep) -> None:
    """For one that was made wrongly: nothing refers to a check."""
    with database.write() as session:
        session.delete(store.DRIFT_CHECKS.get(session, drift_check_id))
