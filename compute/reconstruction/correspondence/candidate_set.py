"""CandidateSet: the candidates of an exposure and the groups that are chosen from them."""

from functools import lru_cache
from math import inf
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements
from compute.reconstruction.correspondence.ambiguity import ErrorEstimate
from compute.reconstruction.correspondence.candidates import (
    Candidates,
    Choice,
    MisfitDensity,
    Solve,
    empty_candidates,
    solve_combinations,
)
from compute.reconstruction.correspondence.incremental import all_triples, complete_triples
from compute.reconstruction.correspondence.intersections import covering_triples
from compute.reconstruction.correspondence.predicted_candidates import (
    PredictedPoints,
    predicted_candidates,
)
from compute.reconstruction.correspondence.rigid_bodies import BodyMatch, body_matches
from compute.reconstruction.correspondence.set_packing import SetPacking, solve_set_packing
from compute.reconstruction.correspondence.settings import Group, MatchSettings

if TYPE_CHECKING:
    from compute.reconstruction.point_batch import PointBatch

Array = NDArray[np.float64]

MAX_EXHAUSTIVE_COMBINATIONS: Final = 300
"""Combinations, missing peaks included, that are tried all at once rather than step by step."""
MAX_UNPREDICTED_COMBINATIONS: Final = 20_000
"""Combinations that are tried where nothing predicts readings: 11 markers on four sensors."""
_ACCEPTED_ERROR_SHARE: Final = 0.5
"""Share of the wrong rate below which a group is taken for good, before all is looked at."""


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
        self.candidates = empty_candidates(len(peaks))
        self.misfit_density = MisfitDensity()
        self.predicted_misfit_density = MisfitDensity()
        self.predicted: PredictedPoints | None = None
        self.body_misfit_density = MisfitDensity()
        self.bodies: list[tuple[int, BodyMatch]] = []
        self.groups: list[Group] = []
        self.group_points: list[PointBatch] = []
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
        self.candidates = self.candidates.concatenate(candidates)
        self.cut += cut

    def add_free(self) -> None:
        """Add the combinations of four peaks and more."""
        counts = tuple(int(count) for count in self.peaks.count)
        several = len(self.seeing) > 4
        plain = np.prod([counts[sensor] for sensor in self.seeing], dtype=np.float64)
        whole = np.prod([counts[sensor] + several for sensor in self.seeing], dtype=np.float64)
        if whole <= MAX_EXHAUSTIVE_COMBINATIONS:
            self._add_all(_all_choices(counts, 4))
        elif self.model is not None:
            self._add_stepwise(self.model)
        elif plain <= MAX_UNPREDICTED_COMBINATIONS:
            self._add_all(_all_choices(counts, len(self.seeing)))
        else:
            self.cut += int(min(plain, 2.0**62))

    def add_body(self, index: int, markers_mm: Array) -> None:
        """Add the matches of a rigid body among the candidates and the triples of other peaks.

        Args:
            index: index of the body.
            markers_mm: its markers in its own coordinates, shape (M, 3) [mm].
        """
        free = self.free.copy()
        for row in self._likeliest():
            for sensor, peak in enumerate(self.candidates.choice[row]):
                if peak >= 0 and len(self.seeing) > 3:
                    free[sensor, peak] = False
        start = [all_triples(free, base) for base in covering_triples(len(self.peaks), 3)]
        choice = np.concatenate([self.candidates.choice[self.candidates.predicted < 0], *start])
        if len(choice) > self.settings.max_points:
            self.cut += len(choice) - self.settings.max_points
            choice = choice[: self.settings.max_points]
        if len(choice) == 0:
            return
        candidates = solve_combinations(self.solve, self.peaks, choice).candidates
        if self.model is not None:
            seen = self.model.predict(candidates.position_mm)
            # A ghost that a sensor would have to read beyond its ends is none.
            candidates = candidates.take(
                np.flatnonzero((seen.in_view | (candidates.choice < 0)).all(axis=1))
            )
        matches, cut = body_matches(
            markers_mm,
            candidates,
            candidates.scores(self.settings, self._missed(candidates)),
            self.settings,
            self.body_misfit_density,
        )
        self.cut += cut
        first = len(self.candidates)
        self.candidates = self.candidates.concatenate(candidates)
        for match in matches:
            rows = tuple(row + first if row >= 0 else -1 for row in match.rows)
            self.bodies.append((index, BodyMatch(rows, match.score, match.chi2, match.dof)))

    def finish(self) -> None:
        """Make groups of the likeliest set, and one of single remaining peaks."""
        self._decide(inf)
        self._add_single()

    def _add_all(self, choice: Choice) -> None:
        tried = solve_combinations(self.solve, self.peaks, choice)
        self.points += len(choice)
        least = max(1, int(tried.dof.min(initial=len(self.peaks))))
        true = int(self.peaks.count[list(self.seeing)].min())
        self.misfit_density.count(tried.chi2[tried.dof == least], least, true)
        self.candidates = self.candidates.concatenate(tried.candidates)

    def _add_stepwise(self, model: MeasurementModel) -> None:
        """Start from triples of sensors that no marker escapes; first what nearly all saw."""
        seeing = len(self.seeing)
        strict = max(5, seeing - 2)
        for least in (strict, 4) if seeing > 4 else (4,):
            for base in covering_triples(seeing, least):
                sensors = tuple(self.seeing[index] for index in base)
                left = self.free.sum(axis=1)
                if (left > 0).sum() < least:
                    return
                work = int(np.prod(left[list(sensors)], dtype=np.int64))
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
        known = {
            tuple(row) for row in self.candidates.choice[self.candidates.predicted < 0].tolist()
        }
        new = [tuple(row) not in known for row in candidates.choice.tolist()]
        self.candidates = self.candidates.concatenate(
            candidates.take(np.array(new, dtype=np.bool_))
        )

    def _missed(self, candidates: Candidates) -> NDArray[np.intp]:
        """Return how many sensors should have a peak of each candidate and have none."""
        none = candidates.choice < 0
        if self.model is not None and none.any():
            none &= self.model.predict(candidates.position_mm).in_view
        missed: NDArray[np.intp] = none.sum(axis=1)
        return missed

    def _columns(self) -> tuple[list[tuple[int, ...]], list[float]]:
        room, sensors = self.peaks.max_count, len(self.peaks)
        scores = self.candidates.scores(self.settings, self._missed(self.candidates))
        # Three peaks alone are only looked at as part of a body.
        scores[(self.candidates.dof < 1) & (self.candidates.predicted < 0)] = -inf
        first = [sensor * room for sensor in range(sensors)]
        columns = [
            tuple([start + peak for start, peak in zip(first, choice, strict=True) if peak >= 0])
            for choice in self.candidates.choice.tolist()
        ]
        points = 0
        for at in np.flatnonzero(self.candidates.predicted >= 0).tolist():
            point = int(self.candidates.predicted[at])
            points = max(points, point + 1)
            columns[at] = (*columns[at], sensors * room + point)
        values = scores.tolist()
        for index, match in self.bodies:
            used = [r for row in match.rows if row >= 0 for r in columns[row]]
            columns.append((*used, sensors * room + points + index))
            values.append(match.score)
        return columns, values

    def _likeliest(self) -> list[int]:
        columns, scores = self._columns()
        packing = solve_set_packing(
            columns, scores, 0.0, self.settings.max_hypotheses, self.peaks.capacity
        )
        return [index for index in packing.chosen if index < len(self.candidates)]

    def _decide(self, max_error: float) -> None:
        """Make groups of the likeliest set's candidates; those only that are wrong more rarely.

        Their peaks are no longer free, and candidates that use them are dropped.
        """
        columns, scores = self._columns()
        settings = self.settings
        packing = solve_set_packing(
            columns, scores, settings.window, settings.max_hypotheses, self.peaks.capacity
        )
        room = self.peaks.max_count
        peaks = len(self.peaks) * room
        left = self.free.sum(axis=1).astype(np.float64)
        for index in packing.chosen:
            for resource in columns[index]:
                if resource < peaks:
                    left[resource // room] -= 1.0
        doubts = self._error_probabilities(packing, left)
        gone: set[int] = set()
        for index, doubt in zip(packing.chosen, doubts, strict=True):
            if doubt <= max_error:
                self._make(index, doubt > settings.max_error_rate or self.cut > 0)
                gone.update(columns[index])
        for resource in gone:
            if resource < peaks:
                self.free[divmod(resource, room)] = False
        if max_error == inf:
            self.cut += packing.cut
        elif gone:
            keep = np.array([gone.isdisjoint(column) for column in columns[: len(self.candidates)]])
            self.candidates = self.candidates.take(keep)

    def _error_probabilities(self, packing: SetPacking, left: Array) -> list[float]:
        """Return the chances that the chosen columns are wrong, in order."""
        markers = max(len(packing.chosen) + len(self.groups), 1)
        known = ErrorEstimate(self.solve, self.peaks, self.settings, left, markers, self.predicted)
        single = [index for index in packing.chosen if index < len(self.candidates)]
        of_single = known.error_probability(
            self.candidates.take(np.array(single, np.intp)),
            self.misfit_density,
            self.predicted_misfit_density,
        ).tolist()
        by_index = dict(zip(single, of_single, strict=True))
        for index in packing.chosen[len(single) :]:
            match = self.bodies[index - len(self.candidates)][1]
            members = self.candidates.take(np.array([row for row in match.rows if row >= 0]))
            by_index[index] = known.body_error_probability(match, members, self.body_misfit_density)
        return [
            error_probability + by_index[index]
            for index, error_probability in zip(
                packing.chosen, packing.error_probability, strict=True
            )
        ]

    def _make(self, index: int, ambiguous: bool) -> None:
        if index < len(self.candidates):
            choice = tuple(int(peak) for peak in self.candidates.choice[index])
            self.groups.append(Group(choice, ambiguous, int(self.candidates.predicted[index])))
            self.group_points.append(self.candidates.points.part(index, index + 1))
            return
        body, match = self.bodies[index - len(self.candidates)]
        for marker, row in enumerate(match.rows):
            if row >= 0:
                choice = tuple(int(peak) for peak in self.candidates.choice[row])
                self.groups.append(Group(choice, ambiguous, -1, body, marker))
                self.group_points.append(self.candidates.points.part(row, row + 1))

    def _add_single(self) -> None:
        """One peak left on each of three sensors or more may be a marker that others missed."""
        left = self.free.sum(axis=1)
        if (left == 1).sum() < 3 or left.max() > 1:
            return
        choice = np.where(left == 1, self.free.argmax(axis=1), -1)
        candidates = solve_combinations(self.solve, self.peaks, choice[None]).candidates
        if (
            len(candidates)
            and float(candidates.scores(self.settings, self._missed(candidates))[0]) > 0.0
        ):
            self.groups.append(Group(tuple(int(peak) for peak in choice), True))
            self.group_points.append(candidates.points)


@lru_cache(maxsize=256)
def _all_choices(counts: tuple[int, ...], least: int) -> Choice:
    """Return all choices of a minimum number of peaks, shape (C, S); read-only."""
    seeing = sum(count > 0 for count in counts)
    axes = [np.arange(-1 if count == 0 or seeing > least else 0, max(count, 0)) for count in counts]
    choice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(counts))
    kept: Choice = choice[(choice >= 0).sum(axis=1) >= least]
    kept.setflags(write=False)
    return kept
