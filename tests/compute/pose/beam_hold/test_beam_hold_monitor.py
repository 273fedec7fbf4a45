"""Beam hold: when it begins, when it ends, and that it is on whenever there is a doubt."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from compute.pose.beam_hold import (
    BeamHoldCause,
    BeamHoldDecision,
    BeamHoldLimits,
    BeamHoldTiming,
    MarkerDeviationMonitor,
    PoseDeviationMonitor,
    norm_exceedance_probability,
    scalar_exceedance_probability,
)
from compute.transform import Transform, rotation_matrix
from tests.compute.pose.motions import Array, point_covariance, transforms

MS = 1_000_000
RULES = BeamHoldTiming(max_gap_ns=50 * MS, settle_ns=100 * MS)
LIMITS = BeamHoldLimits(shift_mm=1.0, rotation_rad=0.02, rules=RULES)
REFERENCE = Transform.from_rotation_vector(np.array([0.1, 0.2, 0.3]), np.array([5.0, 6.0, 1500.0]))


def at(shift_mm: float = 0.0, rotation_rad: float = 0.0, sigma_mm: float = 0.0) -> Transform:
    """Return a pose that far off the reference, along x."""
    covariance = np.diag([1e-12] * 3 + [sigma_mm**2] * 3) if sigma_mm else None
    nudge = Transform.from_rotation_vector(np.array([0.0, rotation_rad, 0.0]), np.zeros(3))
    place = REFERENCE.translation_mm + np.array([shift_mm, 0.0, 0.0])
    return Transform(nudge.rotation @ REFERENCE.rotation, place, covariance)


def running(limits: BeamHoldLimits = LIMITS) -> tuple[PoseDeviationMonitor, int]:
    """Return a monitor that has let the beam go, and the time of its last pose."""
    monitor = PoseDeviationMonitor(REFERENCE, limits)
    states = [monitor.step(time, at()) for time in range(0, 110 * MS, 10 * MS)]
    assert [state.hold for state in states] == [True] * 10 + [False]
    return monitor, 100 * MS


def test_held_until_the_first_poses_are_well_within() -> None:
    monitor = PoseDeviationMonitor(REFERENCE, LIMITS)
    first = monitor.step(0, None)
    assert (first.hold, first.cause) == (True, BeamHoldCause.NO_DATA)
    assert first.reason == "nothing was measured yet"
    settling = monitor.step(10 * MS, at())
    assert (settling.hold, settling.cause) == (True, BeamHoldCause.SETTLING)
    # Time alone releases nothing: a measurement has the last word.
    assert monitor.step(55 * MS, at()).hold
    assert monitor.step(100 * MS, at()).hold
    assert monitor.step(111 * MS, None).hold
    free = monitor.step(112 * MS, at())
    assert (free.hold, free.cause, free.reason, free.since_ns) == (
        False, BeamHoldCause.NONE, None, 112 * MS,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("pose", "words"),
    [
        (at(1.2), "1.20 mm off its reference position (limit 1.00 mm)"),
        (at(0.0, 0.03), "turned by 1.72 deg"),
    ],
)
def test_the_first_pose_beyond_a_limit_holds_at_once(pose: Transform, words: str) -> None:
    monitor, time = running()
    state = monitor.step(time + MS, pose)
    assert (state.hold, state.cause, state.since_ns) == (True, BeamHoldCause.MOVED, time + MS)
    assert state.reason is not None
    assert words in state.reason
    assert state.probability == 1.0
    assert state.shift_mm is not None
    assert state.shift_mm[0] == pytest.approx(pose.translation_mm[0] - 5.0)


def test_a_turn_moves_a_target_away_from_the_markers() -> None:
    target = np.array([0.0, 0.0, 200.0])
    near = PoseDeviationMonitor(REFERENCE, BeamHoldLimits(shift_mm=1.0, rules=RULES))
    far = PoseDeviationMonitor(REFERENCE, BeamHoldLimits(shift_mm=1.0, rules=RULES), target)
    for monitor in (near, far):
        for time in range(0, 110 * MS, 10 * MS):
            monitor.step(time, at())
    turned = at(0.0, 0.006)
    assert not near.step(101 * MS, turned).hold
    assert far.step(101 * MS, turned).hold


def test_between_the_limits_what_is_stays() -> None:
    monitor, time = running()
    assert not monitor.step(time + 10 * MS, at(0.9)).hold
    assert monitor.step(time + 20 * MS, at(1.1)).hold
    # 0.9 is within the limit and beyond 0.8, the release limit: held for as long as it lasts.
    states = [monitor.step(time + step * MS, at(0.9)) for step in range(30, 400, 10)]
    assert all(state.hold for state in states)
    assert states[-1].cause is BeamHoldCause.MOVED
    states = [monitor.step(time + step * MS, at(0.7)) for step in range(400, 510, 10)]
    assert [state.hold for state in states] == [True] * 10 + [False]
    assert states[3].cause is BeamHoldCause.SETTLING
    assert states[3].reason is not None
    assert "30 of 100 ms" in states[3].reason
    assert "1.10 mm" in states[3].reason


def test_no_data_is_a_hold() -> None:
    monitor, time = running()
    assert not monitor.step(time + 50 * MS, None).hold
    lost = monitor.step(time + 51 * MS, None)
    assert (lost.hold, lost.cause) == (True, BeamHoldCause.NO_DATA)
    assert lost.reason is not None
    assert "51 ms; at most 50 ms" in lost.reason
    # One pose after a gap releases nothing, also when nobody asked meanwhile.
    monitor, time = running()
    state = monitor.step(time + 60 * MS, at())
    assert (state.hold, state.cause) == (True, BeamHoldCause.SETTLING)


def test_time_that_goes_back_is_a_hold() -> None:
    monitor, time = running()
    back = monitor.step(time - MS, None)
    assert (back.hold, back.cause) == (True, BeamHoldCause.CLOCK)
    again = [monitor.step(time + step * MS, at()).hold for step in range(0, 110, 10)]
    assert again == [True] * 10 + [False]


def test_a_latched_hold_lasts_until_it_is_acknowledged() -> None:
    rules = BeamHoldTiming(max_gap_ns=50 * MS, settle_ns=100 * MS, latched=True)
    monitor, time = running(BeamHoldLimits(shift_mm=1.0, rules=rules))
    monitor.step(time + 10 * MS, at(5.0))
    states = [monitor.step(time + step * MS, at()) for step in range(20, 500, 10)]
    assert all(state.hold for state in states)
    assert states[-1].cause is BeamHoldCause.LATCHED
    monitor.acknowledge()
    assert not monitor.step(time + 500 * MS, at()).hold
    # Acknowledged while it is out, the hold ends when all has been within for long enough.
    monitor.step(time + 510 * MS, at(5.0))
    monitor.acknowledge()
    again = [monitor.step(time + step * MS, at()).hold for step in range(520, 630, 10)]
    assert again == [True] * 10 + [False]


def test_uncertainty_holds_sooner_and_says_so() -> None:
    monitor, time = running()
    assert not monitor.step(time + MS, at(0.5, sigma_mm=0.05)).hold
    state = monitor.step(time + 2 * MS, at(0.5, sigma_mm=0.4))
    assert state.hold
    assert state.reason is not None
    assert "probability" in state.reason
    assert state.probability is not None
    assert 0.05 < state.probability < 0.5
    # The reference's own uncertainty counts likewise.
    unsure = Transform(REFERENCE.rotation, REFERENCE.translation_mm, at(0, 0, 0.4).covariance)
    assert PoseDeviationMonitor(unsure, LIMITS).step(0, at(0.5)).probability == pytest.approx(
        state.probability
    )


def test_limits_along_axes_of_the_room() -> None:
    quarter = Transform.from_rotation_vector(
        np.array([0.0, 0.0, np.pi / 2.0]), np.zeros(3)
    ).rotation
    limits = BeamHoldLimits(axis_mm=(5.0, 0.5, 5.0), rules=RULES)
    # Along x of the world is along y of the room.
    for axes, held in ((None, False), (quarter, True)):
        monitor = PoseDeviationMonitor(REFERENCE, limits, axes=axes)
        for time in range(0, 110 * MS, 10 * MS):
            monitor.step(time, at())
        state = monitor.step(101 * MS, at(1.0))
        assert state.hold is held
        assert axes is None or "along y" in str(state.reason)


MARKERS = np.array([[0.0, 0.0, 0.0], [80.0, 0.0, 0.0], [0.0, 90.0, 0.0], [50.0, 50.0, 50.0]])
NAMES = ("chin", "nose", "brow", "ear")


def watched(**named: int) -> MarkerDeviationMonitor:
    limits = BeamHoldLimits(shift_mm=1.0, rules=RULES)
    monitor = MarkerDeviationMonitor(MARKERS, limits, names=NAMES, **named)
    for time in range(0, 110 * MS, 10 * MS):
        state = monitor.step(time, MARKERS)
    assert not state.hold
    return monitor


def test_the_marker_that_left_is_named() -> None:
    moved = MARKERS.copy()
    moved[2, 1] += 1.3
    moved[1, 1] += 1.2
    state = watched().step(101 * MS, moved)
    assert state.hold
    assert str(state.reason).startswith('marker "brow" is 1.30 mm off')
    assert state.shift_mm == pytest.approx([0.0, 1.3, 0.0])
    sure = np.broadcast_to(1e-4 * np.eye(3), (4, 3, 3)).copy()
    assert not watched().step(101 * MS, MARKERS, sure).hold
    sure[3] = np.eye(3)
    assert '"ear"' in str(watched().step(101 * MS, MARKERS, sure).reason)


def test_too_few_markers_are_no_data_but_one_beyond_is_enough() -> None:
    hidden = MARKERS.copy()
    hidden[:2] = np.nan
    monitor = watched()
    assert not monitor.step(140 * MS, hidden).hold
    state = monitor.step(151 * MS, hidden)
    assert (state.hold, state.cause) == (True, BeamHoldCause.NO_DATA)
    assert watched(min_markers=2).step(151 * MS, hidden).cause is not BeamHoldCause.NO_DATA
    hidden[3] += 9.0
    assert watched().step(101 * MS, hidden).cause is BeamHoldCause.MOVED
    assert watched().step(151 * MS, None).cause is BeamHoldCause.NO_DATA


@settings(max_examples=60)
@given(
    st.lists(
        st.tuples(
            st.integers(0, 80),
            st.none() | st.floats(-2.0, 2.0),
            st.sampled_from([0.0, 0.1, 0.5]),
        ),
        max_size=60,
    ),
    st.booleans(),
)
def test_whatever_comes_the_beam_is_on_only_when_it_may_be(
    given_steps: list[tuple[int, float | None, float]], latched: bool
) -> None:
    rules = BeamHoldTiming(max_gap_ns=50 * MS, settle_ns=100 * MS, latched=latched)
    limits = BeamHoldLimits(shift_mm=1.0, rules=rules)
    states: list[BeamHoldDecision] = []
    for _ in range(2):
        monitor, time, seen = PoseDeviationMonitor(REFERENCE, limits), 0, None
        states_now = []
        for step, shift, sigma in given_steps:
            time += step * MS
            pose = None if shift is None else at(shift, 0.0, sigma)
            gap = None if seen is None else time - seen
            seen = time if shift is not None else seen
            state = monitor.step(time, pose)
            states_now.append(state)
            if not state.hold:
                assert gap is not None
                assert gap <= 50 * MS
                assert shift is None or abs(shift) <= 1.0
                assert state.probability is None or state.probability <= 0.05
                assert state.reason is None
            else:
                assert state.reason
        # The same times and poses give the same states.
        assert not states or [s.hold for s in states] == [s.hold for s in states_now]
        states = states_now


def test_the_chance_of_being_longer_is_what_draws_make_of_it() -> None:
    for seed in range(40):
        rng = np.random.default_rng(seed)
        covariance = point_covariance(rng, rng.uniform(0.05, 1.0))
        mean = rng.normal(size=3)
        draws = mean + rng.normal(size=(4000, 3)) @ np.linalg.cholesky(covariance).T
        limit = float(np.quantile(np.linalg.norm(draws, axis=1), rng.uniform(0.02, 0.98)))
        share = float((np.linalg.norm(draws, axis=1) > limit).mean())
        spread = 4.5 * np.sqrt(max(share * (1.0 - share), 1e-3) / 4000)
        assert abs(norm_exceedance_probability(mean, covariance, limit) - share) < spread + 0.02


@given(transforms(covariance=False), st.floats(0.1, 3.0), st.integers(0, 100))
def test_the_chance_knows_no_direction(motion: Transform, limit: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    mean, covariance = rng.normal(size=3), 0.1 * point_covariance(rng, 1.0)
    turned: Array = motion.rotation @ covariance @ motion.rotation.T
    here = norm_exceedance_probability(mean, covariance, limit)
    assert norm_exceedance_probability(motion.rotation @ mean, turned, limit) == pytest.approx(
        here, abs=1e-6
    )
    assert 0.0 <= here <= 1.0


def test_chances_that_are_known() -> None:
    assert norm_exceedance_probability(np.array([0.9, 0.0, 0.0]), None, 1.0) == 0.0
    assert norm_exceedance_probability(np.array([1.1, 0.0, 0.0]), np.zeros((3, 3)), 1.0) == 1.0
    # One direction only is uncertain: normal along it.
    line = np.diag([0.01, 0.0, 0.0])
    assert norm_exceedance_probability(np.array([1.0, 0.0, 0.0]), line, 1.0) == pytest.approx(
        0.5, abs=1e-9
    )
    assert norm_exceedance_probability(np.array([0.8, 0.0, 0.0]), line, 1.0) == pytest.approx(
        0.02275, abs=1e-5
    )
    # Of a ball: Maxwell's distribution.
    assert norm_exceedance_probability(np.zeros(3), np.eye(3), 2.0) == pytest.approx(
        0.26146, abs=0.01
    )
    assert scalar_exceedance_probability(0.0, 1.0, 1.959964) == pytest.approx(0.05, abs=1e-6)
    assert scalar_exceedance_probability(2.0, 0.0, 1.0) == 1.0


def test_settings_that_mean_nothing() -> None:
    with pytest.raises(InvalidParameter, match="at least one"):
        BeamHoldLimits()
    with pytest.raises(InvalidParameter, match="shift -1"):
        BeamHoldLimits(shift_mm=-1.0)
    with pytest.raises(InvalidParameter, match=r"probability is 0\.7"):
        BeamHoldLimits(shift_mm=1.0, probability=0.7)
    with pytest.raises(InvalidParameter, match="release_fraction is 0"):
        BeamHoldLimits(shift_mm=1.0, release_fraction=0.0)
    with pytest.raises(InvalidParameter, match="max_gap_ns is 0"):
        BeamHoldTiming(max_gap_ns=0)
    with pytest.raises(InvalidParameter, match="5 of 4"):
        MarkerDeviationMonitor(MARKERS, BeamHoldLimits(shift_mm=1.0), min_markers=5)
    with pytest.raises(InvalidParameter, match="do not turn"):
        MarkerDeviationMonitor(MARKERS, LIMITS)


@given(st.tuples(*[st.floats(-1.7, 1.7)] * 3))
def test_the_turn_told_is_the_rotation_vector(vector: tuple[float, float, float]) -> None:
    monitor = PoseDeviationMonitor(REFERENCE, BeamHoldLimits(shift_mm=1.0, rules=RULES))
    turned = Transform(rotation_matrix(np.array(vector)) @ REFERENCE.rotation, np.zeros(3))
    state = monitor.step(0, turned)
    assert state.rotation_rad is not None
    np.testing.assert_allclose(state.rotation_rad, vector, atol=1e-9)


def test_what_fails_holds_now_and_settles_anew_at_any_time() -> None:
    monitor, time = running()
    assert monitor.must_acknowledge is False
    state = monitor.fail("the device is stopped")
    assert (state.hold, state.cause, state.reason) == (
        True, BeamHoldCause.NO_DATA, "the device is stopped",
    )  # fmt: skip
    assert monitor.measured_ns is None
    # Its clock began anew: that is no fault now.
    states = [monitor.step(step * MS, at()) for step in range(0, 110, 10)]
    assert {one.cause for one in states} == {BeamHoldCause.SETTLING, BeamHoldCause.NONE}
    assert [one.hold for one in states] == [True] * 10 + [False]
    assert time > 0


def test_a_latch_goes_on_from_another_monitor() -> None:
    rules = BeamHoldTiming(max_gap_ns=50 * MS, settle_ns=100 * MS, latched=True)
    limits = BeamHoldLimits(shift_mm=1.0, rules=rules)
    first, time = running(limits)
    assert first.must_acknowledge
    next_one = PoseDeviationMonitor(REFERENCE, limits, latched=first.must_acknowledge)
    states = [next_one.step(time + step * MS, at()) for step in range(0, 300, 10)]
    assert states[-1].cause is BeamHoldCause.LATCHED
    next_one.acknowledge()
    assert not next_one.step(time + 300 * MS, at()).hold
    free = PoseDeviationMonitor(REFERENCE, BeamHoldLimits(shift_mm=1.0, rules=RULES), latched=True)
    # Rules without a latch do not end one that waits.
    states = [free.step(step * MS, at()) for step in range(0, 310, 10)]
    assert states[-1].cause is BeamHoldCause.LATCHED
    assert free.must_acknowledge
    free.acknowledge()
    assert not free.step(310 * MS, at()).hold
    assert not free.must_acknowledge


def test_the_longest_gap_counts_from_the_oldest_marker_that_is_needed() -> None:
    for least, held in ((3, True), (2, False)):
        limits = BeamHoldLimits(shift_mm=1.0, rules=BeamHoldTiming(50 * MS, 0))
        monitor = MarkerDeviationMonitor(MARKERS[:3], limits, least)
        assert not monitor.step(0, MARKERS[:3]).hold
        # The third was seen at 0; the others are seen anew.
        for time in (20 * MS, 40 * MS):
            times = np.array([time, time, 0])
            assert not monitor.step(time, MARKERS[:3], None, times).hold
        after = monitor.step(51 * MS, MARKERS[:3], None, np.array([51, 51, 0]) * MS)
        assert after.hold is held
        assert monitor.measured_ns == (0 if held else 51 * MS)
