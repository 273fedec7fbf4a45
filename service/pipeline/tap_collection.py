"""Attaches a tap to a running device and waits for what it collects."""

from collections.abc import Callable
from threading import Event

from service.pipeline.device_session import DeviceSession
from service.pipeline.pipeline_manager import PipelineManager
from service.pipeline.taps import Tap, poll
from service.problems.errors import DeviceNotRunning, NotReady


def collect(
    live: PipelineManager,
    session: DeviceSession,
    tap: Tap,
    seconds: float,
    ended: Event,
    is_enough: Callable[[], bool] = lambda: False,
) -> None:
    """Attach a tap for some seconds, or until ``ended`` is set or ``is_enough`` is true; waits.

    ``is_enough`` is called in the waiting thread, several times a second.

    Raises:
        DeviceNotRunning: the device stops or is lost meanwhile.
        NotReady: the server stops meanwhile.
    """
    live.attach(session, tap)
    try:
        for _ in poll(ended, seconds):
            if live.streams.closed is not None:
                raise NotReady(
                    f"{live.streams.closed}; what was measured so far is not kept, do it again "
                    "when it is up again",
                    part="server",
                )
            if is_enough():
                return
            if not session.connected:
                raise DeviceNotRunning(
                    f'device "{session.device_id}" stopped or was lost while it was measured; '
                    "start it and try again",
                    device_id=session.device_id,
                )
    finally:
        live.detach(session, tap)
