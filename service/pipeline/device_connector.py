"""DeviceConnector: opens a driver; an unplugged device is tried again until it is there."""

import logging
from collections.abc import Callable
from threading import Event, Thread, current_thread
from typing import Literal

from compute.errors import LumilineError
from hardware.driver import Driver
from hardware.errors import DeviceNotConnected
from service.logs import set_device_id
from service.pipeline.active_calibration import ActiveCalibration

_log = logging.getLogger(__name__)

RETRY_S = (0.25, 0.5, 1.0, 2.0)
"""How long to wait before the next attempt; the last for all that follow."""

_JOIN_S = 10.0


class DeviceConnector:
    """A device that is being opened, from the request until it runs, fails or is stopped.

    Args:
        device_id: the device.
        driver: its driver.
        found: the calibration to begin with; may be replaced meanwhile.
        opened: called when the driver is open; a LumilineError that it raises is a failure.
        changed: called when ``state`` or ``reason`` changed.
    """

    def __init__(
        self,
        device_id: str,
        driver: Driver,
        active: ActiveCalibration,
        opened: Callable[["DeviceConnector"], None],
        changed: Callable[["DeviceConnector"], None],
    ) -> None:
        self.state: Literal["starting", "disconnected", "failed"] = "starting"
        self.reason: str | None = None
        self.error: Exception | None = None
        self.driver = driver
        self._device_id = device_id
        self.active = active
        self.cancelled = Event()
        self._opened = opened
        self._changed = changed
        self._tried, self._open = Event(), Event()
        self._thread = Thread(target=self._run, name=f"opener-{device_id}", daemon=True)

    def _attempt(self) -> None:
        """Open the driver once; raises LumilineError where it fails."""
        try:
            self.driver.open()
        except LumilineError:
            raise
        except Exception as error:
            _log.exception("device %s: the driver could not be opened", self._device_id)
            raise LumilineError(f"the driver failed: {type(error).__name__}: {error}") from error
        self._open.set()
        try:
            self._opened(self)
        except BaseException:
            self.driver.close()
            raise

    def start(self, wait_s: float) -> None:
        """Open it in a thread of its own; wait at most ``wait_s`` until it is open, or is not.

        What is made of it then is waited for, too: kernels may have to be loaded.

        Raises:
            LumilineError: it cannot be opened, for another reason than that it is not there.
            Exception: what is made of it failed otherwise.
        """
        self._thread.start()
        if not self._tried.wait(wait_s) and self._open.is_set():
            self._tried.wait()
        if self.error is not None:
            raise self.error

    def cancel(self) -> None:
        """Stop trying, without waiting for the thread."""
        self.cancelled.set()
        if self._thread.is_alive():
            self.driver.close()

    def join(self) -> None:
        """Wait for the thread."""
        if self._thread.is_alive() and self._thread is not current_thread():
            self._thread.join(_JOIN_S)

    def _run(self) -> None:
        set_device_id(self._device_id)
        attempts = 0
        try:
            while not self.cancelled.is_set():
                try:
                    self._attempt()
                except DeviceNotConnected as error:
                    self._tell("disconnected", error.detail)
                else:
                    return
                self._tried.set()
                self.cancelled.wait(RETRY_S[min(attempts, len(RETRY_S) - 1)])
                attempts += 1
        except LumilineError as error:
            self.error = error
            self._tell("failed", error.detail)
        except Exception as error:  # noqa: BLE001 - becomes the status
            _log.exception("device %s could not be started", self._device_id)
            self.error = error
            self._tell("failed", f"it failed: {type(error).__name__}: {error}")
        finally:
            self._tried.set()

    def _tell(self, state: Literal["disconnected", "failed"], reason: str) -> None:
        if (state, reason) != (self.state, self.reason) and not self.cancelled.is_set():
            self.reason, self.state = reason, state
            self._changed(self)
