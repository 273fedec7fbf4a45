"""A silent device is asked each second, and told anew only when it may have been reset."""

from hardware.serial.describe_policy import CONFIGURE_INTERVAL_NS, DescribePolicy

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
