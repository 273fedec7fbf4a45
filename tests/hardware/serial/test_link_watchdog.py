"""LinkWatchdog classifies a link; DescribePolicy queries and reconfigures its device."""

from hardware.serial.link_watchdog import (
    CONFIGURE_INTERVAL_NS,
    IRREGULAR_COUNT,
    IRREGULAR_NS,
    DescribePolicy,
    LinkWatchdog,
    RegularityWatch,
)


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
    """Policy of a device that fell silent after frames."""
    policy = DescribePolicy()
    policy.begin(0)
    policy.record_frames()
    return policy


def test_a_silent_device_is_queried_each_second() -> None:
    policy = silent()
    asked = [tenth for tenth in range(100) if policy.should_describe(tenth * S // 10)]
    assert asked == list(range(11, 100, 11))


def test_a_stopped_device_is_reconfigured_once_and_then_every_ten_seconds() -> None:
    policy = silent()
    status = []
    for second in range(2, 60, 2):
        assert policy.should_describe(second * S)
        if policy.should_configure(second * S + 1):
            status.append(second)
    assert status == [2, 14, 26, 38, 50]
    assert CONFIGURE_INTERVAL_NS == 10 * S


def resting() -> DescribePolicy:
    """Policy that resent the settings at 2 s, and not at 4 s."""
    policy = silent()
    assert policy.should_describe(2 * S)
    assert policy.should_configure(2 * S)
    assert policy.should_describe(4 * S)
    assert not policy.should_configure(4 * S)
    return policy


def test_an_unsolicited_description_is_a_reset() -> None:
    assert resting().should_configure(5 * S)


def test_a_device_that_did_not_answer_may_have_been_reset() -> None:
    policy = resting()
    assert policy.should_describe(6 * S)
    assert policy.should_describe(8 * S)
    assert policy.should_configure(8 * S)


def test_after_frames_and_connections_it_is_reconfigured_at_once() -> None:
    for again in (DescribePolicy.record_frames, lambda policy: policy.begin(4 * S)):
        policy = resting()
        again(policy)
        assert policy.should_describe(6 * S)
        assert policy.should_configure(6 * S)


def test_regularity_watch_tells_resets_that_follow_each_other_only() -> None:
    rare, often = RegularityWatch(), RegularityWatch()
    for number in range(1, 20):
        assert rare.check(number, number * IRREGULAR_NS) is None
    for number in range(1, IRREGULAR_COUNT):
        assert often.check(number, number * S) is None
    assert "began anew" in (often.check(IRREGULAR_COUNT, IRREGULAR_COUNT * S) or "")
    assert often.check(IRREGULAR_COUNT, S + IRREGULAR_NS) is not None
    assert often.check(IRREGULAR_COUNT, S + IRREGULAR_NS + 1) is None
