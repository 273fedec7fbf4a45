"""Doubt: how likely a group is wrong in ways that no other set of candidates shows."""

from dataclasses import dataclass
from math import exp, log, pi
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.reconstruction.correspondence.bodies import BodyMatch
from compute.reconstruction.correspondence.candidates import (
    EXTENT_MM,
    Candidates,
    Chance,
    Solve,
    solved,
)
from compute.reconstruction.correspondence.outside import PredictedPoints, log_density_of
from compute.reconstruction.correspondence.peaks import FramePeaks
from compute.reconstruction.correspondence.settings import MatchSettings

Array = NDArray[np.float64]

_UNSEEN: Final = 0.25
"""Unexplained peaks of a sensor that are expected beside those that are there, and for each
marker as many more as it has chances to be missed."""
_LEAST: Final = -100.0
_LOG_ROOT_TWO_PI: Final = 0.5 * log(2.0 * pi)


@dataclass(frozen=True, eq=False)
class Doubt:
    """What is known of a frame when its likeliest set has been found.

    Args:
        solve: reconstructs.
        peaks: of the frame.
        settings: the model.
        left: peaks of each sensor that the set does not explain, shape (S,).
        markers: how many the set has.
        predicted: where markers are expected; None: nothing is known.
    """

    solve: Solve
    peaks: FramePeaks
    settings: MatchSettings
    left: Array
    markers: int
    predicted: PredictedPoints | None = None

    @property
    def unexplained(self) -> Array:
        """Unexplained peaks of each sensor that must be reckoned with, shape (S,)."""
        expected = _UNSEEN + self.markers * (1.0 - self.settings.detection)
        unexplained: Array = np.maximum(self.left, 0.0) + expected
        return unexplained

    def of(self, found: Candidates, chance: Chance, predicted: Chance) -> Array:
        """Return the chances that candidates of the set are wrong, shape (C,).

        Args:
            found: the C candidates.
            chance: of misfits between sensors.
            predicted: of misfits to predicted points.
        """
        doubt: Array = self._by_chance(found, chance, predicted) + self._foreign(found)
        # What may be anywhere fits everywhere, and proves nothing.
        doubt[np.trace(found.covariance_mm2, axis1=1, axis2=2) > EXTENT_MM**2] = 1.0
        return doubt

    def _by_chance(self, found: Candidates, chance: Chance, predicted: Chance) -> Array:
        """Return the expected numbers of wrong combinations that fit as well as these do.

        Were one wrong, its peaks would be unexplained as well: the more of those, the likelier.
        """
        settings = self.settings
        used = found.choice >= 0
        seen = used.sum(axis=1)
        seeing = int((self.peaks.count > 0).sum())
        # A marker that these sensors saw, and the others not.
        true = seen * log(settings.detection) + (seeing - seen) * settings.log_missed
        tracked = found.predicted >= 0
        # Three of the misfits are to the prediction, of which there is one.
        true += np.where(tracked, 0.0, log(self.markers))
        degrees = np.where(tracked, found.degrees - 3, found.degrees)
        near = degrees * spread_of(chance) + np.where(tracked, 3.0 * spread_of(predicted), 0.0)
        ways = used @ np.log(self.unexplained)
        odds: Array = np.exp(np.minimum(ways - true + near + 0.5 * found.chi2, 0.0))
        return odds

    def of_body(self, match: BodyMatch, members: Candidates, chance: Chance) -> float:
        """Return the expected number of wrong matches that fit as well as a body's does."""
        ways = float(((members.choice >= 0) @ np.log(self.unexplained)).sum())
        peaks = int((members.choice >= 0).sum())
        near = match.degrees * spread_of(chance) + 0.5 * match.chi2
        return exp(min(ways - peaks * log(self.settings.detection) + near, 0.0))

    def _foreign(self, found: Candidates) -> Array:
        """Return the chances that one of a candidate's peaks is not its own, which it missed.

        Its reading is then one of the unexplained peaks near by: as likely as those are dense,
        against the density of its innovation, by what the other sensors say.
        """
        used = found.choice >= 0
        which, sensor = np.nonzero(used & (used.sum(axis=1) > 3)[:, None])
        if len(which) == 0:
            return np.zeros(len(found))
        without = found.choice[which]
        without[np.arange(len(which)), sensor] = -1
        fewer = solved(self.solve, self.peaks, without)
        which, sensor = which[fewer.row], sensor[fewer.row]
        log_density = found.log_fit[which] - fewer.found.log_fit
        of = found.predicted[which]
        tracked = np.flatnonzero(of >= 0)
        if self.predicted is not None and len(tracked):
            # What the prediction says is one more observation, with the peak and without.
            alone = log_density_of(fewer.found.take(tracked), self.predicted, of[tracked])
            log_density[tracked] += found.log_density[which[tracked]] - alone
        missed = 1.0 / self.settings.detection - 1.0
        odds = missed * self.density[sensor] * np.exp(-log_density)
        total: Any = np.bincount(which, odds, minlength=len(found))
        return np.asarray(total, dtype=np.float64)

    @property
    def density(self) -> Array:
        """Return how dense unexplained peaks are, over where the peaks lie, shape (S,) [1/px]."""
        place, count = self.peaks.position_px, self.peaks.count
        last = place[np.arange(len(place)), np.maximum(count - 1, 0)]
        with np.errstate(divide="ignore", invalid="ignore"):
            density = self.unexplained * (count - 1) / ((last - place[:, 0]) * (count + 1))
        return np.where(count >= 3, density, self.settings.false_per_px)


def spread_of(chance: Chance) -> float:
    """Log of how many wrong misfits there are for one that noise makes, at zero."""
    # Where nothing was counted nothing was tried, and the figure is not used.
    return max(chance.log_density() + _LOG_ROOT_TWO_PI, _LEAST)
