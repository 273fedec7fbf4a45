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
from compute.tracking.native.kernels import Associator
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
"""Part of the exposures in which a sensor must have detected it, or a peak that may be shared."""
REJECTION_FRACTION_THRESHOLD: Final = 0.45
"""Part below which it is given up."""
MIN_DETECTIONS: Final = 3
"""Exposures in which each sensor that counts must have detected it."""
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
        self._batch = CandidateBatch.empty(len(model), len(associator.motion))
        self._free = np.zeros(len(model), dtype=np.intp)
        self._time_ns = 0

    def __len__(self) -> int:
        """Return the number of candidates."""
        return len(self._batch)

    def forget(self) -> None:
        """Delete all candidates."""
        self._batch = self._batch.part(0, 0)

    def explained_peaks(self) -> NDArray[np.int32]:
        """Return the last exposure's peaks of well supported candidates, shape (N, S)."""
        batch = self._batch
        supported = (batch.age >= REJECTION_AGE) & self._is_detected_steadily()
        peaks: NDArray[np.int32] = batch.peaks[supported, -1]
        return peaks

    def is_new(self, peaks: NDArray[np.int32]) -> bool:
        """Return whether there is room and no candidate has three of these peaks, shape (S,)."""
        same = ((self._batch.peaks[:, -1] == peaks) & (peaks >= 0)).sum(axis=1)
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
        self._batch = CandidateBatch.concatenate([self._batch, added])
        self._time_ns = time_ns

    def follow(self, time_ns: int, peaks: Measurements, free: NDArray[np.bool_]) -> None:
        """Predict and update all tentative tracks; delete those that fail.

        Args:
            time_ns: time of the exposure [ns].
            peaks: measurements of the exposure, up to K peaks of each of S sensors.
            free: peaks that may be used, shape (S, K).
        """
        batch = self._batch
        step = np.full(len(batch), (time_ns - self._time_ns) * 1e-9)
        self._time_ns = time_ns
        if len(batch) == 0:
            return
        states = mix_and_predict(self._associator.motion, batch.states, step)
        free_peaks = peaks.only(free)
        self._free = free.sum(axis=1)
        density = peaks.log_density(
            self._settings.clutter_density_per_px, self._settings.resolution_px
        )
        batch.peaks = np.roll(batch.peaks, -1, axis=1)
        batch.missed = np.roll(batch.missed, -1, axis=1)
        batch.score = np.roll(batch.score, -1, axis=1)
        base = log(self._settings.clutter_density_per_px)
        hidden = predict_merged(batch.neighbours, step, self._settings)
        reading = self._model.predict(mean_positions(states)).reading_px if hidden.any() else None
        for one in range(len(batch)):
            row = np.array([one])
            inflated_peaks = free_peaks
            if reading is not None and hidden[one].any():
                inflated_peaks = inflate_unresolved(
                    free_peaks, reading[row], hidden[row], self._settings
                )
            association = self._associator.associate(
                states.rows(row), batch.bias[row], inflated_peaks
            )
            batch.states.put(row, association.states)
            batch.peaks[one, -1] = association.peaks[0]
            used = association.peaks[0] >= 0
            # Against other markers' peaks, not against false ones.
            batch.score[one, -1] = (
                association.log_likelihood_ratio[0] - (used * (density - base)).sum()
            )
            batch.nis[one] = association.nis[0]
        there = self._model.predict(mean_positions(batch.states))
        shared = peaks.is_near(there.reading_px, self._settings.resolution_px)
        batch.neighbours = update_neighbours(
            batch.neighbours, batch.peaks[:, -1], peaks, peaks.usable, step, self._settings
        )
        used = batch.peaks[:, -1] >= 0
        batch.missed[:, -1] = ~used & ~shared & there.in_view
        batch.score[:, -1] += batch.missed[:, -1].sum(axis=1) * log(
            1.0 - self._settings.detection_probability
        )
        batch.age += 1
        batch.blind = np.where(used.sum(axis=1) >= MIN_PEAKS, 0, batch.blind + 1)
        good = (batch.blind < MAX_BLIND_EXPOSURES) & (
            (batch.age < REJECTION_AGE) | ~self._exceeds_miss_limit(REJECTION_FRACTION_THRESHOLD)
        )
        self._batch = batch.rows(good)
        self._drop_duplicates()

    def decide(self) -> CandidateBatch | None:
        """Confirm and remove the candidates that are markers; None: there are none."""
        batch = self._batch
        score = batch.score.sum(axis=1)
        ready = np.flatnonzero(score > 0.0)
        if len(ready) == 0:
            return None
        sizes, shared = _shared(batch.peaks[ready])
        smaller = np.minimum(sizes[:, None], sizes[None])
        conflict = shared > CONFLICT_SHARE_THRESHOLD * smaller
        np.fill_diagonal(conflict, val=False)
        score = score[ready]
        selected = max_weight_independent_set(score, conflict)
        old = batch.age[ready] >= WINDOW_EXPOSURES
        lasting = (batch.age[ready] >= MIN_AGE) & self._is_detected_steadily()[ready]
        good = (
            selected
            & lasting
            & (score > SCORE_RATIO_THRESHOLD * best_alternatives(score, conflict, selected))
        )
        # Where ghosts last, time tells nothing: how many are there that nothing betrays?
        ghosts = self._expected_ghosts(ready[selected], int((lasting & ~selected).sum()))
        ambiguous = ghosts > MAX_GHOSTS
        if ambiguous:
            good &= old
        # Handed over while it is seen well: what comes next may be merged with others.
        least = np.where(old, MIN_SUPPORT_SENSORS - 1, MIN_SUPPORT_SENSORS)
        good &= (batch.peaks[ready, -1] >= 0).sum(axis=1) >= least
        if not good.any():
            return None
        confirmed = ready[good]
        markers = batch.rows(confirmed)
        markers.ambiguous[:] = ambiguous
        stay = np.ones(len(batch), dtype=np.bool_)
        stay[confirmed] = False
        # What lived on their peaks is a ghost.
        stay[ready[conflict[good].any(axis=0)]] = False
        self._batch = batch.rows(stay)
        return markers

    def _expected_ghosts(self, selected: NDArray[np.intp], explained_peaks: int) -> float:
        """Return how many ghosts are to be expected among the peaks that nothing explains.

        So many of all peaks' last that are known to be ghosts, since markers explain their peaks;
        a ghost that has none of these looks like a marker.

        Args:
            selected: candidates that explain peaks.
            explained_peaks: ghosts that last.
        """
        log_fractions = []
        for sensor, count in enumerate(self._free.tolist()):
            peaks = self._batch.peaks[selected, -1, sensor]
            unexplained = count - len(set(peaks[peaks >= 0].tolist()))
            log_fractions.append(min(max(unexplained + 1.0, 1.0) / max(count, 1.0), 1.0))
        return explained_peaks * float(np.exp(MIN_SUPPORT_SENSORS * np.log(log_fractions).mean()))

    def _is_detected_steadily(self) -> NDArray[np.bool_]:
        """Return which are detected by four sensors or more in most exposures, (T,)."""
        detections, opportunities = self._detection_counts()
        good = (detections >= DETECTION_FRACTION_THRESHOLD * opportunities) & (
            detections >= MIN_DETECTIONS
        )
        steady: NDArray[np.bool_] = good.sum(axis=1) >= MIN_SUPPORT_SENSORS
        return steady & ~self._exceeds_miss_limit(DETECTION_FRACTION_THRESHOLD)

    def _exceeds_miss_limit(self, part: float) -> NDArray[np.bool_]:
        """Return which too many sensors detect in less than this fraction of the exposures."""
        detections, opportunities = self._detection_counts()
        failed: NDArray[np.bool_] = (detections < part * opportunities).sum(
            axis=1
        ) > self._blind_sensors
        return failed

    def _detection_counts(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return each sensor's detections of each candidate, and its opportunities, (T, S)."""
        detections = (self._batch.peaks >= 0).sum(axis=1)
        # Where a peak may be shared, a sensor says nothing.
        return detections, detections + self._batch.missed.sum(axis=1)

    def _drop_duplicates(self) -> None:
        """Keep the most probable of the candidates that have the same peaks."""
        batch = self._batch
        sizes, shared = _shared(batch.peaks[:, -4:])
        same = (shared > DUPLICATE_SHARE_THRESHOLD * np.minimum(sizes[:, None], sizes[None])) & (
            shared > 0
        )
        self._batch = batch.rows(greedy_independent_set(batch.score.sum(axis=1), same))


def _shared(peaks: NDArray[np.int32]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return how many peaks each of C has (C, W, S), and every two in common, shape (C, C)."""
    there = peaks >= 0
    same = (peaks[:, None] == peaks[None]) & there[:, None]
    return there.sum(axis=(1, 2)), same.sum(axis=(2, 3))
