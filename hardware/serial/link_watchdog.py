"""Link supervision: connected, silent or garbled; when to query and reconfigure a device."""

from collections import deque
from typing import Final

from hardware.link import LinkPhase

MESSAGES_NS: Final = 2_000_000_000
"""Longest time between messages of a stopped device: its status, or its description."""


class LinkWatchdog:
    """Classifies a link by the times of its last byte, frame and other message.

    Args:
        limit_s: longest tolerated time without frames [s].
    """

    def __init__(self, limit_s: float) -> None:
        self.limit_s = limit_s
        self._bytes_ns = 0
        self._frame_ns = 0
        self._bad_ns: int | None = None
        self._message_ns: int | None = None
        self._bad = 0

    def begin(self, now_ns: int, rejected: int) -> None:
        """Start with a new connection; ``rejected`` messages were unusable before it."""
        self._bytes_ns = now_ns
        self._bad = rejected
        self._frame(now_ns)

    def received(self, now_ns: int, *, frames: bool, messages: bool, rejected: int) -> None:
        """Record received bytes and the messages they completed.

        Args:
            now_ns: monotonic time [ns].
            frames: whether there were frames.
            messages: whether there were other messages.
            rejected: total number of unusable messages and exposures.
        """
        self._bytes_ns = now_ns
        if rejected != self._bad:
            self._bad, self._bad_ns = rejected, now_ns
        if messages:
            self._message_ns = now_ns
        if frames:
            self._frame(now_ns)

    def check(self, now_ns: int) -> tuple[LinkPhase, str | None]:
        """Return the link's phase at a time, and the reason."""
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
        """Record a frame: earlier errors no longer matter."""
        self._frame_ns = now_ns
        self._bad_ns = self._message_ns = None


IRREGULAR_COUNT: Final = 3
IRREGULAR_NS: Final = 10_000_000_000


class RegularityWatch:
    """Finds devices whose frames arrive but whose numbers or clock begin anew again and again."""

    def __init__(self) -> None:
        self._count = 0
        self._times_ns: deque[int] = deque(maxlen=IRREGULAR_COUNT)

    def check(self, count: int, now_ns: int) -> str | None:
        """Return what is wrong at a time, None: nothing.

        Args:
            count: of irregular exposures so far.
            now_ns: monotonic time [ns].
        """
        self._times_ns.extend([now_ns] * min(count - self._count, IRREGULAR_COUNT))
        self._count = count
        times = self._times_ns
        if len(times) < IRREGULAR_COUNT or now_ns - times[0] > IRREGULAR_NS:
            return None
        return (
            f"exposures come, but their numbers or ticks began anew {IRREGULAR_COUNT} times or "
            f"more within {IRREGULAR_NS // 1_000_000_000} s: their times and losses are not known; "
            "check the device's firmware: the sequence counts each exposure once, the ticks rise"
        )


DESCRIBE_INTERVAL_NS: Final = 1_000_000_000
CONFIGURE_INTERVAL_NS: Final = 10_000_000_000
"""Shortest time between resending the settings to a stopped device that answers."""


class DescribePolicy:
    """Decides when a silent device is queried and when its settings are sent again."""

    def __init__(self) -> None:
        self._queried_ns = 0
        self._configured_ns: int | None = None
        self._open = False

    def begin(self, now_ns: int) -> None:
        """Start with a new connection; the settings have just been sent."""
        self._queried_ns = now_ns
        self._configured_ns, self._open = None, False

    def record_frames(self) -> None:
        """Record frames: the next silence counts anew."""
        self._configured_ns = None

    def should_describe(self, now_ns: int) -> bool:
        """Return whether to query the silent device now, and record the query."""
        if now_ns - self._queried_ns <= DESCRIBE_INTERVAL_NS:
            return False
        if self._open:  # it did not answer: it may have been off, and know nothing now
            self._configured_ns = None
        self._open, self._queried_ns = True, now_ns
        return True

    def should_configure(self, now_ns: int) -> bool:
        """Return whether to resend the settings after a description, and record it.

        An unsolicited description means a reset; a solicited one may come from a device that is
        stopped on purpose.
        """
        solicited, self._open = self._open, False
        configured_ns = self._configured_ns
        if (
            solicited
            and configured_ns is not None
            and now_ns - configured_ns <= CONFIGURE_INTERVAL_NS
        ):
            return False
        self._configured_ns = now_ns
        return True
