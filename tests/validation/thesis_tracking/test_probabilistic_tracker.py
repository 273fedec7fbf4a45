"""The probabilistic model: intervals, [6.9], transitions, and tracks of several targets."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import norm

from compute.errors import InvalidParameter
from validation.thesis_tracking.intervals import (
    IntervalSettings,
    PositionInterval,
    VelocityEstimate,
    position_interval,
    velocity_estimate,
)
from validation.thesis_tracking.probabilistic_tracker import (
    AssociationSettings,
    ProbabilisticTracker,
)
from validation.thesis_tracking.sensor_track import SensorTrack, TrackEnd
from validation.thesis_tracking.track_pairs import TrackPairs
from validation.thesis_tracking.track_swap import (
    Transition,
    printed_6_10,
    swap_probability,
    transition,
)

Array = NDArray[np.float64]

INTERVAL_S = 0.1
SETTINGS = IntervalSettings(max_velocity_px_s=150.0)

place = st.floats(-50.0, 50.0)
half = st.floats(0.05, 30.0)
intervals = st.builds(PositionInterval, place, half)


def followed(
    scans: list[list[float]], least: float = 1.0, most: float = 150.0, **more: object
) -> tuple[SensorTrack, ...]:
    interval = IntervalSettings(max_velocity_px_s=most, min_half_width_px=least)
    settings = AssociationSettings(interval, INTERVAL_S, **more)  # type: ignore[arg-type]
    tracker = ProbabilisticTracker(settings)
    for points in scans:
        tracker.step(points)
    return tracker.tracks()


@given(intervals, intervals, st.sampled_from(["normal", "even"]))
def test_probability_is_symmetrical_and_one_for_the_same(
    one: PositionInterval, other: PositionInterval, density: str
) -> None:
    p = swap_probability(one, other, density)  # type: ignore[arg-type]
    assert 0.0 <= p <= 1.0
    assert p == pytest.approx(swap_probability(other, one, density), abs=1e-9)  # type: ignore[arg-type]
    assert swap_probability(one, one, density) == pytest.approx(1.0)  # type: ignore[arg-type]


@given(intervals, intervals)
def test_normal_probability_is_the_area_under_both(
    one: PositionInterval, other: PositionInterval
) -> None:
    reach = 5.0 * max(one.half_width_px, other.half_width_px)
    narrow = one if one.half_width_px < other.half_width_px else other
    # Fine about the narrower one, coarse elsewhere.
    x = np.unique(
        np.concatenate(
            [
                np.linspace(-50.0 - reach, 50.0 + reach, 20_001),
                narrow.centre_px + narrow.half_width_px * np.linspace(-5.0, 5.0, 4_001),
            ]
        )
    )
    densities = [norm.pdf(x, i.centre_px, i.half_width_px / 2.0) for i in (one, other)]
    common = float(np.trapezoid(np.minimum(*densities), x))
    assert swap_probability(one, other) == pytest.approx(common / (2.0 - common), abs=2e-3)


def test_even_probability_is_common_over_joint_length() -> None:
    assert swap_probability(
        PositionInterval(0.0, 2.0), PositionInterval(3.0, 2.0), "even"
    ) == pytest.approx(1.0 / 7.0)
    inside = swap_probability(PositionInterval(0.0, 4.0), PositionInterval(1.0, 1.0), "even")
    assert inside == pytest.approx(0.25)
    assert swap_probability(PositionInterval(0.0, 1.0), PositionInterval(9.0, 1.0), "even") == 0


def test_6_10_as_printed_is_a_place_and_knows_nothing_of_the_other_target() -> None:
    n, k = PositionInterval(300.0, 4.0), PositionInterval(305.0, 4.0)
    assert printed_6_10(n, k) == 296.0  # the lower end of n's interval
    assert printed_6_10(n, PositionInterval(900.0, 4.0)) == 296.0
    assert printed_6_10(n, PositionInterval(305.0, 2.0)) == 297.0


@pytest.mark.parametrize(
    ("probabilities", "expected"),
    [
        ([0.1, 0.2, 0.3], Transition.KEEP),
        ([0.1, 0.2, 0.6], Transition.MERGE),
        ([0.6], Transition.MERGE),
        ([0.6, 0.7, 0.9], Transition.KEEP),
        ([0.6, 0.7, 0.2], Transition.SPLIT),
        ([0.2, 0.5, 0.2], Transition.CROSS),
        ([0.7, 0.2, 0.2], Transition.KEEP),
        ([], Transition.KEEP),
    ],
)
def test_conditions_of_three_scans(probabilities: list[float], expected: Transition) -> None:
    assert transition(probabilities) is expected


def test_intervals_ahead_and_as_printed() -> None:
    velocity = VelocityEstimate(-40.0, 5.0)
    ahead = position_interval(200.0, velocity, INTERVAL_S, SETTINGS)
    assert (ahead.centre_px, ahead.half_width_px) == (196.0, 1.0)
    about = position_interval(
        200.0, velocity, INTERVAL_S, IntervalSettings(max_velocity_px_s=150.0, form="about")
    )
    assert (about.centre_px, about.half_width_px) == (200.0, 5.0)
    # [6.8] as printed holds where the target has come from as well as where it goes to.
    assert 196.0 in about
    assert 204.0 in about
    assert 204.0 not in ahead


def test_velocity_of_few_scans() -> None:
    none = velocity_estimate(np.array([5.0]), INTERVAL_S, SETTINGS)
    assert (none.mean_px_s, none.deviation_px_s) == (0.0, 75.0)
    assert velocity_estimate(np.array([5.0, 6.0]), INTERVAL_S, SETTINGS).mean_px_s == 10.0
    assert velocity_estimate(np.array([5.0, 6.0, 8.0]), INTERVAL_S, SETTINGS).deviation_px_s == 75.0
    some = velocity_estimate(np.array([5.0, 6.0, 8.0, 11.0]), INTERVAL_S, SETTINGS)
    assert some.mean_px_s == pytest.approx(20.0)
    assert some.deviation_px_s == pytest.approx(10.0)
    # No faster than v_max, whatever was seen.
    assert velocity_estimate(np.array([0.0, 1e3]), INTERVAL_S, SETTINGS).mean_px_s == 150.0


def crossing(scans: int = 30) -> Array:
    t = np.arange(scans)
    return np.column_stack([100.0 + 4.0 * t, 217.0 - 4.0 * t, np.full(scans, 300.0)])


@pytest.mark.parametrize("density", ["normal", "even"])
def test_three_targets_keep_their_tracks_through_a_crossing(density: str) -> None:
    truth = crossing()
    tracks = followed(truth.tolist(), density=density)
    assert len(tracks) == 3
    ends = sorted(float(track.position_px[-1]) for track in tracks)
    assert ends == sorted(truth[-1].tolist())
    for track in tracks:
        # Of constant velocity, each its own, from the first scan to the last.
        assert track.first_scan == 0
        assert track.seen.all()
        np.testing.assert_allclose(np.diff(track.position_px, 2), 0.0, atol=1e-9)


def test_one_point_of_two_targets_is_shared() -> None:
    truth = crossing()
    truth[:, 1] -= 1.0
    scans = [sorted(row.tolist()) for row in truth]
    scans[14] = [158.0, 300.0]  # of 156 and 160
    tracks = followed(scans, least=16.0)
    assert len(tracks) == 3
    assert sorted(int(track.shared.sum()) for track in tracks) == [0, 1, 1]
    for track in tracks:
        assert abs(track.position_px[-1] - track.position_px[0]) == pytest.approx(
            0.0 if track.position_px[0] == 300.0 else 116.0, abs=1e-9
        )


def test_false_targets_have_a_short_life() -> None:
    rng = np.random.default_rng(5)
    truth = crossing(60)
    scans = [[*row.tolist(), *rng.uniform(320.0, 640.0, 1)] for row in truth]
    tracks = followed(scans)
    long = [track for track in tracks if track.life == 60]
    false = [track for track in tracks if track.life < 60]
    assert len(long) == 3
    assert len(false) > 20
    # A second false point in the wide interval of the first makes it last a scan or two.
    assert np.median([track.life for track in false]) <= 2
    # Those of the last scan have not had the time to end.
    ended = [track for track in false if track.end is not TrackEnd.RUNNING]
    assert {track.end for track in ended} <= {TrackEnd.SHORT_LIFE, TrackEnd.ABSORBED, TrackEnd.LOST}


def test_a_false_point_beside_a_target_does_not_take_its_track() -> None:
    """Their intervals are alike: the young one occupies the older one's track."""
    scans = [[100.0 + 2.0 * k] for k in range(30)]
    scans[15].append(scans[15][0] + 1.5)
    tracks = followed(scans, least=3.0, most=40.0)
    assert tracks[0].life == 30
    assert [track.end for track in tracks[1:]] == [TrackEnd.ABSORBED]
    # At a higher threshold it is not on the same track, and ends as it is not seen again.
    (_, false) = followed(scans, least=3.0, most=40.0, threshold=0.9)
    assert false.end is TrackEnd.SHORT_LIFE


def test_a_target_not_seen_is_predicted_and_then_lost() -> None:
    scans = [[100.0 + 4.0 * k] if k < 10 else [] for k in range(30)]
    (track,) = followed(scans, coast_scans=5)
    assert track.end is TrackEnd.LOST
    np.testing.assert_allclose(track.position_px, 100.0 + 4.0 * np.arange(16))
    assert track.seen.tolist() == [k < 10 for k in range(16)]
    # Seen again in time, it is the same.
    scans = [[100.0 + 4.0 * k] if not 10 <= k < 14 else [np.nan] for k in range(30)]
    assert [one.life for one in followed(scans, coast_scans=5)] == [26]


def test_targets_that_meet_and_part_again_keep_their_sides() -> None:
    """Together for many scans: that is no crossing, and their sides are not exchanged."""
    apart = 3.0 + 0.05 * (np.arange(41) - 20.0) ** 2
    scans = [[100.0 - d, 100.0 + d] for d in apart.tolist()]
    tracks = followed(scans)
    assert len(tracks) == 2
    np.testing.assert_allclose(tracks[0].position_px, 100.0 - apart)
    np.testing.assert_allclose(tracks[1].position_px, 100.0 + apart)


def test_the_side_is_that_of_before_the_meeting() -> None:
    pairs = TrackPairs(0.5, "even")
    states = [
        pairs.step({1: PositionInterval(left, 5.0), 2: PositionInterval(right, 5.0)})[1, 2]
        for left, right in ((90.0, 99.0), (101.0, 100.0), (108.0, 99.0))
    ]
    assert [state.together for state in states] == [False, True, False]
    assert states[2].transition is Transition.CROSS
    assert states[2].side == 1.0


def test_after_a_crossing_points_are_on_exchanged_sides() -> None:
    """The third condition, to the letter: together in one scan only is a crossing."""
    apart, near = [100.0, 110.0], [104.0, 106.0]
    # They are predicted to be together in the scan after they came near, and apart again later.
    left, right = followed([*[apart] * 10, near, apart, apart], least=5.0)
    assert left.position_px.tolist() == [*[100.0] * 10, 104.0, 100.0, 110.0]
    assert right.position_px.tolist() == [*[110.0] * 10, 106.0, 110.0, 100.0]
    # Together in two scans, they split: the dynamic model keeps them where they were.
    left, right = followed([*[apart] * 10, near, near, apart, apart], least=5.0)
    assert left.position_px[-1] == 100.0


def test_refused() -> None:
    with pytest.raises(InvalidParameter, match="threshold is 1"):
        AssociationSettings(SETTINGS, 0.1, threshold=1.0)
    with pytest.raises(InvalidParameter, match="interval_s is 0"):
        AssociationSettings(SETTINGS, 0.0)
    with pytest.raises(InvalidParameter, match="max_velocity_px_s is -1"):
        IntervalSettings(-1.0)
    with pytest.raises(InvalidParameter, match="form is"):
        IntervalSettings(1.0, form="behind")  # type: ignore[arg-type]
