"""The thesis's methods live: identity, honest covariances, strobes, gaps, and the same bits."""

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.measurement.measurements import Measurements
from compute.signal.peaks import PeakFlag
from compute.tracking.track_batch import TrackBatch, TrackFlag, TrackState
from tests.compute.tracking.moving_markers import MIDDLE_MM, PIXELS, Sensing, peaks_of, ring
from validation.thesis_tracking.settings import ThesisMethod, ThesisSettings
from validation.thesis_tracking.thesis_tracker import ThesisTracker

pytestmark = pytest.mark.slow


Array = NDArray[np.float64]

STEP_S = 0.01
RADIUS_MM = 80.0
TURN_S = 2.0
METHODS: tuple[ThesisMethod, ...] = ("window", "probabilistic", "eight-state")
ALONG: tuple[ThesisMethod, ...] = ("window", "probabilistic")
MERGING = Sensing(resolution_px=4.0)


def given(method: ThesisMethod, **more: Any) -> ThesisSettings:
    """A method that knows how fast the markers of these scenes are, and that they accelerate."""
    known = {"max_velocity_px_s": 600.0, "min_interval_px": 5.0}
    return ThesisSettings(method, **(known | more))


def tracker(settings: ThesisSettings, sensors: int = 4) -> ThesisTracker:
    return ThesisTracker(CameraStack.of(ring(sensors)), settings, pixels=(PIXELS,) * sensors)


def circling(frames: int, markers: int = 2) -> Array:
    """Markers on a circle, opposite to one another: along each sensor they cross twice a turn."""
    angle = (
        2.0 * np.pi * (np.arange(frames)[:, None] * STEP_S / TURN_S + np.arange(markers) / markers)
    )
    places = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=2)
    return np.asarray(MIDDLE_MM + RADIUS_MM * places)


def follow(
    one: ThesisTracker,
    places: Array,
    sensing: Sensing = MERGING,
    strobe: Sequence[int] | None = None,
    skipped: Sequence[int] = (),
    seed: int = 0,
) -> list[TrackBatch]:
    """The reports over exposures of places (F, N, 3); of ``skipped`` ones there is no exposure."""
    rng, cameras = np.random.default_rng(seed), CameraStack.of(ring(len(one._space.model)))
    reports = []
    for frame, place in enumerate(places):
        lit = place.copy()
        marker = None
        if strobe is not None:
            marker = strobe[frame % len(strobe)]
            lit[np.arange(len(lit)) != marker] = np.nan
        peaks = peaks_of(cameras, lit, sensing, rng)[:3]
        if frame not in skipped:
            reports.append(
                one.step(1 + round(frame * STEP_S * 1e9), Measurements.of(*peaks), marker)
            )
    return reports


def numbers_at(reports: Sequence[TrackBatch], places: Array, near_mm: float = 10.0) -> NDArray[Any]:
    """The number of the track at each marker, 0: none that is confirmed, (F, N)."""
    found = np.zeros(places.shape[:2], dtype=np.int64)
    for frame, (batch, place) in enumerate(zip(reports, places, strict=True)):
        known = np.flatnonzero(batch.state != TrackState.TENTATIVE)
        for marker, at in enumerate(place):
            apart = np.linalg.norm(batch.position_mm[known] - at, axis=1)
            if len(apart) and apart.min() < near_mm:
                found[frame, marker] = batch.identity[known[apart.argmin()]]
    return found


def same(one: TrackBatch, other: TrackBatch) -> bool:
    return all(
        getattr(one, field.name).tobytes() == getattr(other, field.name).tobytes()
        for field in fields(one)
    )


@pytest.mark.parametrize("method", METHODS)
def test_identity_is_kept_where_markers_cross_and_a_replay_gives_the_same_bits(
    method: ThesisMethod,
) -> None:
    places = circling(150)
    readings = CameraStack.of(ring()).project(places.reshape(-1, 3)).reshape(150, 2, 4)
    crossed = (np.diff(np.sign(readings[:, 0] - readings[:, 1]), axis=0) != 0).sum(axis=0)
    assert (crossed >= 1).all()
    reports = follow(tracker(given(method)), places)
    held = numbers_at(reports, places)
    begun = 6
    assert (held[begun:] > 0).all()
    # The same two numbers from the first to the last, and nothing else.
    assert (held[begun:] == held[begun]).all()
    assert sorted(held[begun].tolist()) == [1, 2]
    assert all((batch.state != TrackState.TENTATIVE).sum() == 2 for batch in reports[begun:])
    again = follow(tracker(given(method)), places)
    assert all(same(one, other) for one, other in zip(reports, again, strict=True))


@pytest.mark.parametrize("method", METHODS)
def test_clients_get_numbers_whatever_the_sensors_miss_and_invent(method: ThesisMethod) -> None:
    """Of the 8 states there is no acceleration along Z; that is 0, and has no variance."""
    sensing = Sensing(missed=0.05, false_peaks=0.05, resolution_px=4.0)
    reports = follow(tracker(given(method)), circling(120), sensing)
    assert sum(map(len, reports)) > 100
    for batch in reports:
        for name in ("position_mm", "velocity_mm_s", "acceleration_mm_s2"):
            assert np.isfinite(getattr(batch, name)).all(), name
        known = slice(None, 8 if method == "eight-state" else 9)
        covariance = batch.covariance[:, known, known]
        assert np.isfinite(covariance).all()
        assert (np.linalg.eigvalsh(covariance) > 0.0).all()
        assert np.isnan(batch.covariance[:, 8, 8]).all() == (
            method == "eight-state" or not len(batch)
        )
        if method == "eight-state":
            assert (batch.acceleration_mm_s2[:, 2] == 0.0).all()
            assert (np.isfinite(batch.nis) == (batch.dof == 3)).all()
        else:
            assert np.isnan(batch.nis).all()
            assert (batch.dof == (batch.peaks >= 0).sum(axis=1)).all()
        coasting = (batch.peaks < 0).all(axis=1) & (batch.state != TrackState.TENTATIVE)
        assert ((batch.state == TrackState.COASTING) == coasting).all()
        few = (batch.peaks >= 0).sum(axis=1) < 3
        assert (((batch.flags & TrackFlag.FEW_SENSORS) != 0) == few).all()


@pytest.mark.parametrize("method", ALONG)
def test_differences_have_the_covariance_that_is_stated(method: ThesisMethod) -> None:
    """A marker at constant velocity, which the models are told: NEES of all nine, in 40 runs."""
    quiet = given(method, acceleration_psd=1e-6, jerk_psd=1e-6)
    velocity = np.array([60.0, -40.0, 20.0])
    places = MIDDLE_MM + velocity * (np.arange(8) * STEP_S)[:, None]
    runs, total = 40, 0.0
    for seed in range(runs):
        last = follow(tracker(quiet), places[:, None], Sensing(), seed=seed)[-1]
        place, speed = last.position_mm[0] - places[-1], last.velocity_mm_s[0] - velocity
        off = np.concatenate([place, speed, last.acceleration_mm_s2[0]])
        total += float(off @ np.linalg.solve(last.covariance[0], off))
    low, high = chi2.ppf([0.0005, 0.9995], 9 * runs)
    assert low < total < high


@pytest.mark.parametrize("method", METHODS)
def test_a_hidden_marker_keeps_its_number_until_coast_s(method: ThesisMethod) -> None:
    places = np.repeat((MIDDLE_MM + np.array([[0.0, 0, 0], [60.0, -30, 0]]))[None], 100, axis=0)
    places += 20.0 * STEP_S * np.arange(100)[:, None, None] * np.array([1.0, 0.0, 0.0])
    seen = places.copy()
    seen[30:45, 1] = np.nan
    one = tracker(given(method, coast_s=0.3))
    reports = follow(one, seen)
    held = numbers_at(reports, places)
    assert (held[8:30] == held[8]).all()
    assert (held[48:] == held[8]).all()
    hidden = [
        TrackState(int(batch.state[batch.identity == held[8, 1]][0])) for batch in reports[31:44]
    ]
    assert set(hidden) == {TrackState.COASTING}
    # Hidden for longer it ends, and the next one has another number.
    seen[30:75, 1] = np.nan
    long = numbers_at(follow(tracker(given(method, coast_s=0.3)), seen), places)
    assert (long[66:75, 1] == 0).all()
    assert long[-1, 1] > 2
    assert long[-1, 0] == long[8, 0]


@pytest.mark.parametrize("method", METHODS)
def test_strobed_markers_are_named_by_their_slots(method: ThesisMethod) -> None:
    """Any number of them, also by the method that tells two targets apart."""
    places = circling(120, markers=3)
    reports = follow(tracker(given(method)), places, Sensing(), strobe=(0, 1, 2))
    for frame, batch in enumerate(reports[30:], 30):
        assert batch.marker.tolist() == [0, 1, 2]
        apart = np.linalg.norm(batch.position_mm - places[frame, batch.marker], axis=1)
        assert apart.max() < 3.0
        lit = batch.marker == frame % 3
        assert (batch.state == np.where(lit, TrackState.CONFIRMED, TrackState.COASTING)).all()


@pytest.mark.parametrize("method", METHODS)
def test_lost_exposures_are_scans_without_points(method: ThesisMethod) -> None:
    places = circling(150)
    lost = [*range(20, 150, 7), 60, 61, 62]
    reports = follow(tracker(given(method)), places, skipped=lost)
    kept = np.delete(places, sorted(set(lost)), axis=0)
    held = numbers_at(reports, kept)
    assert (held[8:] == held[8]).all()


@pytest.mark.slow
def test_tracks_that_were_exchanged_along_a_sensor_are_found_out_in_space() -> None:
    """With this limit the velocity test never goes over: each crossing exchanges the tracks.

    Five sensors that all measure in other directions, so that one at a time is wrong. (Where two
    that measure in the same direction are wrong together, the points are ghosts that fit.)
    """
    places = circling(250)
    blind = tracker(given("window", velocity_limit_px_s=1e9), 5)
    held = numbers_at(follow(blind, places), places)
    assert (held[12:] == held[12]).mean() > 0.95
    assert (held[-1] == held[12]).all()
    assert (held[12] > 0).all()


@pytest.mark.parametrize("method", METHODS)
def test_three_sensors_do_not_tell_two_markers_apart(method: ThesisMethod) -> None:
    """N^3 points fit exactly: none of them is a marker's. One marker alone is followed."""
    assert sum(map(len, follow(tracker(given(method), 3), circling(40)))) == 0
    alone = follow(tracker(given(method), 3), circling(40, markers=1))
    assert (numbers_at(alone, circling(40, markers=1))[8:] == 1).all()


@pytest.mark.parametrize("method", ["probabilistic", "eight-state"])
def test_markers_of_doubtful_groups_count_when_the_sensors_have_agreed(
    method: ThesisMethod,
) -> None:
    """Faint ones, with false peaks beside them: other groupings are nearly as likely."""
    places = circling(100, markers=3)
    faint = Sensing(sigma_px=0.4, missed=0.02, false_peaks=0.3)
    reports = follow(tracker(given(method, interval_velocity="curve")), places, faint, seed=1)
    held = numbers_at(reports, places)
    assert (held[:8] == 0).all()
    assert (held[20:] == held[20]).all()
    assert (held[20] > 0).all()
    # Of those that counted none was at no marker.
    counted = {
        int(number)
        for batch in reports
        for number in batch.identity[batch.state != TrackState.TENTATIVE]
    }
    assert counted <= set(held.ravel().tolist())
    begun = {int(number) for batch in reports for number in batch.identity}
    assert len(begun) >= len(counted) >= 3


@pytest.mark.parametrize("method", METHODS)
def test_numbers_are_never_used_again(method: ThesisMethod) -> None:
    one, places = tracker(given(method)), circling(12)
    first = follow(one, places)[-1]
    one.reset()
    # Time may begin anew.
    second = follow(one, places)[-1]
    assert len(first) == len(second) == 2
    assert second.identity.min() > first.identity.max()


def test_peaks_that_are_saturated_are_reported_and_clipped_ones_not_used() -> None:
    one, cameras = tracker(given("window")), CameraStack.of(ring())
    for frame, place in enumerate(circling(10, markers=1)):
        peaks = peaks_of(cameras, place, Sensing(), np.random.default_rng(frame))
        flags = peaks[2].copy()
        flags[0], flags[1] = PeakFlag.CLIPPED, PeakFlag.SATURATED
        batch = one.step(frame * 10_000_000, Measurements.of(*peaks[:2], flags), None)
    assert batch.peaks.tolist() == [[-1, 0, 0, 0]]
    assert batch.flags.tolist() == [TrackFlag.SUSPECT_PEAK]


def test_frames_without_peaks() -> None:
    for method in METHODS:
        one, nothing = tracker(given(method)), np.empty((4, 0))
        assert (
            len(one.step(1, Measurements.of(nothing, nothing, np.empty((4, 0), np.int32)), None))
            == 0
        )
        follow_on = circling(10)
        rng = np.random.default_rng(1)
        for frame, place in enumerate(follow_on, 1):
            peaks = peaks_of(CameraStack.of(ring()), place, Sensing(), rng)[:3]
            batch = one.step(frame * 10_000_000, Measurements.of(*peaks), None)
        assert len(batch) == 2
        after = one.step(
            115_000_000, Measurements.of(nothing, nothing, np.empty((4, 0), np.int32)), None
        )
        assert after.state.tolist() == [TrackState.COASTING] * 2


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        ({"method": "kalman"}, "method is 'kalman'; it must be one of window, probabilistic"),
        ({"markers": 3}, "markers is 3; section 6.1.3 tells at most 2"),
        ({"markers": 0}, "markers is 0"),
        ({"window_points": 2}, "points is 2; a quadratic curve needs 3"),
        ({"window_decision": "nearest"}, "window_decision is 'nearest'"),
        ({"interval_velocity": "last"}, "interval_velocity is 'last'"),
        ({"max_velocity_px_s": 0.0}, "max_velocity_px_s is 0.0; it must be above zero"),
        ({"velocity_limit_px_s": -1.0}, "velocity_limit_px_s is -1.0"),
        ({"min_interval_px": float("nan")}, "min_interval_px is nan"),
        ({"jerk_psd": float("inf")}, "jerk_psd is inf"),
        ({"coast_s": 0.0}, "coast_s is 0.0"),
        ({"swap_threshold": 1.0}, "swap_threshold is 1.0; it must lie between 0 and 1"),
        ({"gate_sigma": 1.0}, "gate_sigma is 1.0"),
        ({"young_scans": 0}, "young_scans is 0"),
        ({"coast_scans": -1}, "coast_scans is -1"),
    ],
)
def test_settings_that_cannot_be_are_refused(wrong: dict[str, Any], why: str) -> None:
    with pytest.raises(InvalidParameter, match=why):
        ThesisSettings(**wrong)


def test_sensors_times_and_markers_that_cannot_be_are_refused() -> None:
    with pytest.raises(InvalidParameter, match="2 sensors; the method window"):
        ThesisTracker(CameraStack.of(ring()[:2]), given("window"))
    one = tracker(given("window"))
    nothing = np.full((4, 1), np.nan), np.full((4, 1), np.nan), np.zeros((4, 1), np.int32)
    one.step(10, Measurements.of(*nothing), None)
    with pytest.raises(InvalidParameter, match="time_ns is 10"):
        one.step(10, Measurements.of(*nothing), None)
    with pytest.raises(InvalidParameter, match="marker is -1"):
        one.step(11, Measurements.of(*nothing), -1)
    with pytest.raises(InvalidParameter, match="position_px has the shape"):
        one.step(
            12, Measurements.of(np.zeros((3, 1)), np.ones((3, 1)), np.zeros((3, 1), np.int32)), None
        )
