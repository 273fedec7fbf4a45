"""What a device follows, from its settings and its tools in the database."""

from sqlalchemy.orm import Session

from service.database.models import DeviceRow
from service.devices.store import tracking_of
from service.holds.specs import holds_of
from service.live.hold_spec import LitSpec
from service.live.tracked import Tracked
from service.tools.bodies import tools_of


def tracked_of(session: Session, device: DeviceRow) -> Tracked:
    """Return what is followed of a device when it runs.

    A beam hold that goes by tracks has markers followed, whatever the settings say.
    """
    tracking, tools = tracking_of(device), tools_of(session, device.id)
    holds = holds_of(session, device.id)
    tracks = tracking.tracks == "always" or (tracking.tracks == "with-tools" and bool(tools))
    tracks |= any(isinstance(one.spec, LitSpec) and one.spec.seen_as == "tracks" for one in holds)
    codes = None if tracking.blinking is None else tracking.blinking.codes()
    return Tracked(tracks, tools, tracking.tracker(), tracking.tool_tracker(), codes, holds)
