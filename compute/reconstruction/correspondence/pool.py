"""Pool: a frame's candidates, what was decided of them, and the groups that came of it."""

from dataclasses import dataclass
from functools import lru_cache
from math import exp, inf, log, pi
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.reconstruction.correspondence.bodies import BodyMatch, body_matches
from compute.reconstruction.correspondence.candidates import (
    EXTENT_MM,
    Candidates,
    Chance,
    Choice,
    Solve,
    no_candidates,
    solved,
)
from compute.reconstruction.correspondence.cover import covering_triples
from compute.reconstruction.correspondence.outside import PredictedPoints, predicted_candidates
from compute.reconstruction.correspondence.packing import pack
from compute.reconstruction.correspondence.peaks import FramePeaks
from compute.reconstruction.correspondence.predictor import Predictor
from compute.reconstruction.correspondence.settings import MatchSettings
from compute.reconstruction.correspondence.stepwise import completed, triples

Array = NDArray[np.float64]

MOST_SMALL: Final = 300
"""Combinations, missing peaks included, that are tried all at once rather than step by step."""
MOST_PLAIN: Final = 20_000
"""Combinations that are tried where nothing predicts readings: 11 markers on four sensors."""
_UNSEEN: Final = 0.25
"""Unexplained peaks of a sensor that are expected beside those that are there, and for each
marker as many more as it has chances to be missed."""
_FREEZE: Final = 0.5
"""Share of the wrong rate below which a group is taken for good, before all is looked at."""
_LOG_ROOT_TWO_PI: Final = 0.5 * log(2.0 * pi)


@dataclass(frozen=True)
class Group:
    """A marker's peaks: their indices by sensor, -1: none; see ``Correspondence``."""

    choice: tuple[int, ...]
    ambiguous: bool
    predicted: int = -1
    body: int = -1
    body_marker: int = -1


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
        self.body_chance = Chance()
        self.bodies: list[tuple[int, BodyMatch]] = []
        self.groups: list[Group] = []
        self.cut = 0
        self.points = 0

    def add_predicted(self, predicted: PredictedPoints) -> None:
        """Add the combinations that may be predicted points."""
        assert self.predict is not None
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
            found = found.take((seen.in_view | (found.choice < 0)).all(axis=1))
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
        self.body_rows = range(first, len(self.found))
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
        return none.sum(axis=1)

    def _columns(self) -> tuple[list[tuple[int, ...]], list[float]]:
        room, sensors = self.peaks.room, len(self.peaks)
        scores = self.found.scores(self.settings, self._missed(self.found))
        # Three peaks alone are only looked at as part of a body.
        scores[(self.found.degrees < 1) & (self.found.predicted < 0)] = -inf
        columns = []
        for choice, point in zip(
            self.found.choice.tolist(), self.found.predicted.tolist(), strict=True
        ):
            used = [sensor * room + peak for sensor, peak in enumerate(choice) if peak >= 0]
            if point >= 0:
                used.append(sensors * room + point)
            columns.append(tuple(used))
        values = scores.tolist()
        points = max([0, *(int(point) + 1 for point in self.found.predicted)])
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
        left = self.free.sum(axis=1).astype(np.float64)
        room = self.peaks.room
        for index in packing.chosen:
            for resource in columns[index]:
                if resource < len(self.peaks) * room:
                    left[resource // room] -= 1.0
        markers = max(len(packing.chosen) + len(self.groups), 1)
        expected = _UNSEEN + markers * (1.0 - settings.detection)
        unexplained = np.log(np.maximum(left, 0.0) + expected)
        foreign = self._foreign(packing.chosen, np.exp(unexplained))
        gone: set[int] = set()
        for index, wrong in zip(packing.chosen, packing.wrong, strict=True):
            doubt = wrong + self._by_chance(index, columns[index], unexplained, markers)
            doubt += foreign.get(index, 0.0)
            if doubt > sure:
                continue
            ambiguous = doubt > settings.wrong_rate or self.cut > 0 or self._undetermined(index)
            self._make(index, ambiguous)
            gone.update(columns[index])
        if sure == inf:
            self.cut += packing.cut
        if sure < inf and gone:
            for resource in gone:
                if resource < len(self.peaks) * room:
                    self.free[divmod(resource, room)] = False
            keep = np.array([gone.isdisjoint(column) for column in columns[: len(self.found)]])
            self.found = self.found.take(keep)
        elif gone:
            for resource in gone:
                if resource < len(self.peaks) * room:
                    self.free[divmod(resource, room)] = False

    def _by_chance(
        self, index: int, column: tuple[int, ...], unexplained: Array, markers: int
    ) -> float:
        """Return the expected number of wrong combinations that fit as well as this one does.

        Were it wrong, its peaks would be unexplained as well: the more of those, the likelier.
        """
        room, settings = self.peaks.room, self.settings
        used = [resource // room for resource in column if resource < len(self.peaks) * room]
        # A marker that these sensors saw, and the others not.
        true = log(markers) + len(used) * log(settings.detection)
        if index < len(self.found):
            chi2, degrees = float(self.found.chi2[index]), int(self.found.degrees[index])
            true += (len(self.seeing) - len(used)) * settings.log_missed
            near = 0.0
            if self.found.predicted[index] >= 0:
                # Three of the misfits are to the prediction, of which there is one.
                true -= log(markers)
                degrees -= 3
                near = 3.0 * (self.predicted_chance.log_density() + _LOG_ROOT_TWO_PI)
            if degrees > 0:
                near += degrees * (self.chance.log_density() + _LOG_ROOT_TWO_PI)
        else:
            match = self.bodies[index - len(self.found)][1]
            chi2 = match.chi2
            near = match.degrees * (self.body_chance.log_density() + _LOG_ROOT_TWO_PI)
        ways = sum(float(unexplained[sensor]) for sensor in used)
        log_odds = ways - true + near + 0.5 * chi2
        return exp(min(log_odds, 0.0))

    def _foreign(self, chosen: tuple[int, ...], unexplained: Array) -> dict[int, float]:
        """Return the chances that one of a candidate's peaks is not its own, which it missed.

        Its reading is then one of the unexplained peaks near by: as likely as those are dense,
        against the density of its innovation, by what the other sensors say.
        """
        rows = [index for index in chosen if index < len(self.found)]
        choice = self.found.choice[rows]
        which, sensor = np.nonzero((choice >= 0) & ((choice >= 0).sum(axis=1) > 3)[:, None])
        if len(which) == 0:
            return {}
        without = choice[which]
        without[np.arange(len(which)), sensor] = -1
        fewer = solved(self.solve, self.peaks, without)
        which, sensor = which[fewer.row], sensor[fewer.row]
        log_density = self.found.log_fit[rows][which] - fewer.found.log_fit
        extent = self._extent()
        known = np.isfinite(extent)
        density = np.where(known, unexplained / extent, self.settings.false_per_px)
        odds = (1.0 / self.settings.detection - 1.0) * density[sensor] * np.exp(-log_density)
        total = np.bincount(which, odds, minlength=len(rows))
        return dict(zip(rows, total.tolist(), strict=True))

    def _extent(self) -> Array:
        """Return over how many pixels each sensor's peaks are spread, shape (S,); inf: too few."""
        place, count = self.peaks.position_px, self.peaks.count
        last = place[np.arange(len(place)), np.maximum(count - 1, 0)]
        with np.errstate(divide="ignore", invalid="ignore"):
            spread = (last - place[:, 0]) * (count + 1) / (count - 1)
        return np.where(count >= 3, spread, np.inf)

    def _undetermined(self, index: int) -> bool:
        """Say whether a candidate may be anywhere: what fits everywhere proves nothing."""
        if index >= len(self.found):
            return False
        return float(np.trace(self.found.covariance_mm2[index])) > EXTENT_MM**2

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
