"""When a device that sends no frames is asked what it is, and when it is told its settings anew."""

from typing import Final

DESCRIBE_INTERVAL_NS: Final = 1_000_000_000
CONFIGURE_INTERVAL_NS: Final = 10_000_000_000
"""A device that rests, and answers, is told its settings anew so often and no more."""


class DescribePolicy:
    """Keeps what was asked, answered and told on one connection."""

    def __init__(self) -> None:
        self._asked_ns = 0
        self._told_ns: int | None = None
        self._open = False

    def begin(self, now_ns: int) -> None:
        """The connection is new, and the device was told its settings."""
        self._asked_ns = now_ns
        self._told_ns, self._open = None, False

    def frames_came(self) -> None:
        """All is well: the next silence is a new one."""
        self._told_ns = None

    def ask(self, now_ns: int) -> bool:
        """Return whether a device without frames is to be asked now; it is taken as asked."""
        if now_ns - self._asked_ns <= DESCRIBE_INTERVAL_NS:
            return False
        if self._open:  # it did not answer: it may have been off, and know nothing now
            self._told_ns = None
        self._open, self._asked_ns = True, now_ns
        return True

    def tell(self, now_ns: int) -> bool:
        """Return whether a device is to be told that said what it is; it is taken as told.

        One that says so unasked was reset. One that was asked may be resting as it should.
        """
        asked, self._open = self._open, False
        told_ns = self._told_ns
        if asked and told_ns is not None and now_ns - told_ns <= CONFIGURE_INTERVAL_NS:
            return False
        self._told_ns = now_ns
        return True
