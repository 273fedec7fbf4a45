"""REST resource /api/v1/devices: routes only; device_service does what they ask for."""

from typing import Annotated

from fastapi import APIRouter, Body, Path, Query, Response
from starlette.status import HTTP_201_CREATED, HTTP_204_NO_CONTENT

from compute.errors import InvalidParameter, InvalidRecording
from hardware.errors import DeviceNotConnected
from service.api.base_models import SLUG_PATTERN, Page
from service.api.devices import store
from service.api.devices.activation import activations
from service.api.devices.device_service import DeviceServiceDep
from service.api.devices.examples import CHANGES, NEW_DEVICES
from service.api.devices.schema import Activation, Device, DeviceChange, NewDevice, Status
from service.api.inputs import (
    DatabaseDep,
    DevicePath,
    ExpectedActive,
    JsonRoute,
    JsonTypes,
    PagingDep,
    page_of,
)
from service.api.openapi import problems
from service.database.models import ActivationRow
from service.problems.errors import (
    ActivationConflict,
    CalibrationRetired,
    DeviceExists,
    DeviceInUse,
    DeviceRunning,
    DeviceWithoutDriver,
    NothingToRollBack,
    SensorsChanged,
    UnknownDevice,
    UnknownDeviceProfile,
    UnknownRecording,
)

router = APIRouter(prefix="/api/v1/devices", tags=["devices"], route_class=JsonRoute)

NewDeviceBody = Annotated[NewDevice, JsonTypes(), Body(openapi_examples=NEW_DEVICES)]
ChangeBody = Annotated[DeviceChange, JsonTypes(), Body(openapi_examples=CHANGES)]


@router.get("", operation_id="list-devices", summary="List devices")
def list_devices(database: DatabaseDep, paging: PagingDep) -> Page[Device]:
    """Devices by id."""
    with database.read() as session:
        return page_of(session, store.devices(), paging, lambda row: store.document(session, row))


@router.post(
    "",
    operation_id="create-device",
    summary="Create a device",
    status_code=HTTP_201_CREATED,
    responses=problems(
        DeviceExists,
        DeviceNotConnected,
        UnknownRecording,
        UnknownDeviceProfile,
        InvalidParameter,
        InvalidRecording,
    ),
)
def create_device(
    request: NewDeviceBody, device_service: DeviceServiceDep, response: Response
) -> Device:
    """Create a device. It is not started; sensors are given for an external one only.

    A device on a port has to be connected, because it says itself which sensors it has.
    """
    device = device_service.create(request)
    response.headers["Location"] = f"/api/v1/devices/{device.id}"
    return device


@router.get(
    "/{device_id}",
    operation_id="get-device",
    summary="Read a device",
    responses=problems(UnknownDevice),
)
def get_device(device_id: DevicePath, database: DatabaseDep) -> Device:
    """One device."""
    with database.read() as session:
        return store.document(session, store.get_device(session, device_id))


@router.patch(
    "/{device_id}",
    operation_id="change-device",
    summary="Change a device",
    responses=problems(
        UnknownDevice,
        UnknownRecording,
        UnknownDeviceProfile,
        DeviceInUse,
        DeviceRunning,
        DeviceNotConnected,
        InvalidParameter,
        InvalidRecording,
    ),
)
def change_device(
    device_id: DevicePath, request: ChangeBody, device_service: DeviceServiceDep
) -> Device:
    """Change what is given. A new source works from the next start of the device; sensors that
    calibrations refer to cannot change, nor can those of a running device.
    """
    return device_service.change(device_id, request)


DeletedDevicePath = Annotated[
    str,
    Path(
        pattern=SLUG_PATTERN,
        description="The device's id.",
        openapi_examples={"lab-bar": {"summary": "the external device", "value": "lab-bar"}},
    ),
]


@router.delete(
    "/{device_id}",
    operation_id="delete-device",
    summary="Delete a device",
    status_code=HTTP_204_NO_CONTENT,
    responses=problems(UnknownDevice, DeviceInUse),
)
def delete_device(
    device_id: DeletedDevicePath,
    device_service: DeviceServiceDep,
    cascade: Annotated[
        bool, Query(description="Delete its calibrations and reconstructions, too.")
    ] = False,
) -> None:
    """Stop and delete a device; refused while calibrations or reconstructions belong to it."""
    device_service.delete(device_id, cascade=cascade)


@router.post(
    "/{device_id}/start",
    operation_id="start-device",
    summary="Start a device",
    responses=problems(
        UnknownDevice,
        UnknownRecording,
        UnknownDeviceProfile,
        DeviceWithoutDriver,
        SensorsChanged,
        InvalidParameter,
        InvalidRecording,
    ),
)
def start_device(device_id: DevicePath, device_service: DeviceServiceDep) -> Status:
    """Start the device with its active calibration; one that is running starts anew.

    One that is unplugged is "disconnected", with the reason, and runs once it is connected.
    """
    return Status(device=device_id, status=device_service.start(device_id))


@router.post(
    "/{device_id}/stop",
    operation_id="stop-device",
    summary="Stop a device",
    responses=problems(UnknownDevice),
)
def stop_device(device_id: DevicePath, device_service: DeviceServiceDep) -> Status:
    """Stop the device; nothing happens when it is not running."""
    return Status(device=device_id, status=device_service.stop(device_id))


@router.get(
    "/{device_id}/status",
    operation_id="get-device-status",
    summary="What a device is doing",
    responses=problems(UnknownDevice),
)
def get_device_status(device_id: DevicePath, device_service: DeviceServiceDep) -> Status:
    """State, frame counters and losses since the device was started."""
    return Status(device=device_id, status=device_service.status(device_id))


@router.post(
    "/{device_id}/roll-back",
    operation_id="roll-back-device",
    summary="Go back to what was active before",
    responses=problems(
        UnknownDevice, NothingToRollBack, CalibrationRetired, SensorsChanged, ActivationConflict
    ),
)
def roll_back_device(
    device_id: DevicePath, device_service: DeviceServiceDep, expected: ExpectedActive = None
) -> Device:
    """Go back to the calibration and table before the last activation; again: further back.

    In a running device from the next frame on. The move is written into the history.
    """
    return device_service.roll_back(device_id, expected)


@router.get(
    "/{device_id}/activations",
    operation_id="list-activations",
    summary="History of active calibrations",
    responses=problems(UnknownDevice),
)
def list_activations(
    device_id: DevicePath, database: DatabaseDep, paging: PagingDep
) -> Page[Activation]:
    """Which calibration and table were in use since when, newest first; nothing is removed."""
    with database.read() as session:
        store.get_device(session, device_id)
        return page_of(session, activations(device_id), paging, _activation)


def _activation(row: ActivationRow) -> Activation:
    return Activation(
        id=row.id,
        device=row.device_id,
        calibration_id=row.calibration_id,
        previous_calibration_id=row.previous_calibration_id,
        table_id=row.table_id,
        previous_table_id=row.previous_table_id,
        restores_id=row.restores_id,
        activated_at=row.activated_at,
        actor=row.actor,
    )
