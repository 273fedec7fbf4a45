"""What is tracked in a recording: the tools of its device, with its settings, and markers."""

from collections.abc import Sequence

from sqlalchemy.orm import Session

from compute.pose.rigid_body import RigidBody
from service.api.devices.store import tracking_of
from service.api.devices.tracking_settings import Tracking
from service.api.tools.rigid_bodies import tools_of
from service.database.models import DeviceRow
from service.pipeline.tracking_config import TrackingConfig


def recorded_tracking(tracking: Tracking, tools: Sequence[RigidBody]) -> TrackingConfig:
    """Return tools and how they are tracked.

    Tracks in any case, whether there were any live: they change neither points nor poses.
    """
    codes = None if tracking.blinking is None else tracking.blinking.codes()
    return TrackingConfig(True, tuple(tools), tracking.tracker(), tracking.tool_tracker(), codes)


def recorded_tracking_of(session: Session, device_id: str | None) -> TrackingConfig:
    """Return the tools that a device has now, and its settings; of one that is gone, no tools."""
    row = None if device_id is None else session.get(DeviceRow, device_id)
    if row is None:
        return recorded_tracking(Tracking(), ())
    return recorded_tracking(tracking_of(row), tools_of(session, row.id))
