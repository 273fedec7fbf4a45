"""Attaches a tap to a running device and waits for what it collects."""

from collections.abc import Callable
from threading import Event

import numpy as np
from numpy.typing import NDArray

from service.pipeline.device_status import DeviceStatus
from service.pipeline.interface import Pipeline, RunningDevice
from service.pipeline.taps import PeakTap, Tap, poll
from service.problems.errors import DeviceNotRunning, NotReady


def collect(
    live: Pipeline,
    session: RunningDevice,
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
    session.attach(tap)
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
        session.detach(tap)


def collect_readings(
    live: Pipeline, device_id: str, frames: int, marker: int | None, timeout_s: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the readings of one marker in the next frames of a running device; waits for them.

    Args:
        live: the running devices.
        device_id: the device.
        frames: how many.
        marker: the strobed marker; None: frames in which all are lit, and one is in view.
        timeout_s: how long they are waited for; then there are fewer.

    Returns:
        Positions and their sigmas [px], shape (F, S); NaN where a sensor saw no clear peak.

    Raises:
        DeviceNotRunning: it does not run, ends meanwhile, or is disconnected.
        NotReady: the server stops meanwhile.
    """
    session = live.session(device_id)
    if not session.connected:
        raise not_running(device_id, live.status(device_id))
    tap = PeakTap(session.last_sequence, frames, marker)
    try:
        collect(live, session, tap, timeout_s, tap.ended)
    except DeviceNotRunning as error:
        # Its status has the reason.
        raise not_running(device_id, live.status(device_id)) from error
    return tap.readings(len(session.description.sensors))


def not_running(device_id: str, status: DeviceStatus) -> DeviceNotRunning:
    """Return the error of a device from which nothing can be captured now."""
    if status.state == "disconnected":
        return DeviceNotRunning(
            f'device "{device_id}" is disconnected: {status.reason}; connect it, and it goes '
            "on by itself",
            device_id=device_id,
        )
    return DeviceNotRunning(
        f'device "{device_id}" does not run; start it to capture what it sees',
        device_id=device_id,
    )
