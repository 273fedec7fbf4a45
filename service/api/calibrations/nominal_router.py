"""REST operation POST /api/v1/nominal-calibrations."""

from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, Final

from fastapi import Body, Depends, Request
from starlette.responses import JSONResponse

from compute.errors import InvalidParameter
from hardware.simulated.profile_driver import ProfileDriver
from hardware.simulated.profile_settings import ProfileSettings
from service.api.calibrations import store
from service.api.calibrations.schema import (
    CalibratedProfile,
    CalibrationDocument,
    NewNominalCalibration,
)
from service.api.devices.nominal_calibration import nominal_in_process, nominal_note
from service.api.devices.nominal_source import nominal_mismatch
from service.api.devices.profiles import find_profile, profile_text
from service.api.devices.schema import ProfileSource, check_sensors
from service.api.devices.store import get_device, sensors_of_row, source_of
from service.api.inputs import DatabaseDep, JsonTypes
from service.api.openapi import ResourceRouter, raises
from service.problems.errors import NominalCalibrationMismatch

router = ResourceRouter("/api/v1", "calibrations")

_EXAMPLES: Final[dict[str, Any]] = {
    "planned": {"summary": "Of a simulated profile", "value": {"device_id": "planned"}},
}

NominalBody = Annotated[NewNominalCalibration, JsonTypes(), Body(openapi_examples=_EXAMPLES)]


def _profiles_dir(request: Request) -> Path:
    folder: Path = request.app.state.settings.folders.profiles
    return folder


@router.operation(
    "POST /nominal-calibrations",
    "create-nominal-calibration",
    "Calibrate a simulated device by its profile",
    status_code=201,
    response_model=CalibrationDocument,
)
@raises("unknown-device", "unknown-device-profile", "calibration-exists", "sensors-changed")
@raises("invalid-parameter", "busy", "nominal-calibration-mismatch")
def create_nominal_calibration(
    request: NominalBody,
    database: DatabaseDep,
    profiles_dir: Annotated[Path, Depends(_profiles_dir)],
) -> JSONResponse:
    """Cameras that fit the traced optics of the device's profile; nothing is measured.

    Of a device whose source is a profile. The calibration has the provenance `nominal`, no points
    and no errors, names the `profile`, and is stored, not activated. It is right for the device
    that is simulated from this profile, and is activated on no other. Takes seconds.
    """
    with database.read() as session:
        device = get_device(session, request.device_id)
        source, sensors = source_of(device), sensors_of_row(device)
        if request.id is not None:
            store.CALIBRATIONS.check_unused(session, request.id)
    if not isinstance(source, ProfileSource):
        raise InvalidParameter(
            f'the source of device "{request.device_id}" is {source.kind}; only a device that is '
            "simulated from a profile (source profile) has a geometry to be calibrated by; "
            "calibrate this one from points",
            device_id=request.device_id,
        )
    profile = find_profile(source.profile_id, profiles_dir)
    toml = profile_text(source.profile_id, profiles_dir)
    described = ProfileDriver(profile.name, profile, ProfileSettings()).description
    if described.readout == "gray-tracks":
        raise InvalidParameter(
            f'profile "{profile.name}" has Gray tracks; they are not read, and so have no '
            "calibration",
            profile_id=profile.name,
        )
    named = CalibratedProfile(
        profile_id=profile.name, content_hash=sha256(toml.encode()).hexdigest()
    )
    result = nominal_in_process(profile.name, toml)
    with database.write() as session:
        # The computation held no lock: the device may have been given another source meanwhile.
        device = get_device(session, request.device_id, lock=True)
        check_sensors(device.id, sensors_of_row(device), sensors)
        check_sensors(device.id, sensors_of_row(device), result.models)
        identity = request.id or store.unused_nominal_id(session, device.id)
        note = nominal_note(named.profile_id, named.content_hash, result)
        row = store.add_nominal(session, device.id, result, note, identity, named)
        why = nominal_mismatch(row.content, source_of(device), profiles_dir)
        if why is not None:
            raise NominalCalibrationMismatch(
                f"the calibration was computed, and is not stored: {why}", device_id=device.id
            )
        made = store.document(session, row)
    location = {"Location": f"/api/v1/calibrations/{made['id']}"}
    return JSONResponse(made, 201, location)
