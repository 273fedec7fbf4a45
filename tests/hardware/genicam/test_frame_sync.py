"""FrameSynchroniser: scans of one exposure are matched, others are counted."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware.genicam.frame_sync import MAX_PENDING_SCANS, CameraScan, FrameSynchroniser

NOTHING = np.zeros(0, np.uint16)
PERIOD_NS = 1_000_000


def line(number: int, host_ns: int) -> CameraScan:
    return CameraScan(number, host_ns, host_ns, NOTHING)


@settings(deadline=None)
@given(st.data(), st.integers(1, 4))
def test_exactly_the_exposures_that_all_cameras_saw_come_together(
    data: st.DataObject, cameras: int
) -> None:
    """Every camera misses some exposures and is off by less than the tolerance at times."""
    tolerance_ns = 400_000
    exposures = 30
    seen = [data.draw(st.sets(st.integers(0, exposures - 1))) for _ in range(cameras)]
    jitter = st.integers(0, tolerance_ns)
    matcher = FrameSynchroniser(cameras, tolerance_ns)
    got = []
    for number in range(exposures):
        for camera in range(cameras):
            if number in seen[camera]:
                matcher.add(camera, line(number, number * PERIOD_NS + data.draw(jitter)))
        while (matched := matcher.take()) is not None:
            got.append([one.number for one in matched])
    for camera in range(cameras):  # one that all see ends what waits
        matcher.add(camera, line(exposures, exposures * PERIOD_NS))
    while (matched := matcher.take()) is not None:
        got.append([one.number for one in matched])
    common = [*sorted(set.intersection(*seen)), exposures]
    assert got == [[number] * cameras for number in common]
    assert matcher.unmatched == sum(map(len, seen)) - cameras * (len(common) - 1)


def test_what_waits_for_a_camera_that_sends_nothing_is_bounded() -> None:
    matcher = FrameSynchroniser(2, 1000)
    for number in range(MAX_PENDING_SCANS + 5):
        matcher.add(0, line(number, number * PERIOD_NS))
    assert matcher.take() is None
    assert matcher.unmatched == 5
    matcher.add(1, line(0, 5 * PERIOD_NS))
    matched = matcher.take()
    assert matched is not None
    assert matched[0].number == 5


def test_forgotten_lines_are_counted() -> None:
    matcher = FrameSynchroniser(2, 1000)
    matcher.add(0, line(0, 0))
    matcher.forget()
    matcher.add(1, line(0, 0))
    assert matcher.take() is None
    assert matcher.unmatched == 1
