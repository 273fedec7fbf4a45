"""How a link is judged by what comes."""

from hardware.serial.link_watchdog import CONFIGURE_INTERVAL_NS, DescribePolicy, LinkWatchdog

S = 1_000_000_000


def watch() -> LinkWatchdog:
    made = LinkWatchdog(1.0)
    made.begin(0, rejected=7)
    assert made.check(S) == ("connected", None)
    return made


def test_nothing_comes() -> None:
    phase, reason = watch().check(S + 1)
    assert phase == "silent"
    assert "nothing came for 1 s" in (reason or "")


def test_a_device_that_rests_and_tells_its_status_is_silent_and_not_garbled() -> None:
    """Each second; and it stays so between two of them."""
    resting = watch()
    for tenth in range(5, 100):
        if tenth % 10 == 5:
            resting.received(tenth * S // 10, frames=False, messages=True, rejected=7)
        if tenth > 10:
            phase, reason = resting.check(tenth * S // 10)
            assert phase == "silent"
            assert "no exposures for 1 s, though the device answers" in (reason or "")
    resting.received(10 * S, frames=True, messages=False, rejected=7)
    assert resting.check(10 * S) == ("connected", None)
    assert "nothing came" in (resting.check(12 * S)[1] or "")


def test_a_device_whose_lines_are_damaged_is_garbled_though_its_status_is_whole() -> None:
    damaged = watch()
    for number in range(1, 30):
        damaged.received(
            number * S // 10, frames=False, messages=number % 10 == 0, rejected=7 + number
        )
    assert damaged.check(29 * S // 10)[0] == "garbled"
    assert damaged.check(4 * S)[0] == "garbled"
    assert damaged.check(5 * S)[0] == "silent"


def test_bytes_that_are_no_message_are_garbled() -> None:
    """Another speed of the line: nothing that ends."""
    foreign = watch()
    foreign.received(2 * S, frames=False, messages=False, rejected=7)
    assert foreign.check(2 * S)[0] == "garbled"
    assert foreign.check(3 * S + 1)[0] == "silent"


def test_what_came_before_the_last_frame_says_nothing() -> None:
    status, damage = watch(), watch()
    status.received(18 * S // 10, frames=False, messages=True, rejected=7)
    damage.received(18 * S // 10, frames=False, messages=False, rejected=8)
    for made in (status, damage):
        made.received(2 * S, frames=True, messages=False, rejected=made._bad)
        assert "nothing came" in (made.check(31 * S // 10)[1] or "")


S = 1_000_000_000


def silent() -> DescribePolicy:
    """Of ten seconds, after frames."""
    asking = DescribePolicy()
    asking.begin(0)
    asking.frames_came()
    return asking


def test_it_is_asked_each_second() -> None:
    asking = silent()
    asked = [tenth for tenth in range(100) if asking.ask(tenth * S // 10)]
    assert asked == list(range(11, 100, 11))


def test_a_resting_device_is_told_once_and_then_every_ten_seconds() -> None:
    asking = silent()
    status = []
    for second in range(2, 60, 2):
        assert asking.ask(second * S)
        if asking.tell(second * S + 1):
            status.append(second)
    assert status == [2, 14, 26, 38, 50]
    assert CONFIGURE_INTERVAL_NS == 10 * S


def resting() -> DescribePolicy:
    """Told at 2 s, and not at 4 s."""
    asking = silent()
    assert asking.ask(2 * S)
    assert asking.tell(2 * S)
    assert asking.ask(4 * S)
    assert not asking.tell(4 * S)
    return asking


def test_what_it_says_unasked_is_a_reset() -> None:
    assert resting().tell(5 * S)


def test_one_that_did_not_answer_may_have_been_reset() -> None:
    asking = resting()
    assert asking.ask(6 * S)
    assert asking.ask(8 * S)
    assert asking.tell(8 * S)


def test_after_frames_and_connections_it_is_told_at_once() -> None:
    for again in (DescribePolicy.frames_came, lambda asking: asking.begin(4 * S)):
        asking = resting()
        again(asking)
        assert asking.ask(6 * S)
        assert asking.tell(6 * S)
