"""Lets a tap have a running device's batches for some seconds."""

import time
from collections.abc import Callable
from threading import Event
from typing import Final

from service.pipeline.device_session import DeviceSession
from service.pipeline.pipeline_manager import PipelineManager
from service.pipeline.taps import Tap
from service.problems.errors import DeviceNotRunning, NotReady

_LOOK_S: Final = 0.1


def collect(
    live: PipelineManager,
    session: DeviceSession,
    tap: Tap,
    seconds: float,
    ended: Event,
    look: Callable[[], bool] = lambda: False,
) -> None:
    """Attach a tap for so long, or until ``ended`` is set or ``look`` is true; waits.

    ``look`` is called in the waiting thread, several times a second.

    Raises:
        DeviceNotRunning: the device stops or is lost meanwhile.
        NotReady: the server stops meanwhile.
    """
    live.attach(session, tap)
    try:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0 and not ended.wait(min(_LOOK_S, left)):
            if live.hub.closed is not None:
                raise NotReady(
                    f"{live.hub.closed}; what was measured so far is not kept, do it again when it "
                    "is up again",
                    part="server",
                )
            if look():
                return
            if not session.connected:
                raise DeviceNotRunning(
                    f'device "{session.device_id}" stopped or was lost while it was measured; '
                    "start it and try again",
                    device=session.device_id,
                )
    finally:
        live.detach(session, tap)
