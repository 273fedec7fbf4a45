"""The benchmark of holds counts rightly what came, and what should have."""

import numpy as np
import pytest

from benchmarks.beam_hold import HoldSignal, ReceivedSignals, beginning, summed
from hardware.simulated.scenes import ShiftedPoints

MS = 1_000_000
# A cycle of 100 frames, 1 ms each: away in frames 60 to 99, out of 2 mm in 70 to 89.
TRUTH = np.zeros((100, 3))
TRUTH[60:, 0] = 1.0
TRUTH[70:90, 0] = 5.0
BEGIN = 7
"""Frame 0 that was heard is the cycle's frame 7."""


def heard(*signals: tuple[bool, int, int, str], hold: str = "a") -> ReceivedSignals:
    """Return 1000 frames and changes: held, number of the frame, ms from it, cause."""
    found = ReceivedSignals(frames={n: n * MS for n in range(1000)})
    found.shifts = {n: tuple(TRUTH[(n + BEGIN) % 100] + 0.1) for n in range(0, 1000, 3)}
    for held, number, late, cause in signals:
        found.signals.append(HoldSignal(hold, held, cause, (number + late) * MS, number))
    return found


def first_out(movement: int) -> int:
    """Return the number of the first frame out of tolerance."""
    return movement * 100 + 70 - BEGIN


def test_the_beginning_of_the_cycle_is_found() -> None:
    assert beginning(heard().shifts, TRUTH) == BEGIN
    with pytest.raises(RuntimeError, match="no frame"):
        beginning({}, TRUTH)


def test_each_kind_of_movement_is_counted_once() -> None:
    found = heard(
        (False, -1, 0, "none"),
        (True, first_out(0), 3, "moved"), (False, first_out(0) + 40, 1, "none"),
        (True, first_out(1) - 5, 2, "moved"), (False, first_out(1) + 40, 1, "none"),  # early
        (True, first_out(2), 150, "no-data"), (False, first_out(2) + 40, 1, "none"),  # late
        # Movement 3 is missed; before movement 4 it is held in any case, for nothing.
        (True, first_out(4) - 30, 1, "no-data"), (True, first_out(4) + 1, 1, "moved"),
        (False, first_out(4) + 40, 1, "none"),
    )  # fmt: skip
    other = heard((True, first_out(5), 1, "moved"), hold="b")
    found.signals += other.signals
    figures = summed(found, "a", TRUTH, 2.0, 100.0, BEGIN)
    assert figures.movements == 10
    assert (figures.already, figures.held, figures.missed) == (1, 3, 6)
    assert (figures.late, figures.early, figures.false) == (1, 1, 1)
    assert figures.causes == {"moved": 2, "no-data": 1}
    assert figures.false_causes == {"no-data": 1}
    assert figures.latency_ms["p50"] == pytest.approx(3.0)
    assert figures.latency_ms["max"] == pytest.approx(150.0)
    assert figures.signal_ms["p50"] == pytest.approx(3.0)


def test_a_movement_of_which_a_part_was_not_heard_is_none_to_judge() -> None:
    found = heard((False, -1, 0, "none"))
    found.frames = {n: n * MS for n in range(70, 990)}
    assert summed(found, "a", TRUTH, 2.0, 100.0, BEGIN).movements == 8


def test_nothing_to_judge_is_no_figure() -> None:
    with pytest.raises(RuntimeError, match="nothing left"):
        summed(heard(), "a", TRUTH * 0.1, 2.0, 100.0, BEGIN)


def test_the_scene_goes_there_and_back() -> None:
    scene = ShiftedPoints(((1.0, 2.0, 3.0), (4.0, 5.0, 6.0)), (4.0, 0.0, -3.0), 10.0, 0.4, 1.0)
    times = np.array([0.0, 5.99, 6.5, 7.0, 8.9, 9.5, 10.0, 16.5])
    share = np.array([0.0, 0.0, 0.5, 1.0, 1.0, 0.5, 0.0, 0.5])
    np.testing.assert_allclose(scene.shift(times), share[:, None] * [4.0, 0.0, -3.0], atol=1e-9)
    points = scene.points(times)
    assert points.shape == (8, 2, 3)
    np.testing.assert_allclose(points[3], [[5.0, 2.0, 0.0], [8.0, 5.0, 3.0]])
    assert scene.points(7.0).tolist() == points[3].tolist()
    with pytest.raises(Exception, match="moving_s is 2"):
        ShiftedPoints(((0.0, 0.0, 0.0),), moving_s=2.1)
