"""Many markers at once on a bar: found over several exposures, ghosts not, doubt reported."""

import numpy as np
import pytest
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.measurement.measurements import Measurements
from compute.tracking.multi_scan_initiation import MAX_FRUITLESS_EXPOSURES, MultiScanInitiator
from compute.tracking.settings import TrackerSettings
from compute.tracking.track_batch import TrackBatch, TrackFlag, TrackState
from compute.tracking.tracker import Tracker
from tests.compute.tracking.moving_markers import PIXELS, Sensing, bar, peaks_of, swinging

Array = NDArray[np.float64]

MARKERS = 12


def followed(
    sensors: int, hz: float, speed_mm_s: float, seed: int, frames: int = 40
) -> tuple[list[TrackBatch], Array]:
    cameras = CameraStack.of(bar(sensors))
    expected = 0.05 * MARKERS
    settings = TrackerSettings(clutter_density_per_px=expected / PIXELS)
    one = Tracker(cameras, settings, pixels=(PIXELS,) * sensors)
    rng = np.random.default_rng([seed, sensors])
    places = swinging(MARKERS, np.arange(frames) / hz, speed_mm_s, rng)
    sensing = Sensing(missed=0.05, false_peaks=expected, resolution_px=4.0)
    return [
        one.step(
            1 + round(frame / hz * 1e9),
            Measurements.of(*peaks_of(cameras, now, sensing, rng)[:3]),
            None,
        )
        for frame, now in enumerate(places)
    ], places


def right_and_wrong(batch: TrackBatch, places: Array) -> tuple[int, int]:
    """How many markers have a confirmed track within 3 mm; how many tracks without doubt none."""
    confirmed = batch.state != TrackState.TENTATIVE
    apart = np.linalg.norm(batch.position_mm[confirmed][:, None] - places, axis=2)
    wrong = (apart > 3.0).all(axis=1) & ((batch.flags[confirmed] & TrackFlag.AMBIGUOUS) == 0)
    return int((apart <= 3.0).any(axis=0).sum()), int(wrong.sum())


@pytest.mark.parametrize(("sensors", "hz"), [(4, 100.0), (4, 500.0), (6, 100.0)])
def test_moving_markers_are_found_and_ghosts_are_not(sensors: int, hz: float) -> None:
    """N^4 combinations, 5 % missed, 5 % false, merged within 4 px."""
    found = wrong = 0
    for seed in range(2):
        batches, places = followed(sensors, hz, 200.0, seed)
        counts = right_and_wrong(batches[-1], places[-1])
        found, wrong = found + counts[0], wrong + counts[1]
    assert found >= 0.75 * 2 * MARKERS
    assert wrong <= 1


def test_where_nothing_moves_doubt_is_reported() -> None:
    """Ghosts of markers at rest stay, and merged peaks stay merged: none is invented unflagged."""
    wrong = 0
    for seed in range(2):
        batches, places = followed(4, 100.0, 0.001, seed)
        wrong += right_and_wrong(batches[-1], places[-1])[1]
    assert wrong <= 1


def test_the_same_input_gives_the_same_bits() -> None:
    runs = [followed(4, 100.0, 200.0, 7, 25)[0] for _ in range(2)]
    for one, two in zip(*runs, strict=True):
        for name in ("identity", "state", "flags", "position_mm", "covariance", "peaks"):
            assert getattr(one, name).tobytes() == getattr(two, name).tobytes()


def test_the_search_pauses_where_nothing_comes_of_it() -> None:
    """Only false peaks, many: bursts of exposures, and longer and longer pauses between them."""
    cameras = CameraStack.of(bar())
    one = Tracker(
        cameras, TrackerSettings(clutter_density_per_px=9.0 / PIXELS), pixels=(PIXELS,) * 4
    )
    looked: list[int] = []
    crowd: MultiScanInitiator = one._initiator._dense_scene
    sequences = crowd._sequences
    find = sequences.find

    def noted(time_ns: int, *rest: object) -> object:
        looked.append(time_ns // 10**7)
        return find(time_ns, *rest)  # type: ignore[arg-type]

    sequences.find = noted  # type: ignore[method-assign, assignment]
    rng = np.random.default_rng(2)
    for frame in range(150):
        position = np.sort(rng.uniform(0.0, PIXELS - 1.0, (4, 9)), axis=1)
        sigma, flags = np.full(position.shape, 0.05), np.zeros(position.shape, np.int32)
        batch = one.step(1 + frame * 10**7, Measurements.of(position, sigma, flags), None)
        assert (batch.state == TrackState.TENTATIVE).all()
    steps = np.diff(looked)
    pauses = steps[steps > 1].tolist()
    assert looked[:MAX_FRUITLESS_EXPOSURES] == list(range(MAX_FRUITLESS_EXPOSURES))
    assert len(looked) < 100
    assert pauses == sorted(pauses)
    assert pauses[-1] > 2 * pauses[0]
