"""Crowd: the search for markers where one exposure does not tell which peaks are whose."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.tracking.frame_peaks import FramePeaks
from compute.tracking.left_over import PointFinder
from compute.tracking.motion_model import MotionModels
from compute.tracking.native.associator import Associator
from compute.tracking.new_states import replayed
from compute.tracking.reading_model import ReadingModel
from compute.tracking.sequences import Sequences
from compute.tracking.settings import TrackerSettings
from compute.tracking.tracklets import FoundMarkers, Tracklets

MANY: Final = 700.0
"""Combinations of one peak of each of four sensors: more than five markers make. Fewer are grouped
exposure by exposure."""
LONGEST: Final = 12
"""Exposures that are searched one after the other though nothing comes of it."""
MOST_PAUSES: Final = 3
"""How often the pause after them doubles; it begins with ``start_every_s``."""


class Crowd:
    """Searches in exposures that follow one another; in few of them where there is nothing to find.

    Args:
        model: of the readings.
        motion: M models.
        settings: of the tracker.
        finder: of points.
        associator: of peaks with tracks.
    """

    def __init__(
        self,
        model: ReadingModel,
        motion: MotionModels,
        settings: TrackerSettings,
        finder: PointFinder,
        associator: Associator,
    ) -> None:
        self._model, self._motion, self._settings = model, motion, settings
        self._sequences = Sequences(settings, finder)
        self._tracklets = Tracklets(model, motion, settings, associator)
        self._vain = self._pauses = 0
        self._resume_ns: int | None = None

    def forget(self) -> None:
        """Forget what was found so far."""
        self._sequences.forget()
        self._tracklets.forget()
        self._vain = self._pauses = 0
        self._resume_ns = None

    def needed(self, free: NDArray[np.bool_], *, doubt: bool) -> bool:
        """Return whether one exposure does not tell the markers of these peaks.

        Args:
            free: peaks that no track explains, shape (S, K).
            doubt: whether some are those of a track that may be a ghost.
        """
        counts = np.sort(free.sum(axis=1))[-4:]
        if len(counts) < 4 or counts[0] == 0:
            return False
        return doubt or len(self._tracklets) > 0 or float(np.prod(counts, dtype=float)) > MANY

    def search(
        self, time_ns: int, peaks: FramePeaks, free: NDArray[np.bool_]
    ) -> FoundMarkers | None:
        """Return the markers found with this exposure; None: there are none, or it is a pause.

        Args:
            time_ns: of the exposure.
            peaks: of the exposure.
            free: those that no track explains, shape (S, K).
        """
        if self._resume_ns is not None:
            if time_ns < self._resume_ns:
                return None
            self._resume_ns = None
        self._tracklets.follow(time_ns, peaks, free)
        left = free.copy()
        explained = self._tracklets.explained()
        row, sensor = np.nonzero(explained >= 0)
        left[sensor, explained[row, sensor]] = False
        for one in self._sequences.find(time_ns, peaks, left):
            if self._tracklets.fresh(one.peaks[-1]):
                begun = replayed(self._model, self._motion, self._settings, one)
                if begun is not None:
                    self._tracklets.begin(*begun, one.place_mm[-1:], one.peaks[-1:], time_ns)
        found = self._tracklets.decide()
        if found is not None:
            self._vain = self._pauses = 0
        elif len(self._tracklets) == 0:
            self._vain += 1
            if self._vain >= LONGEST:
                self._pause(time_ns)
        return found

    def _pause(self, time_ns: int) -> None:
        pause_s = self._settings.start_every_s * 2.0**self._pauses
        self._resume_ns = time_ns + round(pause_s * 1e9)
        self._pauses = min(self._pauses + 1, MOST_PAUSES)
        self._vain = 0
        self._sequences.forget()
