"""MultiScanInitiator: track initiation over several exposures of a dense scene."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurements import Measurements
from compute.tracking.candidate_tracks import CandidateBatch, CandidateTracks
from compute.tracking.native.kernels import Associator
from compute.tracking.state_initialisation import filter_sequence
from compute.tracking.unassociated_points import UnassociatedPointFinder
from compute.tracking.viterbi_linking import ViterbiLinker

DENSE_COMBINATIONS_THRESHOLD: Final = 700.0
"""Combinations of one peak of each of four sensors: more than five markers make. Fewer are grouped
exposure by exposure."""
MAX_FRUITLESS_EXPOSURES: Final = 12
"""Exposures that are searched one after the other though nothing comes of it."""
MAX_PAUSE_DOUBLINGS: Final = 3
"""Most doublings of the pause after them; it begins with ``initiation_interval_s``."""


class MultiScanInitiator:
    """Initiates tracks over successive exposures; pauses longer where it finds none.

    Args:
        finder: of points.
        associator: of peaks with tracks.
    """

    def __init__(self, finder: UnassociatedPointFinder, associator: Associator) -> None:
        self._associator = associator
        self._sequences = ViterbiLinker(associator.settings, finder)
        self._candidates = CandidateTracks(associator)
        self._fruitless = self._pauses = 0
        self._resume_ns: int | None = None

    def forget(self) -> None:
        """Delete candidates and sequences."""
        self._sequences.forget()
        self._candidates.forget()
        self._fruitless = self._pauses = 0
        self._resume_ns = None

    def is_dense(self, free: NDArray[np.bool_], *, ghost_suspected: bool) -> bool:
        """Return whether a single exposure cannot resolve the markers of these peaks.

        Args:
            free: peaks that no track explains, shape (S, K).
            ghost_suspected: whether some are those of a track that may be a ghost.
        """
        counts = np.sort(free.sum(axis=1))[-4:]
        if len(counts) < 4 or counts[0] == 0:
            return False
        return (
            ghost_suspected
            or len(self._candidates) > 0
            or float(np.prod(counts, dtype=float)) > DENSE_COMBINATIONS_THRESHOLD
        )

    def search(
        self, time_ns: int, peaks: Measurements, free: NDArray[np.bool_]
    ) -> CandidateBatch | None:
        """Return the markers confirmed by this exposure; None: none, or the search pauses.

        Args:
            time_ns: of the exposure.
            peaks: of the exposure.
            free: those that no track explains, shape (S, K).
        """
        if self._resume_ns is not None:
            if time_ns < self._resume_ns:
                return None
            self._resume_ns = None
        self._candidates.follow(time_ns, peaks, free)
        free_peaks = free.copy()
        explained_peaks = self._candidates.explained_peaks()
        row, sensor = np.nonzero(explained_peaks >= 0)
        free_peaks[sensor, explained_peaks[row, sensor]] = False
        for one in self._sequences.find(time_ns, peaks, free_peaks):
            last = one.points.part(-1, len(one.points))
            if self._candidates.is_new(last.choice[0]):
                begun = filter_sequence(
                    self._associator.model, self._associator.motion, self._associator.settings, one
                )
                if begun is not None:
                    peaks_of_last = last.choice.astype(np.int32)
                    self._candidates.begin(*begun, last.position_mm, peaks_of_last, time_ns)
        confirmed = self._candidates.decide()
        if confirmed is not None:
            self._fruitless = self._pauses = 0
        elif len(self._candidates) == 0:
            self._fruitless += 1
            if self._fruitless >= MAX_FRUITLESS_EXPOSURES:
                self._pause(time_ns)
        return confirmed

    def _pause(self, time_ns: int) -> None:
        pause_s = self._associator.settings.initiation_interval_s * 2.0**self._pauses
        self._resume_ns = time_ns + round(pause_s * 1e9)
        self._pauses = min(self._pauses + 1, MAX_PAUSE_DOUBLINGS)
        self._fruitless = 0
        self._sequences.forget()
