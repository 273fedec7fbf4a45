"""CandidateTracks: tentative tracks of a dense scene, confirmed as a consistent set."""

from dataclasses import dataclass
from math import log
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurements import Measurements
from compute.reconstruction.point_batch import Batch
from compute.tracking.max_weight_independent_set import (
    best_alternatives,
    greedy_independent_set,
    max_weight_independent_set,
)
from compute.tracking.motion_model import ImmStates, mean_positions, mix_and_predict
from compute.tracking.native.associator import Associator
from compute.tracking.tracks import MIN_SUPPORT_SENSORS
from compute.tracking.unresolved_neighbours import (
    NEIGHBOUR_FIELDS,
    inflate_unresolved,
    predict_merged,
    update_neighbours,
)

Array = NDArray[np.float64]

WINDOW_EXPOSURES: Final = 16
"""Exposures that are remembered."""
MIN_AGE: Final = 6
"""Exposures after which a candidate may be a marker."""
REJECTION_AGE: Final = 5
"""Exposures after which a candidate that too few sensors see is given up."""
DETECTION_FRACTION_THRESHOLD: Final = 0.65
"""Part of the exposures in which a sensor must have seen it, or a peak that may be shared."""
REJECTION_FRACTION_THRESHOLD: Final = 0.45
"""Part below which it is given up."""
MIN_SEEN: Final = 3
"""Exposures in which it must have been seen by each of the sensors that count."""
MIN_PEAKS: Final = 2
"""Peaks of its own that it must have in an exposure; without them it is given up."""
MAX_BLIND_EXPOSURES: Final = 3
"""Exposures without them, in a row."""
CONFLICT_SHARE_THRESHOLD: Final = 0.2
"""Part of its peaks beyond which a candidate is in conflict with another one that has them too."""
DUPLICATE_SHARE_THRESHOLD: Final = 0.6
"""Part beyond which it is the same one."""
SCORE_RATIO_THRESHOLD: Final = 1.5
"""Ratio of a candidate's score to a rival's from which the candidate is unambiguous."""
MAX_GHOSTS: Final = 0.1
"""Expected number of ghosts beyond which confirmed candidates are ambiguous."""
MAX_CANDIDATES: Final = 80
"""Candidates that are followed."""


@dataclass(eq=False)
class CandidateBatch(Batch):
    """T candidates.

    Args:
        states: at the last exposure.
        bias: as of tracks, shape (T, S, S).
        position_mm: position at which that was evaluated, shape (T, 3).
        peaks: of the last exposures, the newest last; -1: none, shape (T, W, S).
        missed: whether a sensor had no peak there, not even one that may be shared, (T, W, S).
        score: log likelihood ratio to no one's peaks, of each exposure, shape (T, W).
        age: exposures, shape (T,).
        blind: exposures in a row without peaks enough, shape (T,).
        nis: of the last exposure, shape (T,).
        neighbours: other peaks beside its own, see ``unresolved_neighbours``, (T, S, 3).
        ambiguous: whether one that was confirmed may be a ghost, shape (T,).
    """

    states: ImmStates
    bias: Annotated[Array, "S", "S"]
    position_mm: Annotated[Array, 3]
    peaks: Annotated[NDArray[np.int32], WINDOW_EXPOSURES, "S"]
    missed: Annotated[NDArray[np.bool_], WINDOW_EXPOSURES, "S"]
    score: Annotated[Array, WINDOW_EXPOSURES]
    age: NDArray[np.intp]
    blind: NDArray[np.intp]
    nis: Array
    neighbours: Annotated[Array, "S", NEIGHBOUR_FIELDS]
    ambiguous: NDArray[np.bool_]


class CandidateTracks:
    """Filters candidate tracks independently of each other, and confirms a consistent set.

    Ghosts have peaks of markers. Tracked together with markers they would take them; tracked alone,
    several candidates may share a peak, and over some exposures one set of them explains all: a
    ghost loses a sensor when its markers move apart, and what it explains, its markers do as well,
    each with more besides.

    Args:
        associator: of peaks with tracks.
    """

    def __init__(self, associator: Associator) -> None:
        self._associator = associator
        self._model, self._settings = associator.model, associator.settings
        model = associator.model
        self._blind_sensors = max(len(model) - MIN_SUPPORT_SENSORS, 0) // 2
        self._kept = CandidateBatch.empty(len(model), len(associator.motion))
        self._free = np.zeros(len(model), dtype=np.intp)
        self._time_ns = 0

    def __len__(self) -> int:
        """Return the number of candidates."""
        return len(self._kept)

    def forget(self) -> None:
        """Delete all candidates."""
        self._kept = self._kept.part(0, 0)

    def explained_peaks(self) -> NDArray[np.int32]:
        """Return the last exposure's peaks of well supported candidates, shape (N, S)."""
        kept = self._kept
        well_seen = (kept.age >= REJECTION_AGE) & self._is_detected_steadily()
        peaks: NDArray[np.int32] = kept.peaks[well_seen, -1]
        return peaks

    def is_new(self, peaks: NDArray[np.int32]) -> bool:
        """Return whether there is room and no candidate has three of these peaks, shape (S,)."""
        same = ((self._kept.peaks[:, -1] == peaks) & (peaks >= 0)).sum(axis=1)
        return len(self) < MAX_CANDIDATES and int(same.max(initial=0)) < 3

    def begin(
        self,
        states: ImmStates,
        bias: Array,
        position_mm: Array,
        peaks: NDArray[np.int32],
        time_ns: int,
    ) -> None:
        """Begin N tentative tracks.

        Args:
            states: their states, N of them.
            bias: covariance of the readings' constant errors, shape (N, S, S) [px^2].
            position_mm: where that was evaluated, shape (N, 3) [mm].
            peaks: index of each sensor's peak, -1: none, shape (N, S).
            time_ns: time of the exposure [ns].
        """
        added = CandidateBatch.zeros(len(states), len(self._model))
        added.states, added.bias, added.position_mm = states, bias, position_mm
        added.peaks[:] = -1
        added.peaks[:, -1] = peaks
        self._kept = CandidateBatch.concatenate([self._kept, added])
        self._time_ns = time_ns

    def follow(self, time_ns: int, peaks: Measurements, free: NDArray[np.bool_]) -> None:
        """Predict and update all tentative tracks; delete those that fail.

        Args:
            time_ns: time of the exposure [ns].
            peaks: measurements of the exposure, up to K peaks of each of S sensors.
            free: peaks that may be used, shape (S, K).
        """
        kept = self._kept
        step = np.full(len(kept), (time_ns - self._time_ns) * 1e-9)
        self._time_ns = time_ns
        if len(kept) == 0:
            return
        states = mix_and_predict(self._associator.motion, kept.states, step)
        left = peaks.only(free)
        self._free = free.sum(axis=1)
        density = peaks.log_density(
            self._settings.clutter_density_per_px, self._settings.resolution_px
        )
        kept.peaks = np.roll(kept.peaks, -1, axis=1)
        kept.missed = np.roll(kept.missed, -1, axis=1)
        kept.score = np.roll(kept.score, -1, axis=1)
        base = log(self._settings.clutter_density_per_px)
        hidden = predict_merged(kept.neighbours, step, self._settings)
        reading = self._model.predict(mean_positions(states)).reading_px if hidden.any() else None
        for one in range(len(kept)):
            row = np.array([one])
            own = left
            if reading is not None and hidden[one].any():
                own = inflate_unresolved(left, reading[row], hidden[row], self._settings)
            found = self._associator.associate(states.rows(row), kept.bias[row], own)
            kept.states.put(row, found.states)
            kept.peaks[one, -1] = found.peaks[0]
            used = found.peaks[0] >= 0
            # Against other markers' peaks, not against false ones.
            kept.score[one, -1] = found.log_likelihood_ratio[0] - (used * (density - base)).sum()
            kept.nis[one] = found.nis[0]
        there = self._model.predict(mean_positions(kept.states))
        shared = peaks.is_near(there.reading_px, self._settings.resolution_px)
        kept.neighbours = update_neighbours(
            kept.neighbours, kept.peaks[:, -1], peaks, peaks.usable, step, self._settings
        )
        used = kept.peaks[:, -1] >= 0
        kept.missed[:, -1] = ~used & ~shared & there.in_view
        kept.score[:, -1] += kept.missed[:, -1].sum(axis=1) * log(
            1.0 - self._settings.detection_probability
        )
        kept.age += 1
        kept.blind = np.where(used.sum(axis=1) >= MIN_PEAKS, 0, kept.blind + 1)
        good = (kept.blind < MAX_BLIND_EXPOSURES) & (
            (kept.age < REJECTION_AGE) | ~self._exceeds_miss_limit(REJECTION_FRACTION_THRESHOLD)
        )
        self._kept = kept.rows(good)
        self._drop_duplicates()

    def decide(self) -> CandidateBatch | None:
        """Confirm and remove the candidates that are markers; None: there are none."""
        kept = self._kept
        score = kept.score.sum(axis=1)
        ready = np.flatnonzero(score > 0.0)
        if len(ready) == 0:
            return None
        sizes, shared = _shared(kept.peaks[ready])
        smaller = np.minimum(sizes[:, None], sizes[None])
        conflict = shared > CONFLICT_SHARE_THRESHOLD * smaller
        np.fill_diagonal(conflict, val=False)
        score = score[ready]
        taken = max_weight_independent_set(score, conflict)
        old = kept.age[ready] >= WINDOW_EXPOSURES
        lasting = (kept.age[ready] >= MIN_AGE) & self._is_detected_steadily()[ready]
        good = (
            taken
            & lasting
            & (score > SCORE_RATIO_THRESHOLD * best_alternatives(score, conflict, taken))
        )
        # Where ghosts last, time tells nothing: how many are there that nothing betrays?
        ghosts = self._expected_ghosts(ready[taken], int((lasting & ~taken).sum()))
        ambiguous = ghosts > MAX_GHOSTS
        if ambiguous:
            good &= old
        # Handed over while it is seen well: what comes next may be merged with others.
        least = np.where(old, MIN_SUPPORT_SENSORS - 1, MIN_SUPPORT_SENSORS)
        good &= (kept.peaks[ready, -1] >= 0).sum(axis=1) >= least
        if not good.any():
            return None
        found = ready[good]
        markers = kept.rows(found)
        markers.ambiguous[:] = ambiguous
        stay = np.ones(len(kept), dtype=np.bool_)
        stay[found] = False
        # What lived on their peaks is a ghost.
        stay[ready[conflict[good].any(axis=0)]] = False
        self._kept = kept.rows(stay)
        return markers

    def _expected_ghosts(self, taken: NDArray[np.intp], explained_peaks: int) -> float:
        """Return how many ghosts are to be expected among the peaks that nothing explains.

        So many of all peaks' last that are known to be ghosts, since markers explain their peaks;
        a ghost that has none of these looks like a marker.

        Args:
            taken: candidates that explain peaks.
            explained_peaks: ghosts that last.
        """
        left = []
        for sensor, count in enumerate(self._free.tolist()):
            own = self._kept.peaks[taken, -1, sensor]
            unexplained = count - len(set(own[own >= 0].tolist()))
            left.append(min(max(unexplained + 1.0, 1.0) / max(count, 1.0), 1.0))
        return explained_peaks * float(np.exp(MIN_SUPPORT_SENSORS * np.log(left).mean()))

    def _is_detected_steadily(self) -> NDArray[np.bool_]:
        """Return which four sensors or more have mostly seen, and few have mostly not, (T,)."""
        seen, asked = self._detection_counts()
        good = (seen >= DETECTION_FRACTION_THRESHOLD * asked) & (seen >= MIN_SEEN)
        steady: NDArray[np.bool_] = good.sum(axis=1) >= MIN_SUPPORT_SENSORS
        return steady & ~self._exceeds_miss_limit(DETECTION_FRACTION_THRESHOLD)

    def _exceeds_miss_limit(self, part: float) -> NDArray[np.bool_]:
        """Return which too many sensors have seen in less than such a part of the exposures."""
        seen, asked = self._detection_counts()
        failed: NDArray[np.bool_] = (seen < part * asked).sum(axis=1) > self._blind_sensors
        return failed

    def _detection_counts(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return how often each sensor saw each, and how often it could have, (T, S)."""
        seen = (self._kept.peaks >= 0).sum(axis=1)
        # Where a peak may be shared, a sensor says nothing.
        return seen, seen + self._kept.missed.sum(axis=1)

    def _drop_duplicates(self) -> None:
        """Of candidates that have come to have the same peaks, keep the most probable."""
        kept = self._kept
        sizes, shared = _shared(kept.peaks[:, -4:])
        same = (shared > DUPLICATE_SHARE_THRESHOLD * np.minimum(sizes[:, None], sizes[None])) & (
            shared > 0
        )
        self._kept = kept.rows(greedy_independent_set(kept.score.sum(axis=1), same))


def _shared(peaks: NDArray[np.int32]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return how many peaks each of C has (C, W, S), and every two in common, shape (C, C)."""
    there = peaks >= 0
    same = (peaks[:, None] == peaks[None]) & there[:, None]
    return there.sum(axis=(1, 2)), same.sum(axis=(2, 3))
