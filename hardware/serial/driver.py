"""SerialDriver: driver of a device on a serial port that reconnects after a loss."""

from collections.abc import Callable, Iterator

from hardware.driver import DeviceDescription
from hardware.line_frame import LineFrame
from hardware.link import LinkState
from hardware.serial.session import SerialSession
from hardware.serial.settings import SerialSettings


class SerialDriver:
    """A device that speaks the line-scan protocol on a serial port; a ``LinkedDriver``.

    Args:
        name: the device's name.
        settings: port, and settings sent to the device.
    """

    lossless = False

    def __init__(self, name: str, settings: SerialSettings) -> None:
        self._name = name
        self._settings = settings
        self._changed: Callable[[LinkState], None] = lambda _: None
        self._run: SerialSession | None = None

    @property
    def description(self) -> DeviceDescription:
        """The device's properties, from its description; valid after ``open``.

        Raises:
            RuntimeError: the driver is not open.
        """
        return self._opened().description

    def open(self) -> None:
        """Connect and read the description; takes at most 5 s, 3 s more if it is busy.

        Raises:
            DeviceNotConnected: it is not there, does not answer, or stays busy.
            InvalidParameter: it does not support its settings.
        """
        self.close()
        run = self._run = SerialSession(self._name, self._settings)
        run.open()

    def close(self) -> None:
        """End ``frames`` and release the port; may be called from any thread, and twice."""
        run = self._run
        if run is not None:
            run.close()

    def listen(self, changed: Callable[[LinkState], None]) -> None:
        """Register the listener of link changes; called from the thread of ``frames``."""
        self._changed = changed

    def link(self) -> LinkState:
        """Return the state of the link; "disconnected" before ``open``."""
        run = self._run
        return LinkState("disconnected", "it was not opened yet") if run is None else run.link()

    def frames(self) -> Iterator[LineFrame]:
        """Yield frames until ``close`` is called; reconnect after each loss.

        Raises:
            DeviceChanged: another device came back, or one with other values of its sensors.
            InvalidParameter: the device refuses its settings, or its clock cannot be counted on.
            RuntimeError: the driver is not open.
        """
        return self._opened().frames(self._changed)

    def _opened(self) -> SerialSession:
        if self._run is None:
            raise RuntimeError("the driver is not open; call open() first")
        return self._run
