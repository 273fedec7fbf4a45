"""How a link is judged by what comes."""

from hardware.serial.link_watchdog import LinkWatchdog

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
