"""The tracker on simulated peaks: honest covariances, identities through crossings and gaps."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.measurement.measurements import Measurements
from compute.signal.peaks import PeakFlag
from compute.tracking.motion_model import ca_transition
from compute.tracking.settings import TrackerSettings
from compute.tracking.track_batch import TrackBatch, TrackFlag, TrackState
from compute.tracking.tracker import Tracker
from tests.compute.tracking.moving_markers import MIDDLE_MM, PIXELS, Sensing, peaks_of, ring

Array = NDArray[np.float64]

STEP_S = 0.01
WHITE_JERK = 1e6
EQUAL = TrackerSettings(motion="acceleration", jerk_psd=WHITE_JERK)


def tracker(sensors: int = 4, settings: TrackerSettings = EQUAL, **options: Any) -> Tracker:
    cameras = CameraStack.of(ring(sensors))
    return Tracker(cameras, settings, pixels=(PIXELS,) * sensors, **options)


def wandering(frames: int, rng: np.random.Generator) -> Array:
    """A marker whose jerk is white noise, as the model says: place, velocity, acceleration."""
    transition, noise = ca_transition(STEP_S, WHITE_JERK)
    half = np.linalg.cholesky(noise)
    states = np.zeros((frames, 3, 3))
    states[0, 0], states[0, 1] = MIDDLE_MM, [80.0, -50.0, 30.0]
    for frame in range(1, frames):
        states[frame] = transition @ states[frame - 1] + half @ rng.standard_normal((3, 3))
    return states


def follow(
    one: Tracker,
    cameras: CameraStack,
    places: Array,
    sensing: Sensing,
    rng: np.random.Generator,
    marker: int | None = None,
) -> list[TrackBatch]:
    """The reports over exposures of places (F, N, 3)."""
    return [
        one.step(
            1 + round(frame * STEP_S * 1e9),
            Measurements.of(*peaks_of(cameras, place, sensing, rng)[:3]),
            marker,
        )
        for frame, place in enumerate(places)
    ]


def owners(batch: TrackBatch, places: Array) -> dict[int, int]:
    """Which marker each confirmed track is at, within 5 mm."""
    found = {}
    for track in np.flatnonzero(batch.state != TrackState.TENTATIVE):
        apart = np.linalg.norm(places - batch.position_mm[track], axis=1)
        if apart.min() < 5.0:
            found[int(batch.identity[track])] = int(apart.argmin())
    return found


def errors(batch: TrackBatch, truth: Array) -> Array:
    """Error in place, velocity and acceleration of the only track."""
    mean = np.concatenate(
        [batch.position_mm[0], batch.velocity_mm_s[0], batch.acceleration_mm_s2[0]]
    )
    return np.asarray(mean - truth.ravel())


@pytest.mark.parametrize("runs", [10, pytest.param(40, marks=pytest.mark.slow)])
def test_covariance_and_innovations_are_honest(runs: int) -> None:
    """NEES of the nine states, and NIS, lie within the bounds of chi-square."""
    cameras = CameraStack.of(ring())
    frames = 40
    nees, place_nees, nis, dof = [], [], 0.0, 0
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        truth = wandering(frames, rng)
        one = tracker()
        reports = follow(one, cameras, truth[:, None, 0], Sensing(), rng)
        last = reports[-1]
        assert last.state.tolist() == [TrackState.CONFIRMED]
        off = errors(last, truth[-1])
        nees.append(off @ np.linalg.solve(last.covariance[0], off))
        place_nees.append(off[:3] @ np.linalg.solve(last.covariance[0, :3, :3], off[:3]))
        nis += sum(float(batch.nis[0]) for batch in reports[20:])
        dof += sum(int(batch.dof[0]) for batch in reports[20:])
    for values, freedom in ((nees, 9), (place_nees, 3)):
        low, high = chi2.ppf([0.0005, 0.9995], runs * freedom)
        assert low < sum(values) < high
    low, high = chi2.ppf([0.0005, 0.9995], dof)
    assert low < nis < high


@pytest.mark.slow
def test_a_wrong_calibration_is_stated_and_not_filtered_away() -> None:
    """Each run has its own cameras, off by a draw of the covariance that the tracker is given."""
    models = ring()
    cameras = CameraStack.of(models)
    deviation = np.tile([1.0, 1.0, 2e-4, 2e-4, 2e-4, 0.1, 0.1], 4)
    runs, frames = 30, 40
    stated, exact = [], []
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        steps = (deviation * rng.standard_normal(28)).reshape(4, 7)
        true_cameras = cameras.retract(steps)
        truth = wandering(frames, rng)
        for covariance, values in ((np.diag(deviation**2), stated), (None, exact)):
            one = tracker(parameter_covariance=covariance)
            rng = np.random.default_rng(1000 + seed)
            last = follow(one, true_cameras, truth[:, None, 0], Sensing(), rng)[-1]
            if len(last) == 0:
                # Without the calibration's covariance the readings do not even meet.
                assert covariance is None
                values.append(np.inf)
                continue
            off = errors(last, truth[-1])[:3]
            values.append(off @ np.linalg.solve(last.covariance[0, :3, :3], off))
    low, high = chi2.ppf([0.0005, 0.9995], 3 * runs)
    assert low < sum(stated) < high
    assert np.median(exact) > 10.0 * np.median(stated)


def crossing(frames: int, apart_mm: float) -> Array:
    """Two markers that pass each other at 300 mm/s in the middle, so far apart."""
    times = STEP_S * (np.arange(frames) - frames // 2)[:, None]
    one = MIDDLE_MM + times * np.array([150.0, 30.0, 20.0])
    two = MIDDLE_MM + times * np.array([-140.0, 40.0, -30.0]) + np.array([0.0, apart_mm, 0.0])
    return np.stack([one, two], axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("sensors", [4, 6])
def test_identity_is_kept_through_crossings(sensors: int) -> None:
    """Merged peaks, losses and false peaks on the way; no identity changes, no error is hidden."""
    cameras = CameraStack.of(ring(sensors))
    sensing = Sensing(missed=0.05, false_peaks=0.1, resolution_px=4.0)
    merged, held, squares = 0, 0, []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        places = crossing(80, 1.0 + 0.5 * seed)
        reports = follow(tracker(sensors), cameras, places, sensing, rng)
        before, after = owners(reports[20], places[20]), owners(reports[-1], places[-1])
        assert sorted(before.values()) == [0, 1]
        held += before == after
        merged += sum(int((b.flags & TrackFlag.MERGED).any()) for b in reports)
        for batch, place in zip(reports[60:], places[60:], strict=True):
            for track, marker in owners(batch, place).items():
                row = int(np.flatnonzero(batch.identity == track)[0])
                off = batch.position_mm[row] - place[marker]
                squares.append(off @ np.linalg.solve(batch.covariance[row, :3, :3], off))
    assert held == 6
    assert merged > 10
    assert np.median(squares) < 6.0


def test_identity_is_kept_through_an_occlusion() -> None:
    cameras = CameraStack.of(ring())
    rng = np.random.default_rng(3)
    places = crossing(120, 40.0)
    places[50:75, 0] = np.nan
    reports = follow(tracker(), cameras, places, Sensing(missed=0.05, false_peaks=0.1), rng)
    before = owners(reports[45], places[45])
    hidden = reports[70]
    numbers = {marker: track for track, marker in before.items()}
    assert hidden.state[hidden.identity == numbers[0]].tolist() == [TrackState.COASTING]
    assert np.isnan(hidden.nis[hidden.identity == numbers[0]]).all()
    assert owners(reports[-1], places[-1]) == before


def test_a_track_lives_on_two_sensors() -> None:
    cameras = CameraStack.of(ring())
    rng = np.random.default_rng(1)
    truth = wandering(60, rng)
    one = tracker()
    for frame, state in enumerate(truth):
        position, sigma, flags, _ = peaks_of(cameras, state[None, 0], Sensing(), rng)
        if frame >= 30:
            position[:2] = np.nan
        batch = one.step(
            1 + round(frame * STEP_S * 1e9), Measurements.of(position, sigma, flags), None
        )
    assert batch.state.tolist() == [TrackState.CONFIRMED]
    assert batch.flags[0] & TrackFlag.FEW_SENSORS
    assert batch.peaks[0].tolist() == [-1, -1, 0, 0]
    off = errors(batch, truth[-1])[:3]
    assert off @ np.linalg.solve(batch.covariance[0, :3, :3], off) < chi2.ppf(0.9999, 3)


@pytest.mark.slow
def test_false_peaks_are_never_confirmed() -> None:
    """1,000 exposures of false peaks alone, two a sensor and exposure, each of them searched."""
    settings = TrackerSettings(clutter_density_per_px=2.0 / PIXELS, initiation_interval_s=0.0)
    one = tracker(4, settings)
    rng = np.random.default_rng(0)
    cameras = CameraStack.of(ring())
    nobody = np.full((1, 3), np.nan)
    sensing = Sensing(false_peaks=2.0)
    tentative = 0
    for frame in range(1000):
        batch = one.step(
            1 + frame * 10**7, Measurements.of(*peaks_of(cameras, nobody, sensing, rng)[:3]), None
        )
        tentative += len(batch)
        assert (batch.state == TrackState.TENTATIVE).all()
    assert tentative > 0


def test_the_same_input_gives_the_same_bits() -> None:
    cameras = CameraStack.of(ring())
    sensing = Sensing(missed=0.1, false_peaks=0.5, resolution_px=4.0)
    runs = [
        follow(tracker(4, TrackerSettings()), cameras, crossing(60, 2.0), sensing, rng)
        for rng in (np.random.default_rng(9), np.random.default_rng(9))
    ]
    for one, two in zip(*runs, strict=True):
        for name in ("identity", "state", "flags", "position_mm", "covariance", "peaks", "nis"):
            assert getattr(one, name).tobytes() == getattr(two, name).tobytes()


def test_the_order_of_sensors_does_not_matter() -> None:
    """With sensors exchanged, tracks stay within a fraction of their deviations."""
    models = ring()
    places = crossing(70, 2.0)
    sensing = Sensing(missed=0.05, resolution_px=4.0)
    rng = np.random.default_rng(2)
    peaks = [peaks_of(CameraStack.of(models), place, sensing, rng, room=4) for place in places]
    last = []
    for order in ([0, 1, 2, 3], [3, 1, 0, 2]):
        cameras = CameraStack.of([models[sensor] for sensor in order])
        one = Tracker(cameras, EQUAL, pixels=(PIXELS,) * 4)
        for frame, (position, sigma, flags, _) in enumerate(peaks):
            batch = one.step(
                1 + round(frame * STEP_S * 1e9),
                Measurements.of(position[order], sigma[order], flags[order]),
                None,
            )
        last.append(batch)
    rows = [np.argsort(batch.position_mm[:, 0]) for batch in last]
    off = last[0].position_mm[rows[0]] - last[1].position_mm[rows[1]]
    deviation = np.sqrt(np.diagonal(last[0].covariance[rows[0]], axis1=1, axis2=2)[:, :3])
    assert np.abs(off / deviation).max() < 0.5


def test_strobed_markers_are_known_by_their_number() -> None:
    """Two markers lit in turn, one hidden for a while; each track has its marker's number."""
    cameras = CameraStack.of(ring())
    rng = np.random.default_rng(4)
    places = np.stack([crossing(150, 30.0)[:, 0], crossing(150, 30.0)[:, 1]], axis=1)
    one = tracker()
    numbers: dict[int, set[int]] = {0: set(), 1: set()}
    for frame, place in enumerate(places):
        lit = frame % 2
        shown = np.full((2, 3), np.nan)
        if not (lit == 1 and (frame == 1 or 70 <= frame < 90)):
            shown[lit] = place[lit]
        peaks = peaks_of(cameras, shown, Sensing(false_peaks=0.2), rng)
        batch = one.step(1 + round(frame * STEP_S * 1e9), Measurements.of(*peaks[:3]), lit)
        # Each is sought in every exposure of its own, until it is there.
        assert frame in (1, *range(4, 150)) or lit in batch.marker
        for track in np.flatnonzero(batch.state != TrackState.TENTATIVE):
            numbers[int(batch.marker[track])].add(int(batch.identity[track]))
    assert [len(found) for found in numbers.values()] == [1, 1]
    final = {int(m): p for m, p in zip(batch.marker, batch.position_mm, strict=True)}
    for marker, place in final.items():
        assert np.linalg.norm(place - places[-1, marker]) < 3.0


def test_a_marker_that_stays_away_ends_and_its_number_is_not_used_again() -> None:
    cameras = CameraStack.of(ring())
    rng = np.random.default_rng(5)
    one = tracker(4, TrackerSettings(coast_s=0.2))
    places = np.repeat(MIDDLE_MM[None, None], 120, axis=0)
    places[30:80] = np.nan
    reports = follow(one, cameras, places, Sensing(), rng)
    assert len(reports[70]) == 0
    assert reports[-1].state.tolist() == [TrackState.CONFIRMED]
    assert reports[-1].identity[0] > reports[25].identity[0]
    one.reset()
    again = follow(one, cameras, places[:30], Sensing(), rng)
    assert again[-1].identity[0] > reports[-1].identity[0]


def test_another_calibration_keeps_the_tracks() -> None:
    """From cameras that are a little wrong to the right ones: the error goes, the number stays."""
    cameras = CameraStack.of(ring())
    steps = np.zeros((4, 7))
    steps[:, 1] = [1.5, -1.0, 0.5, 1.0]
    deviation = np.tile([1.0, 1.0, 2e-4, 2e-4, 2e-4, 0.1, 0.1], 4)
    one = Tracker(cameras.retract(steps), EQUAL, np.diag(deviation**2), pixels=(PIXELS,) * 4)
    rng = np.random.default_rng(7)
    batches = []
    for frame in range(60):
        if frame == 30:
            one.set_cameras(cameras)
        peaks = peaks_of(cameras, MIDDLE_MM[None], Sensing(), rng)
        batches.append(one.step(1 + frame * 10**7, Measurements.of(*peaks[:3]), None))
    before, batch = batches[29], batches[-1]
    assert before.identity.tolist() == batch.identity.tolist() == [1]
    assert np.linalg.norm(before.position_mm[0] - MIDDLE_MM) > 0.2
    off = batch.position_mm[0] - MIDDLE_MM
    assert off @ np.linalg.solve(batch.covariance[0, :3, :3], off) < chi2.ppf(0.999, 3)
    assert np.trace(batch.covariance[0, :3, :3]) < 0.1 * np.trace(before.covariance[0, :3, :3])
    with pytest.raises(InvalidParameter, match="there are 5 cameras; the tracker is for 4"):
        one.set_cameras(CameraStack.of(ring(5)))


def test_clipped_peaks_are_not_used_and_saturated_ones_count_less() -> None:
    cameras = CameraStack.of(ring())
    batches = []
    for flag in (0, PeakFlag.SATURATED, PeakFlag.CLIPPED):
        rng = np.random.default_rng(6)
        one = tracker()
        for frame in range(30):
            position, sigma, flags, _ = peaks_of(cameras, MIDDLE_MM[None], Sensing(), rng)
            if frame >= 20:
                flags[0] = flag
            batch = one.step(1 + frame * 10**7, Measurements.of(position, sigma, flags), None)
        batches.append(batch)
    plain, saturated, clipped = batches
    assert saturated.flags[0] & TrackFlag.SUSPECT_PEAK
    assert not plain.flags[0] & TrackFlag.SUSPECT_PEAK
    assert clipped.peaks[0, 0] == -1
    traces = [np.trace(batch.covariance[0, :3, :3]) for batch in batches]
    assert traces[0] < traces[1] < traces[2]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"time_ns": 5}, "time_ns is 5, the exposure before was at 100"),
        ({"marker": -1}, "marker is -1"),
        (
            {"peaks": Measurements.of(np.zeros((3, 2)), np.ones((3, 2)))},
            r"\(3, 2\); it must be \(4, K\)",
        ),
    ],
)
def test_bad_input_is_refused_with_its_value(change: dict[str, Any], message: str) -> None:
    one = tracker()
    given: dict[str, Any] = {
        "time_ns": 100,
        "peaks": Measurements.of(np.full((4, 2), 7.0), np.ones((4, 2))),
        "marker": None,
    }
    one.step(**given)
    with pytest.raises(InvalidParameter, match=message):
        one.step(**({**given, "time_ns": 200} | change))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("motion", "jerk"),
        ("detection_probability", 1.0),
        ("jerk_psd", 0.0),
        ("gate_sigma", float("nan")),
        ("confirm_hits", 0),
        ("initiation_interval_s", -1.0),
    ],
)
def test_settings_are_refused_with_their_value(name: str, value: Any) -> None:
    with pytest.raises(InvalidParameter, match=f"{name} is {value!r}"):
        TrackerSettings(**{name: value})


@pytest.mark.parametrize("marker", [None, 0])
def test_a_track_that_is_not_finite_ends_and_the_others_go_on(marker: int | None) -> None:
    """Its marker is found anew, under another number."""
    cameras, rng = CameraStack.of(ring()), np.random.default_rng(5)
    one, apart = tracker(), np.array([[-80.0, 0.0, 0.0], [90.0, 40.0, 0.0], [0.0, -70.0, 60.0]])
    count = 3 if marker is None else 1
    places = np.broadcast_to(MIDDLE_MM + apart[:count], (80, count, 3))
    before = owners(follow(one, cameras, places[:40], Sensing(), rng, marker)[-1], places[0])
    assert len(before) == count
    lost = int(one._tracks.identity[0])
    one._tracks.states.covariance[0, :, 0, 0] = np.nan
    one._tracks.states.mean[0, :, 0] = np.nan
    found = []
    for frame in range(40, 80):
        peaks = peaks_of(cameras, places[frame], Sensing(), rng)[:3]
        found.append(one.step(1 + round(frame * STEP_S * 1e9), Measurements.of(*peaks), marker))
    assert all(np.isfinite(batch.position_mm).all() for batch in found)
    after = owners(found[-1], places[0])
    assert lost not in found[0].identity
    assert sorted(after.values()) == sorted(before.values())
    assert {number for number in after if number in before} == set(before) - {lost}
