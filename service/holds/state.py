"""Whether a beam is held now, as clients receive it."""

import time

from compute.pose.hold_gate import HoldCause
from service.holds.schema import HoldState
from service.live.hold_now import HoldNow
from service.live.manager import LiveManager


def state_of(live: LiveManager, device_id: str, hold_id: str) -> HoldState:
    """Return whether a hold is held; what is not watched is."""
    now = live.holds.now(hold_id)
    if now is None:
        # Of a server that is starting, or one that could not take the hold over.
        why = "it is not watched"
        now = HoldNow(hold_id, True, HoldCause.NO_DATA, why, time.time_ns())
    return HoldState(
        hold=hold_id,
        device=device_id,
        held=now.held,
        cause=now.cause,
        reason=now.reason,
        since_ns=now.since_ns,
        exposure_ns=now.exposure_ns,
        sequence=now.sequence,
        shift_mm=now.shift_mm,
        turn_rad=now.turn_rad,
        chance=now.chance,
    )
