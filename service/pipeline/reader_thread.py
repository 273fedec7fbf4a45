"""The reader thread of one device: takes frames from its driver and puts them into the ring."""

import logging
from collections.abc import Callable
from threading import Thread
from typing import Literal

from compute.errors import LumilineError
from hardware.driver import Driver
from hardware.link import LinkedDriver, LinkState
from service.logs.context import set_device_id
from service.pipeline.frame_ring import FrameRing

_log = logging.getLogger(__name__)

ReaderState = Literal["running", "stopped", "ended", "failed"]

JOIN_TIMEOUT_S = 5.0


class ReaderThread:
    """Runs a driver's blocking generator in a thread of its own until it ends or is stopped."""

    def __init__(
        self,
        device_id: str,
        driver: Driver,
        ring: FrameRing,
        ended: Callable[[], None],
        link_changed: Callable[[], None],
    ) -> None:
        """Prepare the thread.

        From it ``ended`` is called when the frames end by themselves, and ``link_changed`` when
        the device was lost, came back, or sends nothing of use.
        """
        self.state: ReaderState = "running"
        self.reason: str | None = None
        self._device_id = device_id
        self._driver = driver
        self._ring = ring
        self._ended = ended
        self._stopping = False
        self.waits = bool(getattr(driver, "waits", False))
        """Whether the source waits for us: a recording that is replayed as fast as it is taken."""
        self._thread = Thread(target=self._run, name=f"reader-{device_id}", daemon=True)

        self._link_changed = link_changed
        self._linked = driver if isinstance(driver, LinkedDriver) else None

    def start(self) -> None:
        """Start to read; the driver is open."""
        if self._linked is not None:
            self._linked.listen(self._told)
        self._thread.start()

    def link(self) -> LinkState | None:
        """Return how the link to the device stands; None of a device that cannot be unplugged."""
        return None if self._linked is None else self._linked.link()

    def _told(self, _: LinkState) -> None:
        if not self._stopping:
            self._link_changed()

    def close_driver(self) -> None:
        """End the frames without waiting for the thread."""
        self._stopping = True
        self._driver.close()

    def stop(self) -> None:
        """Close the driver and wait for the thread."""
        self.close_driver()
        self._thread.join(JOIN_TIMEOUT_S)
        if self._thread.is_alive():
            _log.error("device %s: its reader did not end %g s after closing the driver",
                       self._device_id, JOIN_TIMEOUT_S)  # fmt: skip
        if self.state == "running":
            self.state = "stopped"

    def _run(self) -> None:
        set_device_id(self._device_id)
        try:
            for frame in self._driver.frames():
                if self.waits:
                    self._ring.wait_for_room(lambda: self._stopping)
                self._ring.put(frame)
        except LumilineError as error:
            self.reason, self.state = error.detail, "failed"
        except Exception as error:  # noqa: BLE001 - becomes the status
            _log.exception("device %s: its driver failed", self._device_id)
            self.reason, self.state = f"the driver failed: {type(error).__name__}", "failed"
        else:
            if not self._stopping:
                self.reason, self.state = "the source has no more frames", "ended"
        finally:
            if not self._stopping:
                self._driver.close()
                self._ended()
