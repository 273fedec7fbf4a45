"""REST resource /api/v1/radiometric-calibrations."""

from typing import Annotated, Final

from fastapi import Body, Query, Response

from service.api.base_models import SLUG_PATTERN, from_attributes
from service.api.concurrency_limit import ConcurrencyLimit
from service.api.devices.device_service import DeviceServiceDep
from service.api.devices.store import get_device, radiometric_activations, sensors_of_row
from service.api.inputs import (
    DatabaseDep,
    DeviceFilter,
    DevicePath,
    JsonTypes,
    LiveDep,
    SettingsDep,
    id_in_path,
)
from service.api.openapi import ResourceRouter, raises
from service.api.paging import LATEST_FIRST, Page, PagingDep, page_of
from service.api.radiometric_calibrations import store
from service.api.radiometric_calibrations.examples import NEW_RADIOMETRIC_CALIBRATIONS
from service.api.radiometric_calibrations.schema import (
    NewRadiometricCalibration,
    RadiometricActivation,
    RadiometricCalibrationDocument,
    RadiometricCalibrationSummary,
)
from service.api.radiometric_calibrations.sources import content_from

router = ResourceRouter("/api/v1", "radiometric-calibrations")

_limit: Final = ConcurrencyLimit(
    1, "a radiometric calibration is being estimated; send this one again in a few seconds"
)

NewBody = Annotated[
    NewRadiometricCalibration, JsonTypes(), Body(openapi_examples=NEW_RADIOMETRIC_CALIBRATIONS)
]
RadiometricPath = Annotated[
    str,
    id_in_path(
        "The radiometric calibration's id.", "sim-radiometric", "radiometric", "of the example body"
    ),
]
DeletedPath = Annotated[
    str,
    id_in_path(
        "The radiometric calibration's id.", "sim-radiometric-spare", "spare", "one never used"
    ),
]


@router.operation(
    "GET /radiometric-calibrations",
    "list-radiometric-calibrations",
    "List radiometric calibrations",
)
def list_radiometric_calibrations(
    database: DatabaseDep, paging: PagingDep, device_id: DeviceFilter = None
) -> Page[RadiometricCalibrationSummary]:
    """Radiometric calibrations without the numbers of their pixels, newest first."""
    with database.read() as session:
        return page_of(
            session,
            store.RADIOMETRIC_CALIBRATIONS.newest_first(device_id=device_id),
            paging,
            lambda row: store.summary(session, row),
        )


@router.operation(
    "POST /radiometric-calibrations",
    "create-radiometric-calibration",
    "Calibrate the pixels of a device's sensors",
    status_code=201,
)
@raises("unknown-device", "radiometric-calibration-exists", "sensors-changed", "busy")
@raises("unknown-radiometric-capture", "radiometric-capture-incomplete")
@raises("capture-of-another-device", "unknown-recording", "invalid-recording")
@raises("unusable-radiometric-capture", "device-not-running", "invalid-parameter")
def create_radiometric_calibration(
    request: NewBody,
    database: DatabaseDep,
    settings: SettingsDep,
    live: LiveDep,
    response: Response,
) -> RadiometricCalibrationSummary:
    """Estimate offset, response, noise, gain and bad pixels from dark and flat frames (EMVA 1288).

    They come from a session of captures, from recordings, or with the request; or the calibration
    was estimated elsewhere and is stored as it is; or it keeps the bad pixels that the frames of a
    running device have shown. It is stored, not activated.
    """
    with database.read() as session:
        store.RADIOMETRIC_CALIBRATIONS.check_unused(session, request.id)
        sensors = sensors_of_row(get_device(session, request.device_id))
    with _limit:
        content = content_from(request, sensors, database, settings.folders.recordings, live)
    with database.write() as session:
        row = store.add_radiometric_calibration(
            session, content, request.source.kind, request.note, request.id
        )
        made = store.summary(session, row)
    response.headers["Location"] = f"/api/v1/radiometric-calibrations/{made.id}"
    return made


@router.operation(
    "GET /radiometric-calibrations/{radiometric_id}",
    "get-radiometric-calibration",
    "Read a radiometric calibration",
)
@raises("unknown-radiometric-calibration")
def get_radiometric_calibration(
    radiometric_id: RadiometricPath, database: DatabaseDep
) -> RadiometricCalibrationDocument:
    """One radiometric calibration with offset, response and flags of each pixel."""
    with database.read() as session:
        row = store.RADIOMETRIC_CALIBRATIONS.get(session, radiometric_id)
        return store.document(session, row)


@router.operation(
    "DELETE /radiometric-calibrations/{radiometric_id}",
    "delete-radiometric-calibration",
    "Delete a radiometric calibration",
)
@raises("unknown-radiometric-calibration", "radiometric-calibration-in-use")
def delete_radiometric_calibration(radiometric_id: DeletedPath, database: DatabaseDep) -> None:
    """Delete one that was made by mistake; refused where it was ever active."""
    with database.write() as session:
        store.delete_radiometric_calibration(session, radiometric_id)


@router.operation(
    "POST /radiometric-calibrations/{radiometric_id}/activate",
    "activate-radiometric-calibration",
    "Activate a radiometric calibration",
)
@raises("unknown-radiometric-calibration", "sensors-changed", "activation-conflict")
def activate_radiometric_calibration(
    radiometric_id: RadiometricPath,
    database: DatabaseDep,
    device_service: DeviceServiceDep,
    expected: Annotated[
        str | None,
        Query(
            pattern=SLUG_PATTERN,
            description="The radiometric calibration that you believe to be active now; where "
            "another one is, nothing is changed (409).",
        ),
    ] = None,
) -> RadiometricCalibrationSummary:
    """Find the peaks of its device with it, those of a running one from the next frame on.

    To go back, activate the previous one again, or deactivate it.
    """
    with database.read() as session:
        device = store.RADIOMETRIC_CALIBRATIONS.get(session, radiometric_id).device_id
    with device_service.radiometric_move(device) as session:
        row = store.RADIOMETRIC_CALIBRATIONS.get(session, radiometric_id)
        return store.summary(session, store.activate(session, row, expected))


@router.operation(
    "POST /radiometric-calibrations/{radiometric_id}/deactivate",
    "deactivate-radiometric-calibration",
    "Stop using a radiometric calibration",
)
@raises("unknown-radiometric-calibration")
def deactivate_radiometric_calibration(
    radiometric_id: RadiometricPath, database: DatabaseDep, device_service: DeviceServiceDep
) -> RadiometricCalibrationSummary:
    """Let its device go on without it; one that is not in use stays as it is."""
    with database.read() as session:
        device = store.RADIOMETRIC_CALIBRATIONS.get(session, radiometric_id).device_id
    with device_service.radiometric_move(device) as session:
        row = store.RADIOMETRIC_CALIBRATIONS.get(session, radiometric_id)
        return store.summary(session, store.deactivate(session, row))


@router.operation(
    "GET /devices/{device_id}/radiometric-activations",
    "list-radiometric-activations",
    "History of active radiometric calibrations",
)
@raises("unknown-device")
def list_radiometric_activations(
    device_id: DevicePath, database: DatabaseDep, paging: PagingDep
) -> Page[RadiometricActivation]:
    """History of the active radiometric calibration, newest first; nothing is removed."""
    with database.read() as session:
        get_device(session, device_id)
        return page_of(
            session,
            radiometric_activations(device_id),
            paging,
            lambda row: from_attributes(RadiometricActivation, row),
            LATEST_FIRST,
        )
