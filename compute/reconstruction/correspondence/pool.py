"""Pool: a frame's candidates, what was decided of them, and the groups that came of it."""

from functools import lru_cache
from math import inf
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.reconstruction.correspondence.bodies import BodyMatch, body_matches
from compute.reconstruction.correspondence.candidates import (
    Candidates,
    Chance,
    Choice,
    Solve,
    no_candidates,
    solved,
)
from compute.reconstruction.correspondence.cover import covering_triples
from compute.reconstruction.correspondence.doubt import Doubt
from compute.reconstruction.correspondence.outside import PredictedPoints, predicted_candidates
from compute.reconstruction.correspondence.packing import Packing, pack
from compute.reconstruction.correspondence.peaks import FramePeaks
from compute.reconstruction.correspondence.predictor import Predictor
from compute.reconstruction.correspondence.result import Group
from compute.reconstruction.correspondence.settings import MatchSettings
from compute.reconstruction.correspondence.stepwise import completed, triples

Array = NDArray[np.float64]

MOST_SMALL: Final = 300
"""Combinations, missing peaks included, that are tried all at once rather than step by step."""
MOST_PLAIN: Final = 20_000
"""Combinations that are tried where nothing predicts readings: 11 markers on four sensors."""
_FREEZE: Final = 0.5
"""Share of the wrong rate below which a group is taken for good, before all is looked at."""


class Pool:
    """The candidates of a frame.

    Args:
        solve: reconstructs.
        peaks: of the frame.
        settings: the model.
        predict: the sensors, forward; None: not known.
    """

    def __init__(
        self, solve: Solve, peaks: FramePeaks, settings: MatchSettings, predict: Predictor | None
    ) -> None:
        self.solve, self.peaks, self.settings, self.predict = solve, peaks, settings, predict
        self.free = np.isfinite(peaks.position_px)
        self.seeing = tuple(int(sensor) for sensor in np.flatnonzero(peaks.count > 0))
        self.found = no_candidates(len(peaks))
        self.chance = Chance()
        self.predicted_chance = Chance()
        self.predicted: PredictedPoints | None = None
        self.body_chance = Chance()
        self.bodies: list[tuple[int, BodyMatch]] = []
        self.groups: list[Group] = []
        self.cut = 0
        self.points = 0

    def add_predicted(self, predicted: PredictedPoints) -> None:
        """Add the combinations that may be predicted points."""
        assert self.predict is not None
        self.predicted = predicted
        found, cut = predicted_candidates(
            self.solve,
            self.predict,
            self.peaks,
            predicted,
            self.settings.most_points,
            self.predicted_chance,
        )
        self.found = self.found.joined(found)
        self.cut += cut

    def add_free(self) -> None:
        """Add the combinations of four peaks and more."""
        counts = tuple(int(count) for count in self.peaks.count)
        several = len(self.seeing) > 4
        plain = np.prod([counts[sensor] for sensor in self.seeing], dtype=np.float64)
        whole = np.prod([counts[sensor] + several for sensor in self.seeing], dtype=np.float64)
        if whole <= MOST_SMALL:
            self._add_all(_all_choices(counts, 4))
        elif self.predict is not None:
            self._add_stepwise(self.predict)
        elif plain <= MOST_PLAIN:
            self._add_all(_all_choices(counts, len(self.seeing)))
        else:
            self.cut += int(min(plain, 2.0**62))

    def add_body(self, index: int, markers_mm: Array) -> None:
        """Add what may be a body among the candidates and the triples of what is left."""
        free = self.free.copy()
        for row in self._likeliest():
            for sensor, peak in enumerate(self.found.choice[row]):
                if peak >= 0 and len(self.seeing) > 3:
                    free[sensor, peak] = False
        start = [triples(free, base) for base in covering_triples(len(self.peaks), 3)]
        choice = np.concatenate([self.found.choice[self.found.predicted < 0], *start])
        if len(choice) > self.settings.most_points:
            self.cut += len(choice) - self.settings.most_points
            choice = choice[: self.settings.most_points]
        if len(choice) == 0:
            return
        found = solved(self.solve, self.peaks, choice).found
        if self.predict is not None:
            seen = self.predict(found.position_mm)
            # A ghost that a sensor would have to read beyond its ends is none.
            found = found.take(np.flatnonzero((seen.in_view | (found.choice < 0)).all(axis=1)))
        matches, cut = body_matches(
            markers_mm,
            found,
            found.scores(self.settings, self._missed(found)),
            self.settings,
            self.body_chance,
        )
        self.cut += cut
        first = len(self.found)
        self.found = self.found.joined(found)
        for match in matches:
            rows = tuple(row + first if row >= 0 else -1 for row in match.rows)
            self.bodies.append((index, BodyMatch(rows, match.score, match.chi2, match.degrees)))

    def close(self) -> None:
        """Turn the likeliest set into groups, and what leaves no choice into one more."""
        self._decide(inf)
        self._add_single()

    def _add_all(self, choice: Choice) -> None:
        tried = solved(self.solve, self.peaks, choice)
        self.points += len(choice)
        least = max(1, int(tried.degrees.min(initial=len(self.peaks))))
        true = int(self.peaks.count[list(self.seeing)].min())
        self.chance.count(tried.chi2[tried.degrees == least], least, true)
        self.found = self.found.joined(tried.found)

    def _add_stepwise(self, predict: Predictor) -> None:
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
                if self.points + work > self.settings.most_points:
                    self.cut += work
                    continue
                choice, cut = completed(
                    self.solve,
                    predict,
                    self.peaks,
                    self.free,
                    (sensors[0], sensors[1], sensors[2]),
                    least,
                    self.settings.most_points,
                    self.chance,
                )
                self.points += work + len(choice)
                self.cut += cut
                before = len(self.found)
                if len(choice):
                    self._join(solved(self.solve, self.peaks, choice).found)
                if seeing > 4 and len(self.found) > before:
                    self._decide(_FREEZE * self.settings.wrong_rate)

    def _join(self, found: Candidates) -> None:
        known = {tuple(row) for row in self.found.choice[self.found.predicted < 0].tolist()}
        new = [tuple(row) not in known for row in found.choice.tolist()]
        self.found = self.found.joined(found.take(np.array(new, dtype=np.bool_)))

    def _missed(self, found: Candidates) -> NDArray[np.intp]:
        """Return how many sensors should have a peak of each candidate and have none."""
        none = found.choice < 0
        if self.predict is not None and none.any():
            none &= self.predict(found.position_mm).in_view
        missed: NDArray[np.intp] = none.sum(axis=1)
        return missed

    def _columns(self) -> tuple[list[tuple[int, ...]], list[float]]:
        room, sensors = self.peaks.room, len(self.peaks)
        scores = self.found.scores(self.settings, self._missed(self.found))
        # Three peaks alone are only looked at as part of a body.
        scores[(self.found.degrees < 1) & (self.found.predicted < 0)] = -inf
        first = [sensor * room for sensor in range(sensors)]
        columns = [
            tuple([start + peak for start, peak in zip(first, choice, strict=True) if peak >= 0])
            for choice in self.found.choice.tolist()
        ]
        points = 0
        for at in np.flatnonzero(self.found.predicted >= 0).tolist():
            point = int(self.found.predicted[at])
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
        packing = pack(columns, scores, 0.0, self.settings.most_hypotheses, self.peaks.capacity)
        return [index for index in packing.chosen if index < len(self.found)]

    def _decide(self, sure: float) -> None:
        """Make groups of the likeliest set's candidates; those only that are wrong more rarely.

        Their peaks are no longer free, and candidates that use them are dropped.
        """
        columns, scores = self._columns()
        settings = self.settings
        packing = pack(
            columns, scores, settings.window, settings.most_hypotheses, self.peaks.capacity
        )
        room = self.peaks.room
        peaks = len(self.peaks) * room
        left = self.free.sum(axis=1).astype(np.float64)
        for index in packing.chosen:
            for resource in columns[index]:
                if resource < peaks:
                    left[resource // room] -= 1.0
        doubts = self._doubts(packing, left)
        gone: set[int] = set()
        for index, doubt in zip(packing.chosen, doubts, strict=True):
            if doubt <= sure:
                self._make(index, doubt > settings.wrong_rate or self.cut > 0)
                gone.update(columns[index])
        for resource in gone:
            if resource < peaks:
                self.free[divmod(resource, room)] = False
        if sure == inf:
            self.cut += packing.cut
        elif gone:
            keep = np.array([gone.isdisjoint(column) for column in columns[: len(self.found)]])
            self.found = self.found.take(keep)

    def _doubts(self, packing: Packing, left: Array) -> list[float]:
        """Return the chances that the chosen columns are wrong, in order."""
        markers = max(len(packing.chosen) + len(self.groups), 1)
        known = Doubt(self.solve, self.peaks, self.settings, left, markers, self.predicted)
        single = [index for index in packing.chosen if index < len(self.found)]
        of_single = known.of(
            self.found.take(np.array(single, np.intp)), self.chance, self.predicted_chance
        ).tolist()
        by_index = dict(zip(single, of_single, strict=True))
        for index in packing.chosen[len(single) :]:
            match = self.bodies[index - len(self.found)][1]
            members = self.found.take(np.array([row for row in match.rows if row >= 0]))
            by_index[index] = known.of_body(match, members, self.body_chance)
        return [
            wrong + by_index[index]
            for index, wrong in zip(packing.chosen, packing.wrong, strict=True)
        ]

    def _make(self, index: int, ambiguous: bool) -> None:
        if index < len(self.found):
            choice = tuple(int(peak) for peak in self.found.choice[index])
            self.groups.append(Group(choice, ambiguous, int(self.found.predicted[index])))
            return
        body, match = self.bodies[index - len(self.found)]
        for marker, row in enumerate(match.rows):
            if row >= 0:
                choice = tuple(int(peak) for peak in self.found.choice[row])
                self.groups.append(Group(choice, ambiguous, -1, body, marker))

    def _add_single(self) -> None:
        """One peak left on each of three sensors or more may be a marker that others missed."""
        left = self.free.sum(axis=1)
        if (left == 1).sum() < 3 or left.max() > 1:
            return
        choice = np.where(left == 1, self.free.argmax(axis=1), -1)
        found = solved(self.solve, self.peaks, choice[None]).found
        if len(found) and float(found.scores(self.settings, self._missed(found))[0]) > 0.0:
            self.groups.append(Group(tuple(int(peak) for peak in choice), True))


@lru_cache(maxsize=256)
def _all_choices(counts: tuple[int, ...], least: int) -> Choice:
    """Return every choice of at least so many peaks, as indices, shape (C, S); do not change it."""
    seeing = sum(count > 0 for count in counts)
    axes = [np.arange(-1 if count == 0 or seeing > least else 0, max(count, 0)) for count in counts]
    choice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(counts))
    kept: Choice = choice[(choice >= 0).sum(axis=1) >= least]
    kept.setflags(write=False)
    return kept
