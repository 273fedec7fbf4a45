"""Tracks named by their blinking codes, through crossings, lost exposures and exchanges."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.measurement.measurements import Measurements
from compute.tracking.blink_codes import BlinkCodes, blink_codes
from compute.tracking.blink_decoding import BlinkModel
from compute.tracking.blink_identification import BlinkIdentifier
from compute.tracking.settings import TrackerSettings
from compute.tracking.track_batch import TrackBatch, TrackFlag, TrackState
from compute.tracking.tracker import Tracker
from tests.compute.tracking.moving_markers import MIDDLE_MM, PIXELS, Sensing, peaks_of, ring

Array = NDArray[np.float64]

SENSORS = 4
CODES = blink_codes(4, 12, 3)
LOW = 0.4


def light(marker: NDArray[np.intp], sequence: int, phase: NDArray[np.intp]) -> Array:
    """Relative light of markers in an exposure."""
    return np.where(CODES.bits[marker, (sequence + phase[marker]) % CODES.length], 1.0, LOW)


def tracks(count: int, *, flags: int = 0) -> TrackBatch:
    """Tracks 1, 2, ... that each see the peak of their row on every sensor."""
    empty = TrackBatch.empty(SENSORS)
    return replace(
        empty,
        identity=np.arange(1, count + 1),
        marker=np.full(count, -1, np.int32),
        state=np.full(count, TrackState.CONFIRMED, np.int8),
        flags=np.full(count, flags, np.int32),
        position_mm=np.zeros((count, 3)),
        peaks=np.repeat(np.arange(count, dtype=np.int32)[:, None], SENSORS, axis=1),
    )


def amplitudes(markers: list[int], sequence: int, rng: np.random.Generator) -> Array:
    """What each sensor sees of markers in that order, all of other brightness, (S, M)."""
    marker = np.array(markers)
    shown = light(marker, sequence, np.arange(len(CODES)) * 5) * (1.0 + marker) * 100.0
    return shown * np.exp(0.1 * rng.standard_normal((SENSORS, len(marker))))


def named(
    naming: BlinkIdentifier,
    first: int,
    last: int,
    markers: list[int],
    seed: int = 1,
    flags: int = 0,
) -> list[int]:
    """Names after exposures ``first`` to ``last - 1``."""
    rng = np.random.default_rng([seed, first])
    batch = tracks(len(markers), flags=flags)
    found = batch
    for sequence in range(first, last):
        found = naming.name(sequence, batch, amplitudes(markers, sequence, rng))
    return found.marker.tolist()


def test_names_come_within_two_words_and_stay() -> None:
    naming = BlinkIdentifier(CODES, BlinkModel(off_level=LOW))
    assert named(naming, 0, 6, [2, 0, 1]) == [-1, -1, -1]
    assert named(naming, 6, 24, [2, 0, 1]) == [2, 0, 1]
    assert named(naming, 24, 60, [2, 0, 1]) == [2, 0, 1]


def test_names_come_whichever_exposures_are_looked_at() -> None:
    """A computer that is too slow looks at some only, as it may be never at a round number."""
    naming = BlinkIdentifier(CODES, BlinkModel(off_level=LOW))
    rng = np.random.default_rng(5)
    batch = tracks(3)
    found = batch
    for sequence in range(120):
        if sequence % 6 in (1, 2, 4, 5):  # as a judgement at every sixth would not see
            found = naming.name(sequence, batch, amplitudes([2, 0, 1], sequence, rng))
    assert found.marker.tolist() == [2, 0, 1]


def test_an_exchange_that_the_tracker_did_not_see_is_named_anew() -> None:
    naming = BlinkIdentifier(CODES, BlinkModel(off_level=LOW))
    assert named(naming, 0, 30, [0, 1]) == [0, 1]
    assert named(naming, 30, 30 + 2 * CODES.length + 6, [1, 0]) == [1, 0]


def test_an_ambiguous_track_loses_its_name_until_it_has_shown_it_again() -> None:
    naming = BlinkIdentifier(CODES, BlinkModel(off_level=LOW))
    assert named(naming, 0, 31, [0, 1]) == [0, 1]
    assert named(naming, 31, 32, [1, 0], flags=TrackFlag.AMBIGUOUS) == [-1, -1]
    # The flag stays with the tracks; the names are of what was shown since.
    assert named(naming, 32, 32 + CODES.length + 6, [1, 0], flags=TrackFlag.AMBIGUOUS) == [1, 0]


@pytest.mark.parametrize("lost", [1, 7, 40, 1000])
def test_lost_exposures_say_nothing(lost: int) -> None:
    """Taken for successive ones they would be bits of another phase, or another word."""
    naming = BlinkIdentifier(CODES, BlinkModel(off_level=LOW))
    assert named(naming, 0, 30, [3, 0]) == [3, 0]
    for gap in range(6):
        first = 30 + gap * (lost + 3) + lost
        assert named(naming, first, first + 3, [3, 0]) == [3, 0]


def test_a_clock_that_went_back_begins_anew() -> None:
    naming = BlinkIdentifier(CODES, BlinkModel(off_level=LOW))
    assert named(naming, 100, 130, [0, 1]) == [0, 1]
    assert named(naming, 0, 5, [1, 0]) == [-1, -1]
    assert named(naming, 5, 30, [1, 0]) == [1, 0]


def test_lost_exposures_take_the_evidence_with_them() -> None:
    """A track that may be exchanged at any time is named by its last two words, no more."""
    naming = BlinkIdentifier(CODES, BlinkModel(off_level=LOW))
    doubtful = int(TrackFlag.AMBIGUOUS)
    assert named(naming, 0, 30, [3, 0], flags=doubtful) == [3, 0]
    assert named(naming, 120, 127, [3, 0], flags=doubtful) == [-1, -1]
    assert named(naming, 127, 140, [3, 0], flags=doubtful) == [3, 0]


@pytest.mark.parametrize("shared", [True, False])
def test_shared_peaks_and_strobed_exposures_say_nothing(shared: bool) -> None:
    """Every fourth exposure has another light: that of both markers, or of a strobe."""
    naming = BlinkIdentifier(CODES, BlinkModel(off_level=LOW))
    rng = np.random.default_rng(3)
    batch = tracks(2)
    together = replace(batch, peaks=np.zeros_like(batch.peaks))
    found = batch
    for sequence in range(40):
        bright = amplitudes([0, 1], sequence, rng)
        if sequence % 4 != 3:
            found = naming.name(sequence, batch, bright)
        elif shared:
            found = naming.name(sequence, together, np.full((SENSORS, 2), 5e4))
        else:
            found = naming.name(sequence, batch, np.full((SENSORS, 2), 5e4), lit=False)
    assert found.marker.tolist() == [0, 1]


def test_what_a_strobe_told_stays() -> None:
    naming = BlinkIdentifier(CODES, BlinkModel(off_level=LOW))
    rng = np.random.default_rng(4)
    strobed = replace(tracks(2), marker=np.array([7, -1], np.int32))
    found = strobed
    for sequence in range(30):
        found = naming.name(sequence, strobed, amplitudes([0, 1], sequence, rng))
    assert found.marker.tolist() == [7, 1]


def test_no_name_is_given_twice() -> None:
    naming = BlinkIdentifier(CODES, BlinkModel(off_level=LOW))
    assert named(naming, 0, 30, [1, 0]) == [1, 0]
    # Track 2 now shows what track 1 shows: a reflection, which has its light and its code.
    names = named(naming, 30, 70, [1, 1])
    assert names.count(1) <= 1


@pytest.mark.parametrize("seed", [11, 12])
def test_markers_that_cross_are_named_as_they_are(seed: int) -> None:
    """Through the tracker: two pairs pass each other within millimetres; no wrong name, ever."""
    rng = np.random.default_rng(seed)
    rate, count = 200.0, len(CODES)
    cameras = CameraStack.of(ring(SENSORS))
    tracker = Tracker(
        cameras, TrackerSettings(clutter_density_per_px=1e-4), pixels=(PIXELS,) * SENSORS
    )
    naming = BlinkIdentifier(CODES, BlinkModel(off_level=LOW))
    phase = rng.integers(0, CODES.length, count)
    towards = rng.standard_normal((2, 3))
    towards *= 150.0 / np.linalg.norm(towards, axis=1, keepdims=True)
    meeting = MIDDLE_MM + np.array([[-90.0, 0.0, 0.0], [90.0, 0.0, 0.0]])
    right = total = 0
    for sequence in range(240):
        at = (sequence - 110) / rate
        places = np.concatenate([meeting + at * towards, meeting + 1.5 - at * towards])
        position, sigma, flags, who = peaks_of(
            cameras, places, Sensing(missed=0.03, false_peaks=0.1, resolution_px=4.0), rng
        )
        bright = light(np.maximum(who, 0), sequence, phase) * 1000.0 * (1.0 + who)
        stray = np.exp(rng.uniform(4.0, 8.0, who.shape))
        bright = np.where(who >= 0, bright * np.exp(0.1 * rng.standard_normal(who.shape)), stray)
        batch = tracker.step(
            round(1e9 * (1.0 + sequence / rate)), Measurements.of(position, sigma, flags), None
        )
        batch = naming.name(sequence, batch, bright)
        for place, marker in zip(batch.position_mm, batch.marker, strict=True):
            if marker >= 0:
                # Within what the two of a pair are apart, there is no telling which is which.
                assert np.linalg.norm(place - places[marker]) < 12.0
        if sequence >= 200:
            total += count
            right += int((batch.marker >= 0).sum())
    assert right >= 0.9 * total


def test_what_cannot_be_named_is_refused() -> None:
    with pytest.raises(InvalidParameter, match="cyclic"):
        BlinkIdentifier(BlinkCodes(("0011", "1100"), 4, cyclic=False))
    with pytest.raises(InvalidParameter, match=r"\(3, 2\)"):
        BlinkIdentifier(CODES).name(1, tracks(2), np.ones((3, 2)))
