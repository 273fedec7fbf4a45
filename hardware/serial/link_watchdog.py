"""Watches whether frames come over a link: connected, silent or garbled, with the reason."""

from typing import Final

from hardware.link import LinkPhase

MESSAGES_NS: Final = 2_000_000_000
"""A device that rests sends a message in so long a time: its status, or what it is asked for."""


class LinkWatchdog:
    """Judges a link by when the last byte, the last frame and the last other message came.

    Args:
        limit_s: how long no frame may come [s].
    """

    def __init__(self, limit_s: float) -> None:
        self.limit_s = limit_s
        self._bytes_ns = 0
        self._frame_ns = 0
        self._bad_ns: int | None = None
        self._message_ns: int | None = None
        self._bad = 0

    def begin(self, now_ns: int, rejected: int) -> None:
        """The connection is new; so many messages could not be used before it."""
        self._bytes_ns = now_ns
        self._bad = rejected
        self._frame(now_ns)

    def received(self, now_ns: int, *, frames: bool, messages: bool, rejected: int) -> None:
        """Bytes came, and with them whole frames or none, and whole messages that are no lines.

        Args:
            now_ns: when [ns].
            frames: whether frames came.
            messages: whether other messages came.
            bad: messages and exposures that could not be used, all since ``begin`` and before.
        """
        self._bytes_ns = now_ns
        if rejected != self._bad:
            self._bad, self._bad_ns = rejected, now_ns
        if messages:
            self._message_ns = now_ns
        if frames:
            self._frame(now_ns)

    def check(self, now_ns: int) -> tuple[LinkPhase, str | None]:
        """Return how the link stands at a time, and why."""
        limit_ns = self.limit_s * 1e9
        if now_ns - self._frame_ns <= limit_ns:
            return "connected", None
        slow_ns = max(limit_ns, MESSAGES_NS)
        spoils = self._bad_ns is not None and now_ns - self._bad_ns <= slow_ns
        speaks = self._message_ns is not None and now_ns - self._message_ns <= slow_ns
        if speaks and not spoils:
            return "silent", (
                f"no exposures for {self.limit_s:g} s, though the device answers: it rests, or "
                "waits for its trigger"
            )
        if spoils or now_ns - self._bytes_ns <= limit_ns:
            return "garbled", (
                f"bytes come, but no whole frame for {self.limit_s:g} s; check the device's "
                "firmware, and the speed of the line (baudrate)"
            )
        return "silent", f"nothing came for {self.limit_s:g} s; the device is asked again"

    def _frame(self, now_ns: int) -> None:
        """All is well: what else came before says nothing."""
        self._frame_ns = now_ns
        self._bad_ns = self._message_ns = None


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
