"""A device that is busy: its commands are sent again, for some seconds."""

from typing import Final

from hardware.serial.messages import Answer, FromHost, Result
from hardware.serial.port import PortDisconnected

BUSY_LIMIT_NS: Final = 3_000_000_000
"""How long a device may be busy; then its connection counts as lost, and is made anew."""
RETRY_INTERVAL_NS: Final = 250_000_000


class BusyRetry:
    """Commands that were sent without waiting for their answers, until all are obeyed.

    Attributes:
        again_ns: when the commands are to be sent again; None: they are not.
    """

    def __init__(self) -> None:
        self.retry_ns: int | None = None
        self._since_ns: int | None = None
        self._open: set[int] = set()

    def sent(self, commands: list[FromHost]) -> None:
        """These commands were sent, in place of all before."""
        if self.retry_ns is None:  # for another reason than that it was busy
            self._since_ns = None
        self._open = {command.number for command in commands}
        self.retry_ns = None

    def answered(self, answer: Answer, now_ns: int) -> None:
        """Take an answer.

        Raises:
            PortDisconnected: the device is busy for too long.
        """
        if answer.number not in self._open:
            return
        if answer.result != Result.BUSY:
            self._open.discard(answer.number)
            if not self._open:
                self._since_ns = None
            return
        if self._since_ns is None:
            self._since_ns = now_ns
        if now_ns - self._since_ns > BUSY_LIMIT_NS:
            raise PortDisconnected(f"the device is busy for {BUSY_LIMIT_NS * 1e-9:g} s")
        if self.retry_ns is None:
            self.retry_ns = now_ns + RETRY_INTERVAL_NS
