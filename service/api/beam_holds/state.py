"""Whether a beam is held now, as clients receive it."""

import time

from compute.pose.beam_hold.beam_hold_state import BeamHoldCause
from service.api.beam_holds.schema import BeamHoldStatus
from service.pipeline.beam_hold_state import BeamHoldState
from service.pipeline.pipeline_manager import PipelineManager


def state_of(live: PipelineManager, device_id: str, hold_id: str) -> BeamHoldStatus:
    """Return whether a hold is held; what is not watched is."""
    now = live.holds.now(hold_id)
    if now is None:
        # Of a server that is starting, or one that could not take the hold over.
        why = "it is not watched"
        now = BeamHoldState(hold_id, True, BeamHoldCause.NO_DATA, why, time.time_ns())
    return BeamHoldStatus(
        hold=hold_id,
        device=device_id,
        held=now.held,
        cause=now.cause,
        reason=now.reason,
        since_ns=now.since_ns,
        exposure_ns=now.exposure_ns,
        sequence=now.sequence,
        shift_mm=now.shift_mm,
        rotation_rad=now.rotation_rad,
        probability=now.probability,
    )
