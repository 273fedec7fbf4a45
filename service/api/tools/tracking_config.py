"""What a device follows, from its settings and its tools in the database."""

from sqlalchemy.orm import Session

from service.api.beam_holds.monitor_config import beam_holds_of
from service.api.devices.store import tracking_of
from service.api.tools.rigid_bodies import tools_of
from service.database.models import DeviceRow
from service.pipeline.beam_hold_spec import WatchedLitMarkers
from service.pipeline.tracking_config import TrackingConfig


def tracking_config_of(session: Session, device: DeviceRow) -> TrackingConfig:
    """Return what is followed of a device when it runs.

    A beam hold that goes by tracks has markers followed, whatever the settings say.
    """
    tracking, tools = tracking_of(device), tools_of(session, device.id)
    holds = beam_holds_of(session, device.id)
    tracks = tracking.tracks == "always" or (tracking.tracks == "with-tools" and bool(tools))
    tracks |= any(
        isinstance(one.spec, WatchedLitMarkers) and one.spec.observed_as == "tracks"
        for one in holds
    )
    codes = None if tracking.blinking is None else tracking.blinking.codes()
    return TrackingConfig(tracks, tools, tracking.tracker(), tracking.tool_tracker(), codes, holds)
