"""The thesis's methods along one sensor, scan by scan: as over a whole recording, and on and on."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from validation.thesis_tracking.finite_difference_kinematics import FiniteDifferenceKinematics
from validation.thesis_tracking.intervals import IntervalSettings
from validation.thesis_tracking.pair_tracker import Decision
from validation.thesis_tracking.pair_tracking import PairTracking
from validation.thesis_tracking.probabilistic_sensor_tracker import ProbabilisticSensorTracker
from validation.thesis_tracking.probabilistic_tracker import (
    AssociationSettings,
    ProbabilisticTracker,
)
from validation.thesis_tracking.quadratic_window import QuadraticWindow
from validation.thesis_tracking.scan_clock import ScanClock
from validation.thesis_tracking.sensor_point import SensorPoint
from validation.thesis_tracking.settings import ThesisSettings
from validation.thesis_tracking.subsets import order_by_detection
from validation.thesis_tracking.window_sensor_tracker import WindowSensorTracker

Array = NDArray[np.float64]

INTERVAL_S = 1.0 / 30.0
FAST = 1e6
SIGMA_PX = 0.1


def turning(scans: int = 120, missed: float = 0.0, seed: int = 0) -> Array:
    """Positions of both ends of a bar, in any order, (N, 2); NaN where one is not seen."""
    rng = np.random.default_rng(seed)
    angle = 2.0 * np.pi * np.arange(scans)[:, None] / 60.0 + np.array([0.4, 0.4 + np.pi])
    found = 200.0 + 100.0 * np.cos(angle) + SIGMA_PX * rng.standard_normal((scans, 2))
    found[1:][rng.random((scans - 1, 2)) < missed] = np.nan
    return np.asarray(rng.permuted(found, axis=1))


def window(targets: int = 2, **more: object) -> WindowSensorTracker:
    settings = ThesisSettings("window", max_velocity_px_s=FAST, **more)  # type: ignore[arg-type]
    return WindowSensorTracker(settings, targets)


def steps(
    follower: WindowSensorTracker | ProbabilisticSensorTracker,
    scans: Sequence[Sequence[float]] | Array,
) -> list[Sequence[SensorPoint]]:
    return [
        follower.step(np.array(scan), np.full(len(scan), SIGMA_PX), INTERVAL_S) for scan in scans
    ]


@pytest.mark.parametrize("decision", ["velocity", "prediction"])
def test_the_window_live_has_the_tracks_of_the_recording(decision: Decision) -> None:
    """Two targets that are seen at first: the same points, bit by bit, gaps included."""
    points = turning(missed=0.03)
    limit = 150.0
    whole = PairTracking(limit, INTERVAL_S, decision=decision).run(order_by_detection(points))
    assert whole.created.any()
    assert whole.switched.any()
    # Seven points of each track, however it is kept.
    for scan in range(1, len(points)):
        for track in range(2):
            expected = QuadraticWindow().next_position(whole.position_px[:scan, track])
            assert whole.predicted_px[scan, track] == expected
    live = steps(
        window(velocity_limit_px_s=limit, window_decision=decision, young_scans=10**6), points
    )
    for scan, found in enumerate(live):
        assert [one.number for one in found] == [0, 1]
        assert [one.position_px for one in found] == whole.position_px[scan].tolist()
        for track, one in enumerate(found):
            assert (one.peak < 0) == whole.created[scan, track]
            assert (one.deviation_px > 0.0) == whole.created[scan, track]
            if one.peak >= 0:
                assert points[scan, one.peak] == one.position_px


def test_targets_come_and_go() -> None:
    nan = np.nan
    one = window(coast_scans=2, young_scans=3)
    # Three points are more than two targets: no track begins.
    assert steps(one, [[1.0, 2.0, 3.0]]) == [[]]
    alone = steps(one, [[10.0]] * 4)[-1]
    assert [(point.number, point.life) for point in alone] == [(0, 4)]
    both = steps(one, [[10.0, 50.0]] * 3)[-1]
    assert [(point.number, point.position_px) for point in both] == [(0, 10.0), (1, 50.0)]
    # Two scans are made up, then the track ends; the other goes on.
    gaps = steps(one, [[10.0, nan]] * 3)
    assert [[point.number for point in scan] for scan in gaps] == [[0, 1], [0, 1], [0]]
    assert gaps[1][1].peak == -1
    assert gaps[1][1].position_px == pytest.approx(50.0)
    # The next one is another.
    assert [point.number for point in steps(one, [[10.0, 50.0]])[0]] == [0, 2]


def test_what_no_target_can_have_reached_is_another_target() -> None:
    settings = ThesisSettings("window", markers=1, max_velocity_px_s=30.0, coast_scans=0)
    one = WindowSensorTracker(settings, 1)
    steps(one, [[10.0], [10.5], [11.0]])
    far = steps(one, [[20.0]])[0]
    assert [(point.number, point.position_px) for point in far] == [(1, 20.0)]
    near = steps(one, [[20.9]])[0]
    assert [(point.number, point.position_px) for point in near] == [(1, 20.9)]


def test_two_tracks_on_one_target_are_parted() -> None:
    """Track 0 goes over as its target turns back sharply; it is on the other's, and ends."""
    left = [100.0, 90.0, 80.0, 90.0, 100.0, 110.0, 120.0, 130.0, 140.0]
    right = [300.0 + scan for scan in range(len(left))]
    found = steps(window(velocity_limit_px_s=100.0, young_scans=3), np.column_stack([left, right]))
    numbers = [sorted(point.number for point in scan) for scan in found]
    assert numbers[3] == [0, 1]
    assert [point.shared for point in found[3]] == [True, True]
    # The older one stays, where it is; the free point has a new one.
    assert numbers[-1] == [0, 2]
    assert sorted(point.position_px for point in found[-1]) == [140.0, 308.0]
    assert not any(point.shared for point in found[-1])


def test_the_probabilistic_model_live_has_the_tracks_of_the_recording() -> None:
    points = turning(missed=0.03)
    settings = ThesisSettings("probabilistic", max_velocity_px_s=400.0, min_interval_px=5.0)
    model = AssociationSettings(
        IntervalSettings(400.0, min_half_width_px=5.0), INTERVAL_S, coast_scans=6
    )
    whole = ProbabilisticTracker(model)
    for scan in points:
        whole.step(scan)
    tracks = {track.number: track for track in whole.tracks()}
    live = steps(ProbabilisticSensorTracker(settings), points)
    assert sum(map(len, live)) > 200
    for scan, found in enumerate(live):
        for one in found:
            track, place = tracks[one.number], scan - tracks[one.number].first_scan
            assert one.position_px == track.position_px[place]
            assert (one.peak >= 0) == track.seen[place]
            assert one.shared == track.shared[place]
            assert one.life == track.seen[: place + 1].sum()
            if one.peak >= 0:
                assert points[scan, one.peak] == one.position_px
            else:
                assert one.deviation_px > 0.0


def test_a_probabilistic_tracker_that_forgets_does_not_grow() -> None:
    points = turning(400, missed=0.1)
    model = AssociationSettings(IntervalSettings(400.0, min_half_width_px=5.0), INTERVAL_S)
    keeping, forgetting = ProbabilisticTracker(model), ProbabilisticTracker(model)
    for scan in points:
        assert keeping.step(scan) == forgetting.step(scan)
        forgetting.forget()
    most = max(model.interval.scans + 1, model.coast_scans + 2)
    left = {track.number: track for track in forgetting.tracks()}
    assert len(keeping.tracks()) > len(left) > 0
    for track in keeping.tracks():
        if track.number in left:
            own = left[track.number]
            assert len(own.position_px) <= most
            assert own.first_scan + len(own.position_px) == 400
            np.testing.assert_array_equal(
                own.position_px, track.position_px[-len(own.position_px) :]
            )


def test_a_period_that_is_given_takes_the_settings_place() -> None:
    model = AssociationSettings(IntervalSettings(100.0), 1.0)
    one = ProbabilisticTracker(model)
    one.step([10.0], 0.1)
    # 100 px/s are 10 px in a tenth of a second, and 100 in the second of the settings.
    assert [(point.number, point.peak) for point in one.step([25.0])] == [(1, 0)]
    other = ProbabilisticTracker(model)
    other.step([10.0])
    assert [(point.number, point.peak) for point in other.step([25.0])] == [(0, 0)]


@given(st.integers(3, 9), st.integers(1, 12), st.integers(0, 10**6))
def test_the_deviation_of_a_prediction_is_at_most_that_of_errors_that_are_one(
    points: int, count: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    deviations = rng.uniform(0.1, 3.0, count)
    one = QuadraticWindow(points)
    # The prediction is linear: what a unit error of each point makes of it.
    shares = np.array([one.next_position(unit) for unit in np.eye(count)])
    assert one.next_deviation(deviations) == pytest.approx(float(np.abs(shares) @ deviations))


def test_the_clock_counts_lost_exposures_and_no_uneven_ones() -> None:
    clock = ScanClock()
    rng = np.random.default_rng(3)
    taken = [0, 1, 2, 3, 5, 6, 9, 10, 11]
    found = [clock.step(round(1e7 * (scan + rng.uniform(-0.2, 0.2)))) for scan in taken]
    assert found == [1, 1, 1, 1, 2, 1, 3, 1, 1]
    assert clock.interval_s == pytest.approx(0.01, rel=0.2)


def test_the_clock_gets_over_a_loss_at_the_beginning() -> None:
    clock = ScanClock()
    found = [clock.step(scan * 10_000_000) for scan in (0, 3, 4, 5, 6, 7, 9)]
    assert found[-2:] == [1, 2]
    assert clock.interval_s == pytest.approx(0.01)


def test_a_trail_has_the_differences_of_its_points_and_goes_on() -> None:
    """Of a parabola the second difference is the acceleration, at whatever times."""
    times_s = np.array([0.0, 0.01, 0.025])
    start, speed = np.array([1.0, 2.0, 3.0]), np.array([50.0, -20.0, 5.0])
    bend = np.array([400.0, 0.0, -100.0])
    trail = FiniteDifferenceKinematics(1e-9, 1e-9)
    spread = 0.01 * np.eye(3)
    for time in times_s.tolist():
        place = start + speed * time + bend * time**2 / 2.0
        trail.add(round(time * 1e9), place, spread)
    assert trail.is_complete
    mean, covariance = trail.at(25_000_000)
    np.testing.assert_allclose(mean[:3], place)
    np.testing.assert_allclose(mean[3:6], speed + bend * (0.01 + 0.025) / 2.0)
    np.testing.assert_allclose(mean[6:], bend)
    assert covariance[3, 3] == pytest.approx(2.0 * 0.01 / 0.015**2)
    later, wider = trail.at(125_000_000)
    np.testing.assert_allclose(later[:3], mean[:3] + 0.1 * mean[3:6])
    np.testing.assert_allclose(later[3:], mean[3:])
    assert (np.linalg.eigvalsh(wider[:3, :3]) > np.linalg.eigvalsh(covariance[:3, :3])).all()


def test_what_the_motion_does_between_the_points_is_in_the_covariance() -> None:
    """White jerk, as stated: 2000 trails of exact points, whose differences lag."""
    jerk, step_s, fine = 1e6, 0.01, 20
    rng = np.random.default_rng(5)
    h = step_s / fine
    noise = np.sqrt(jerk * h) * rng.standard_normal((2 * fine, 2000, 3))
    acceleration = np.cumsum(noise, axis=0)
    before = np.concatenate([np.zeros((1, 2000, 3)), acceleration[:-1]])
    velocity = np.cumsum((acceleration + before) / 2.0 * h, axis=0)
    slower = np.concatenate([np.zeros((1, 2000, 3)), velocity[:-1]])
    place = np.cumsum((velocity + slower) / 2.0 * h, axis=0)
    points = np.stack([np.zeros((2000, 3)), place[fine - 1], place[-1]])
    second = (points[2] - 2.0 * points[1] + points[0]) / step_s**2
    off = float(np.var(acceleration[-1] - second))
    trail = FiniteDifferenceKinematics(1e-9, jerk)
    for frame in range(3):
        trail.add(frame * 10_000_000, np.zeros(3), 1e-30 * np.eye(3))
    assert trail.at(20_000_000)[1][6, 6] == pytest.approx(off, rel=0.1)
