"""CandidateSet: the candidates of an exposure and the groups that are chosen from them."""

from dataclasses import dataclass
from functools import lru_cache
from math import inf
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements
from compute.reconstruction.correspondence.ambiguity import ErrorEstimate
from compute.reconstruction.correspondence.candidates import (
    Candidates,
    Choice,
    MatchSettings,
    MisfitDensity,
    Solve,
    UnexplainedPeaks,
    solve_combinations,
)
from compute.reconstruction.correspondence.incremental import complete_triples
from compute.reconstruction.correspondence.intersections import covering_triples
from compute.reconstruction.correspondence.predicted_candidates import (
    PredictedPoints,
    predicted_candidates,
)
from compute.reconstruction.correspondence.set_packing import solve_set_packing
from compute.reconstruction.point_batch import PointBatch

Array = NDArray[np.float64]

MAX_EXHAUSTIVE_COMBINATIONS: Final = 300
"""Combinations, missing peaks included, that are tried all at once rather than step by step."""
MAX_UNPREDICTED_COMBINATIONS: Final = 20_000
"""Combinations that are tried where nothing predicts readings: 11 markers on four sensors."""
_ACCEPTED_ERROR_SHARE: Final = 0.5
"""Share of the wrong rate below which a group is taken for good, before all is looked at."""


@dataclass(frozen=True)
class Group:
    """A marker's peaks: their indices by sensor, -1: none; see ``Correspondence``."""

    choice: tuple[int, ...]
    ambiguous: bool
    predicted: int = -1


class CandidateSet:
    """Candidates of an exposure, and the groups chosen from them.

    Args:
        solve: reconstructs.
        peaks: of the frame.
        settings: the model.
        model: the measurement model; None: readings cannot be predicted.
    """

    def __init__(
        self,
        solve: Solve,
        peaks: Measurements,
        settings: MatchSettings,
        model: MeasurementModel | None,
    ) -> None:
        self.solve, self.peaks, self.settings, self.model = solve, peaks, settings, model
        self.free = peaks.usable.copy()
        self.seeing = tuple(int(sensor) for sensor in np.flatnonzero(peaks.count > 0))
        self.candidates = Candidates.empty(len(peaks))
        self.misfit_density = MisfitDensity()
        self.predicted_misfit_density = MisfitDensity()
        self.predicted: PredictedPoints | None = None
        self.groups: list[Group] = []
        self.group_points = [PointBatch.empty(len(peaks))]
        self.cut = 0
        self.points = 0

    def add_predicted(self, predicted: PredictedPoints) -> None:
        """Add the combinations that may be predicted points."""
        assert self.model is not None
        self.predicted = predicted
        candidates, cut = predicted_candidates(
            self.solve,
            self.model,
            self.peaks,
            predicted,
            self.settings.max_points,
            self.predicted_misfit_density,
        )
        self.candidates = Candidates.concatenate([self.candidates, candidates])
        self.cut += cut

    def add_free(self) -> None:
        """Add the combinations of four peaks and more."""
        counts = tuple(int(count) for count in self.peaks.count)
        several = len(self.seeing) > 4
        plain = np.prod([counts[sensor] for sensor in self.seeing], dtype=np.float64)
        all_combinations = np.prod(
            [counts[sensor] + several for sensor in self.seeing], dtype=np.float64
        )
        if all_combinations <= MAX_EXHAUSTIVE_COMBINATIONS:
            self._add_all(_all_choices(counts, 4))
        elif self.model is not None:
            self._add_stepwise(self.model)
        elif plain <= MAX_UNPREDICTED_COMBINATIONS:
            self._add_all(_all_choices(counts, len(self.seeing)))
        else:
            self.cut += int(min(plain, 2.0**62))

    def finish(self) -> None:
        """Make groups of the most probable set, and one of single remaining peaks."""
        self._decide(inf)
        self._add_single()

    def _add_all(self, choice: Choice) -> None:
        tried = solve_combinations(self.solve, self.peaks, choice)
        self.points += len(choice)
        least = max(1, int(tried.dof.min(initial=len(self.peaks))))
        true = int(self.peaks.count[list(self.seeing)].min())
        self.misfit_density.count(tried.chi2[tried.dof == least], least, true)
        self.candidates = Candidates.concatenate([self.candidates, tried.candidates])

    def _add_stepwise(self, model: MeasurementModel) -> None:
        """Start from triples of sensors that no marker escapes; first what nearly all saw."""
        seeing = len(self.seeing)
        strict = max(5, seeing - 2)
        for least in (strict, 4) if seeing > 4 else (4,):
            for base in covering_triples(seeing, least):
                sensors = tuple(self.seeing[index] for index in base)
                free_counts = self.free.sum(axis=1)
                if (free_counts > 0).sum() < least:
                    return
                work = int(np.prod(free_counts[list(sensors)], dtype=np.int64))
                if self.points + work > self.settings.max_points:
                    self.cut += work
                    continue
                choice, cut = complete_triples(
                    self.solve,
                    model,
                    self.peaks,
                    self.free,
                    (sensors[0], sensors[1], sensors[2]),
                    least,
                    self.settings.max_points,
                    self.misfit_density,
                )
                self.points += work + len(choice)
                self.cut += cut
                before = len(self.candidates)
                if len(choice):
                    self._add_new(solve_combinations(self.solve, self.peaks, choice).candidates)
                if seeing > 4 and len(self.candidates) > before:
                    self._decide(_ACCEPTED_ERROR_SHARE * self.settings.max_error_rate)

    def _add_new(self, candidates: Candidates) -> None:
        previous = {
            tuple(row) for row in self.candidates.choice[self.candidates.predicted < 0].tolist()
        }
        new = [tuple(row) not in previous for row in candidates.choice.tolist()]
        unique = candidates.rows(np.array(new, dtype=np.bool_))
        self.candidates = Candidates.concatenate([self.candidates, unique])

    def _missed(self, candidates: Candidates) -> NDArray[np.intp]:
        """Return how many sensors should have a peak of each candidate and have none."""
        none = candidates.choice < 0
        if self.model is not None and none.any():
            none &= self.model.predict(candidates.position_mm).in_view
        missed: NDArray[np.intp] = none.sum(axis=1)
        return missed

    def _columns(self) -> tuple[list[tuple[int, ...]], list[float]]:
        room, sensors = self.peaks.position_px.shape[1], len(self.peaks)
        scores = self.candidates.scores(self.settings, self._missed(self.candidates))
        # Three peaks alone always meet.
        scores[(self.candidates.dof < 1) & (self.candidates.predicted < 0)] = -inf
        first = [sensor * room for sensor in range(sensors)]
        columns = [
            tuple([start + peak for start, peak in zip(first, choice, strict=True) if peak >= 0])
            for choice in self.candidates.choice.tolist()
        ]
        for at in np.flatnonzero(self.candidates.predicted >= 0).tolist():
            columns[at] = (*columns[at], sensors * room + int(self.candidates.predicted[at]))
        return columns, scores.tolist()

    def _decide(self, max_error: float) -> None:
        """Make groups of the most probable set's candidates; those only that are wrong more rarely.

        Their peaks are no longer free, and candidates that use them are dropped.
        """
        columns, scores = self._columns()
        settings = self.settings
        packing = solve_set_packing(
            columns, scores, settings.window, settings.max_hypotheses, self.peaks.capacity
        )
        room = self.peaks.position_px.shape[1]
        peaks = len(self.peaks) * room
        free_counts = self.free.sum(axis=1).astype(np.float64)
        for index in packing.chosen:
            for resource in columns[index]:
                if resource < peaks:
                    free_counts[resource // room] -= 1.0
        chosen = self.candidates.rows(np.array(packing.chosen, np.intp))
        markers = max(len(chosen) + len(self.groups), 1)
        unexplained = UnexplainedPeaks(self.peaks, settings, free_counts, markers)
        errors = packing.error_probability + ErrorEstimate(
            self.solve, self.peaks, settings, unexplained, markers, self.predicted
        ).error_probability(chosen, self.misfit_density, self.predicted_misfit_density)
        used_resources: set[int] = set()
        for index, error in zip(packing.chosen, errors.tolist(), strict=True):
            if error <= max_error:
                choice = tuple(self.candidates.choice[index].tolist())
                ambiguous = error > settings.max_error_rate or self.cut > 0
                predicted = int(self.candidates.predicted[index])
                self.groups.append(Group(choice, ambiguous, predicted))
                self.group_points.append(self.candidates.points.part(index, index + 1))
                used_resources.update(columns[index])
        for resource in used_resources:
            if resource < peaks:
                self.free[divmod(resource, room)] = False
        if max_error == inf:
            self.cut += packing.cut
        elif used_resources:
            keep = np.array([used_resources.isdisjoint(column) for column in columns])
            self.candidates = self.candidates.rows(keep)

    def _add_single(self) -> None:
        """One peak left on each of three sensors or more may be a marker that others missed."""
        free_counts = self.free.sum(axis=1)
        if (free_counts == 1).sum() < 3 or free_counts.max() > 1:
            return
        choice = np.where(free_counts == 1, self.free.argmax(axis=1), -1)
        candidates = solve_combinations(self.solve, self.peaks, choice[None]).candidates
        if (
            len(candidates)
            and float(candidates.scores(self.settings, self._missed(candidates))[0]) > 0.0
        ):
            self.groups.append(Group(tuple(choice.tolist()), True))
            self.group_points.append(candidates.points)


@lru_cache(maxsize=256)
def _all_choices(counts: tuple[int, ...], least: int) -> Choice:
    """Return all choices of a minimum number of peaks, shape (C, S); read-only."""
    seeing = sum(count > 0 for count in counts)
    axes = [np.arange(-1 if count == 0 or seeing > least else 0, max(count, 0)) for count in counts]
    choice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(counts))
    sufficient: Choice = choice[(choice >= 0).sum(axis=1) >= least]
    sufficient.setflags(write=False)
    return sufficient
