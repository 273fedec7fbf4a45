"""REST resource /api/v1/devices/{id}/frames: a device's frames and the transforms between them."""

from typing import Annotated, Final

from fastapi import Query

from service.api.base_models import SLUG_PATTERN, from_attributes
from service.api.devices.store import get_device
from service.api.inputs import DatabaseDep, DevicePath, LiveDep, id_in_path
from service.api.openapi import ResourceRouter, raises
from service.api.tools.frame_graph import device_frames
from service.api.tools.frame_schema import FrameList, FrameState, FrameTransform
from service.api.tools.schema import TRACKER

router = ResourceRouter("/api/v1/devices", "tools")

_DESCRIPTION: Final = "`tracker`, a tool, or a registration."
FramePath = Annotated[
    str,
    id_in_path(_DESCRIPTION, "image", "image", "of the registration of the example body"),
]


@router.operation(
    "GET /{device_id}/frames", "get-frames", "A device's frames, and what connects them now"
)
@raises("unknown-device", "device-elsewhere")
def get_frames(device_id: DevicePath, database: DatabaseDep, live: LiveDep) -> FrameList:
    """The tracker's frame, those of the tools, and the registered ones.

    Each has one transform, to the tracker or to the tool that it was registered relative to; a
    frame whose transform there is not now says why.
    """
    with database.read() as session:
        get_device(session, device_id)
        found = device_frames(session, live, device_id)
    return FrameList(
        device_id=device_id,
        **found.instant,
        frames=[
            from_attributes(
                FrameState,
                node,
                id=node.name,
                to_frame_id=node.to,
                connected=node.to is None or node.to_from is not None,
                root_frame_id=found.root(node.name),
            )
            for node in found.nodes.values()
        ],
    )


@router.operation(
    "GET /{device_id}/frames/{frame_id}",
    "get-frame-transform",
    "The transform from one frame to another now",
)
@raises("unknown-device", "unknown-frame", "device-elsewhere")
def get_frame_transform(
    device_id: DevicePath,
    frame_id: FramePath,
    database: DatabaseDep,
    live: LiveDep,
    to_frame_id: Annotated[
        str,
        Query(pattern=SLUG_PATTERN, description="`tracker`, a tool, or a registration."),
    ] = TRACKER,
) -> FrameTransform:
    """Takes coordinates in `frame_id` to those in `to_frame_id`, at the device's newest frame.

    Always answered with 200: that nothing connects the frames now is a status with a reason.
    """
    with database.read() as session:
        get_device(session, device_id)
        found = device_frames(session, live, device_id)
        return FrameTransform.model_validate(found.transform(to_frame_id, frame_id))
