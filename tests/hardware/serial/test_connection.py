"""BusyRetry: commands are repeated for some seconds, then the connection counts as lost."""

import pytest

from hardware.serial.connection import BUSY_LIMIT_NS, RETRY_INTERVAL_NS, BusyRetry
from hardware.serial.messages import Answer, FromHost, MessageType, Result, Start, Strobe
from hardware.serial.port import PortDisconnected


def status(busy: BusyRetry, first: int) -> list[FromHost]:
    commands: list[FromHost] = [Strobe(first, ()), Start(first + 1)]
    busy.sent(commands)
    return commands


def answer(busy: BusyRetry, number: int, result: Result, now_ns: int) -> None:
    busy.answered(Answer(MessageType.START, number, result), now_ns)


def test_a_busy_device_is_told_again_after_a_while() -> None:
    busy = BusyRetry()
    status(busy, 1)
    assert busy.retry_ns is None
    answer(busy, 1, Result.BUSY, 100)
    answer(busy, 2, Result.BUSY, 200)
    assert busy.retry_ns == 100 + RETRY_INTERVAL_NS
    status(busy, 3)
    assert busy.retry_ns is None
    answer(busy, 2, Result.BUSY, 300)  # to what was sent before
    assert busy.retry_ns is None


def test_a_device_that_stays_busy_is_lost() -> None:
    busy = BusyRetry()
    turns = BUSY_LIMIT_NS // RETRY_INTERVAL_NS + 1
    for turn in range(turns):
        status(busy, 2 * turn)
        answer(busy, 2 * turn, Result.BUSY, turn * RETRY_INTERVAL_NS)
        answer(busy, 2 * turn + 1, Result.DONE, turn * RETRY_INTERVAL_NS)
    status(busy, 2 * turns)
    with pytest.raises(PortDisconnected, match="busy for 3 s"):
        answer(busy, 2 * turns, Result.BUSY, turns * RETRY_INTERVAL_NS)


@pytest.mark.parametrize("obeyed", [True, False])
def test_a_later_time_is_counted_for_itself(obeyed: bool) -> None:
    """Whether the answers to what was sent again came, or were lost."""
    busy = BusyRetry()
    status(busy, 1)
    answer(busy, 1, Result.BUSY, 0)
    status(busy, 3)
    if obeyed:
        answer(busy, 3, Result.DONE, 1)
        answer(busy, 4, Result.DONE, 1)
    status(busy, 5)
    answer(busy, 5, Result.BUSY, 10 * BUSY_LIMIT_NS)
    assert busy.retry_ns is not None
