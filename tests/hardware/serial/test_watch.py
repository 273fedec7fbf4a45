"""How a link is judged by what comes."""

from hardware.serial.watch import Watch

S = 1_000_000_000


def watch() -> Watch:
    made = Watch(1.0)
    made.begin(0, bad=7)
    assert made.judge(S) == ("connected", None)
    return made


def test_nothing_comes() -> None:
    phase, reason = watch().judge(S + 1)
    assert phase == "silent"
    assert "nothing came for 1 s" in (reason or "")


def test_a_device_that_rests_and_tells_its_status_is_silent_and_not_garbled() -> None:
    """Each second; and it stays so between two of them."""
    resting = watch()
    for tenth in range(5, 100):
        if tenth % 10 == 5:
            resting.came(tenth * S // 10, frames=False, messages=True, bad=7)
        if tenth > 10:
            phase, reason = resting.judge(tenth * S // 10)
            assert phase == "silent"
            assert "no exposures for 1 s, though the device answers" in (reason or "")
    resting.came(10 * S, frames=True, messages=False, bad=7)
    assert resting.judge(10 * S) == ("connected", None)
    assert "nothing came" in (resting.judge(12 * S)[1] or "")


def test_a_device_whose_lines_are_damaged_is_garbled_though_its_status_is_whole() -> None:
    damaged = watch()
    for number in range(1, 30):
        damaged.came(number * S // 10, frames=False, messages=number % 10 == 0, bad=7 + number)
    assert damaged.judge(29 * S // 10)[0] == "garbled"
    assert damaged.judge(4 * S)[0] == "garbled"
    assert damaged.judge(5 * S)[0] == "silent"


def test_bytes_that_are_no_message_are_garbled() -> None:
    """Another speed of the line: nothing that ends."""
    foreign = watch()
    foreign.came(2 * S, frames=False, messages=False, bad=7)
    assert foreign.judge(2 * S)[0] == "garbled"
    assert foreign.judge(3 * S + 1)[0] == "silent"


def test_what_came_before_the_last_frame_says_nothing() -> None:
    status, damage = watch(), watch()
    status.came(18 * S // 10, frames=False, messages=True, bad=7)
    damage.came(18 * S // 10, frames=False, messages=False, bad=8)
    for made in (status, damage):
        made.came(2 * S, frames=True, messages=False, bad=made._bad)
        assert "nothing came" in (made.judge(31 * S // 10)[1] or "")
