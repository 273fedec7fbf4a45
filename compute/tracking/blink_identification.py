"""BlinkIdentifier: identities of tracks from the codes that their markers blink."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.tracking.blink_codes import BlinkCodes
from compute.tracking.blink_decoding import BlinkModel, identify_blinking_markers
from compute.tracking.track_batch import TrackBatch, TrackFlag, TrackState

Array = NDArray[np.float64]

WINDOW_WORDS: Final = 2
"""Words in the window: with missed peaks, one word is often not enough."""
EVALUATIONS_PER_WORD: Final = 2
"""Evaluations per word: names come half a word late at most."""


class BlinkIdentifier:
    """Names tracks by their markers' codes; a pure function of the exposures it was given.

    Every track's amplitudes over the last two words are judged together, so that no code is given
    twice. A name stays with its track until another is as sure, or until the track may
    have been exchanged with another (AMBIGUOUS): then it is named anew. Exposures that are lost
    and peaks that two tracks share say nothing.

    Args:
        codes: the markers' words.
        model: how their peaks come about; None: the standard.

    Raises:
        InvalidParameter: words that are not cyclic: when a word begins is not known here.
    """

    def __init__(self, codes: BlinkCodes, model: BlinkModel | None = None) -> None:
        if not codes.cyclic:
            raise InvalidParameter(
                "these words are distinct only where it is known when they begin; tracks need "
                "cyclic ones"
            )
        self.codes = codes
        self._model = model or BlinkModel()
        self._scans = WINDOW_WORDS * codes.length
        self._every = max(1, codes.length // EVALUATIONS_PER_WORD)
        self.reset()

    def reset(self) -> None:
        """Delete the window and all names, as after the tracker's own reset."""
        self._identity: NDArray[np.int64] = np.empty(0, np.int64)
        """Identities of the T tracks in the window, ascending."""
        self._amplitude: Array | None = None
        """By track, sensor and exposure (its number modulo W), NaN: no peak, shape (T, S, W)."""
        self._known: NDArray[np.bool_] | None = None
        """Where presence or absence of a peak is known, shape (T, S, W)."""
        self._name: dict[int, int] = {}
        self._ambiguous: set[int] = set()
        """Tracks that were AMBIGUOUS at the last exposure."""
        self._last: int | None = None
        self._last_evaluation: int | None = None

    def name(
        self, sequence: int, batch: TrackBatch, amplitude: NDArray[np.floating], *, lit: bool = True
    ) -> TrackBatch:
        """Return the tracks with their markers' numbers, where they are sure.

        Args:
            sequence: number of the exposure; one that is not after the last one's begins anew.
            batch: T tracks of S sensors after it; markers that are known stay.
            amplitude: of its peaks, as ``batch.peaks`` counts them, shape (S, K), any unit.
            lit: whether the markers showed their codes; False: one was strobed.

        Raises:
            InvalidParameter: amplitudes of another number of sensors.
        """
        sensors = batch.peaks.shape[1]
        if np.ndim(amplitude) != 2 or len(amplitude) != sensors:
            raise InvalidParameter(
                f"amplitude has the shape {np.shape(amplitude)}; it must be ({sensors}, K)"
            )
        if self._last is not None and sequence <= self._last:
            self.reset()
        slot = sequence % self._scans
        amplitudes, known = self._history_of(sequence, batch)
        self._last = sequence
        if lit and len(batch):
            self._record(slot, batch, np.asarray(amplitude, dtype=np.float64), amplitudes, known)
        ambiguous = set(batch.identity[(batch.flags & TrackFlag.AMBIGUOUS) != 0].tolist())
        for identity in ambiguous - self._ambiguous:
            # Its earlier amplitudes may have been another marker's.
            known[self._identity == identity] = False
            self._name.pop(identity, None)
        self._ambiguous = ambiguous
        # Once in ``_every`` exposures.
        if lit and sequence // self._every != self._last_evaluation:
            self._last_evaluation = sequence // self._every
            self._evaluate(amplitudes, known)
        if not self._name:
            return batch
        named = [self._name.get(identity, -1) for identity in batch.identity.tolist()]
        marker = np.where(batch.marker >= 0, batch.marker, np.array(named, dtype=np.int32))
        return replace(batch, marker=marker.astype(np.int32))

    def _history_of(self, sequence: int, batch: TrackBatch) -> tuple[Array, NDArray[np.bool_]]:
        """Return the amplitudes of the batch's tracks; drop other tracks and lost exposures."""
        amplitude, known = self._amplitude, self._known
        if amplitude is None or known is None or not np.array_equal(batch.identity, self._identity):
            shape = (len(batch), batch.peaks.shape[1], self._scans)
            new_amplitude, new_known = np.full(shape, np.nan), np.zeros(shape, dtype=np.bool_)
            if amplitude is not None and known is not None:
                _, now, before = np.intersect1d(batch.identity, self._identity, return_indices=True)
                new_amplitude[now], new_known[now] = amplitude[before], known[before]
            amplitude, known = new_amplitude, new_known
            self._amplitude, self._known = amplitude, known
            self._identity = batch.identity.copy()
            alive = set(batch.identity.tolist())
            self._name = {one: name for one, name in self._name.items() if one in alive}
        lost = 1 if self._last is None else min(sequence - self._last, self._scans)
        slots = np.arange(sequence - lost + 1, sequence + 1) % self._scans
        known[..., slots] = False
        amplitude[..., slots] = np.nan
        return amplitude, known

    def _record(
        self,
        slot: int,
        batch: TrackBatch,
        amplitude: Array,
        amplitudes: Array,
        known: NDArray[np.bool_],
    ) -> None:
        """Record the amplitude of each track in this exposure."""
        peaks = batch.peaks
        detected = peaks >= 0
        # A shared peak's amplitude is that of both.
        shared = (peaks[:, None] == peaks[None]).sum(axis=1) > 1
        alone = detected & ~shared
        peak_amplitude = amplitude[np.arange(peaks.shape[1]), np.maximum(peaks, 0)]
        good = alone & (peak_amplitude > 0.0)
        confirmed = (batch.state != TrackState.TENTATIVE)[:, None]
        amplitudes[..., slot] = np.where(good, peak_amplitude, np.nan)
        known[..., slot] = (good | ~detected) & confirmed

    def _evaluate(self, amplitudes: Array, known: NDArray[np.bool_]) -> None:
        """Name the tracks with a history of at least one word."""
        rows = np.flatnonzero(known.any(axis=1).sum(axis=1) >= self.codes.length)
        if not len(rows):
            self._rename([], np.empty(0, np.int32))
            return
        # The ring holds whole words, so that it may be read from its first slot: only the phase,
        # which nobody asks for, depends on where it is begun.
        identified = identify_blinking_markers(
            self.codes, amplitudes[rows], self._model, known=known[rows]
        )
        self._rename(self._identity[rows].tolist(), identified.marker)

    def _rename(self, candidates: Sequence[int], marker: NDArray[np.int32]) -> None:
        """Assign the names that are certain now; tracks that had one of them before lose it."""
        sure = {
            name: one for one, name in zip(candidates, marker.tolist(), strict=True) if name >= 0
        }
        for identity, name in list(self._name.items()):
            # A track that may be exchanged at any time is named by what it showed last, only.
            unsure = identity in self._ambiguous and sure.get(name) != identity
            if unsure or sure.get(name, identity) != identity:
                del self._name[identity]
        for name, identity in sure.items():
            self._name[identity] = name
