"""REST resource /api/v1/devices: routes only; device_service does the work."""

from typing import Annotated, Any, Final

from fastapi import Body, Query, Response

from service.api.base_models import from_attributes
from service.api.devices import store
from service.api.devices.device_service import DeviceServiceDep
from service.api.devices.schema import (
    Activation,
    Device,
    DeviceChange,
    DeviceStateDocument,
    NewDevice,
    state_document,
)
from service.api.inputs import (
    DatabaseDep,
    DevicePath,
    ExpectedActive,
    JsonTypes,
    id_in_path,
)
from service.api.openapi import ResourceRouter, raises
from service.api.paging import BY_ID, LATEST_FIRST, Page, PagingDep, page_of
from service.api.preconditions import OptionalIfMatch, RequiredIfMatch

router = ResourceRouter("/api/v1/devices", "devices")

NEW_DEVICES: Final[dict[str, Any]] = {
    "simulated": {
        "summary": "A simulated bar of sensors that sees a calibration frame at rest",
        "value": {
            "id": "bench",
            "title": "Simulated bench",
            "source": {
                "kind": "simulated",
                "settings": {"scene": {"kind": "calibration-frame"}, "frame_rate_hz": 200},
            },
        },
    },
    "profile": {
        "summary": "The thesis's four cameras, simulated: their optics, light and detector",
        "value": {
            "id": "thesis-cameras",
            "title": "The thesis's cameras at 1 m",
            "source": {
                "kind": "profile",
                "profile_id": "thesis-5.9",
                "settings": {
                    "scene": {"kind": "still-points", "points_mm": [[0, -97, 1133]]},
                    "optics": "exact",
                    "frame_rate_hz": 10,
                },
            },
        },
    },
    "fusion": {
        "summary": "Two bars as one device; the second is that of the first example",
        "value": {
            "id": "hall",
            "title": "Both bars",
            "source": {"kind": "fusion", "bars": ["sim", "bench"]},
        },
    },
    "external": {
        "summary": "Four sensors that a program of yours reads",
        "value": {
            "id": "lab-bar",
            "title": "Sensor bar in the laboratory",
            "source": {
                "kind": "external",
                "sensors": [
                    {"name": name, "pixels": 2048, "pitch_um": 14}
                    for name in ("left", "middle", "right", "vertical")
                ],
            },
        },
    },
}

CHANGES: Final[dict[str, Any]] = {
    "rename": {"summary": "Another title", "value": {"title": "Simulator in the entrance hall"}},
    "autostart": {"summary": "Start it with the server", "value": {"autostart": True}},
}
"""Each example works on a fresh server as it stands."""

NewDeviceBody = Annotated[NewDevice, JsonTypes(), Body(openapi_examples=NEW_DEVICES)]
ChangeBody = Annotated[DeviceChange, JsonTypes(), Body(openapi_examples=CHANGES)]


@router.operation("GET", "list-devices", "List devices")
def list_devices(database: DatabaseDep, paging: PagingDep) -> Page[Device]:
    """Devices by id."""
    with database.read() as session:
        return page_of(
            session,
            store.devices(),
            paging,
            lambda row: store.document(session, row),
            BY_ID,
        )


@router.operation("POST", "create-device", "Create a device", status_code=201)
@raises("device-elsewhere")
@raises("device-exists", "device-not-connected", "unknown-recording", "unknown-device-profile")
@raises("unknown-device")
@raises("invalid-parameter", "invalid-recording", "missing-library")
def create_device(
    request: NewDeviceBody, device_service: DeviceServiceDep, response: Response
) -> Device:
    """Create a device. It is not started; sensors are given for an external one only.

    A device on a port has to be connected, because it says itself which sensors it has. Those of a
    fused device are those of its bars, which exist.
    """
    device = device_service.create(request)
    response.headers["Location"] = f"/api/v1/devices/{device.id}"
    return device


@router.operation("GET /{device_id}", "get-device", "Read a device")
@raises("unknown-device")
def get_device(device_id: DevicePath, database: DatabaseDep) -> Device:
    """One device."""
    with database.read() as session:
        return store.document(session, store.get_device(session, device_id))


@router.operation("PATCH /{device_id}", "change-device", "Change a device")
@raises("device-elsewhere")
@raises("unknown-device", "unknown-recording", "unknown-device-profile", "device-in-use")
@raises("device-running", "device-not-connected", "invalid-parameter", "invalid-recording")
@raises("missing-library")
@raises("precondition-failed", "precondition-required", "invalid-precondition")
def change_device(
    device_id: DevicePath,
    request: ChangeBody,
    device_service: DeviceServiceDep,
    expected: RequiredIfMatch,
) -> Device:
    """Change what is given. A new source works from the next start of the device; sensors that
    calibrations refer to cannot change, nor can those of a running device. While a nominal
    calibration is active, the source stays what it was computed from.
    """
    return device_service.change(device_id, request, expected)


DeletedPath = Annotated[
    str, id_in_path("The device's id.", "lab-bar", "lab-bar", "the external device")
]


@router.operation("DELETE /{device_id}", "delete-device", "Delete a device")
@raises("unknown-device", "device-in-use", "precondition-failed", "invalid-precondition")
def delete_device(
    device_id: DeletedPath,
    device_service: DeviceServiceDep,
    expected: OptionalIfMatch,
    cascade: Annotated[
        bool, Query(description="Delete its calibrations and reconstructions, too.")
    ] = False,
) -> None:
    """Stop and delete a device; refused while calibrations or reconstructions belong to it."""
    device_service.delete(device_id, expected, cascade=cascade)


@router.operation("POST /{device_id}/start", "start-device", "Start a device")
@raises("device-elsewhere")
@raises("unknown-device", "unknown-recording", "unknown-device-profile", "device-without-driver")
@raises("sensors-changed", "invalid-parameter", "invalid-recording")
def start_device(device_id: DevicePath, device_service: DeviceServiceDep) -> DeviceStateDocument:
    """Start the device with its active calibration; one that is running starts anew.

    One that is unplugged is "disconnected", with the reason, and runs once it is connected.
    """
    return state_document(device_id, device_service.start(device_id))


@router.operation("POST /{device_id}/stop", "stop-device", "Stop a device")
@raises("device-elsewhere")
@raises("unknown-device")
def stop_device(device_id: DevicePath, device_service: DeviceServiceDep) -> DeviceStateDocument:
    """Stop the device; nothing happens when it is not running."""
    return state_document(device_id, device_service.stop(device_id))


@router.operation("GET /{device_id}/state", "get-device-state", "What a device is doing")
@raises("device-elsewhere")
@raises("unknown-device")
def get_device_state(
    device_id: DevicePath, device_service: DeviceServiceDep
) -> DeviceStateDocument:
    """State, frame counters and losses since the device was started."""
    return state_document(device_id, device_service.status(device_id))


@router.operation(
    "POST /{device_id}/roll-back", "roll-back-device", "Go back to what was active before"
)
@raises("unknown-device", "nothing-to-roll-back", "calibration-retired", "sensors-changed")
@raises("activation-conflict", "nominal-calibration-mismatch")
def roll_back_device(
    device_id: DevicePath, device_service: DeviceServiceDep, expected: ExpectedActive = None
) -> Device:
    """Go back to the calibration and table before the last activation; again: further back.

    In a running device from the next frame on. The move is written into the history.
    """
    return device_service.roll_back(device_id, expected)


@router.operation(
    "GET /{device_id}/activations", "list-activations", "History of active calibrations"
)
@raises("unknown-device")
def list_activations(
    device_id: DevicePath, database: DatabaseDep, paging: PagingDep
) -> Page[Activation]:
    """History of the active calibration and table, newest first; nothing is removed."""
    with database.read() as session:
        store.get_device(session, device_id)
        return page_of(
            session,
            store.activations(device_id),
            paging,
            lambda row: from_attributes(Activation, row),
            LATEST_FIRST,
        )
