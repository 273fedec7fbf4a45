"""LatestPoses: the newest pose of every tool, with listeners for newer ones."""

import asyncio
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from threading import Lock

from compute.pose.rigid_body import ToolPose

Told = Callable[["PoseEntry"], None]


@dataclass(frozen=True, eq=False)
class PoseEntry:
    """All poses of one device at one instant.

    Args:
        device_id: the device.
        sequence: number of the frame.
        exposure_ns: middle of its exposure on the host's clock [ns].
        poses: of all tools of the device, by name; those that are not seen too.
        calibration_id: the active calibration.
        frame_rate_hz: frames of the device per second; 0 when not known.
        table_id: the active correction table; None: none.
        arrived_s: when it was made, as time.monotonic() counts [s]: the wall clock may be set.
    """

    device_id: str
    sequence: int
    exposure_ns: int
    poses: Mapping[str, ToolPose]
    calibration_id: str | None
    frame_rate_hz: float = 0.0
    table_id: str | None = None
    arrived_s: float = field(default_factory=time.monotonic)


@dataclass(frozen=True, eq=False)
class _Listener:
    loop: asyncio.AbstractEventLoop
    told: Told


class LatestPoses:
    """Newest poses of all devices; the compute thread writes, and never waits for a reader."""

    def __init__(self) -> None:
        """Begin without any entry."""
        self._lock = Lock()
        self._newest: dict[str, PoseEntry] = {}
        self._listeners: tuple[_Listener, ...] = ()

    def put(self, entry: PoseEntry) -> None:
        """Replace the entry of a device, and call the listeners in their loops."""
        with self._lock:
            self._newest[entry.device_id] = entry
            listeners = self._listeners
        for one in listeners:
            try:
                one.loop.call_soon_threadsafe(one.told, entry)
            except RuntimeError:
                # The loop is closed: the service is ending.
                continue

    def newest(self) -> dict[str, PoseEntry]:
        """Return the newest entry of every device that has tools."""
        with self._lock:
            return dict(self._newest)

    def remove(self, device_id: str) -> None:
        """Remove the entry of a device: it has stopped, or has no tools any more."""
        with self._lock:
            self._newest.pop(device_id, None)

    def listen(self, told: Told) -> Callable[[], None]:
        """Call ``told`` in the running event loop with every newer entry.

        Returns:
            What ends it; may be called again.
        """
        listener = _Listener(asyncio.get_running_loop(), told)
        with self._lock:
            self._listeners = (*self._listeners, listener)

        def end() -> None:
            with self._lock:
                self._listeners = tuple(one for one in self._listeners if one is not listener)

        return end
