"""ErrorEstimate: probability that a group is wrong, beyond what other sets of candidates show."""

from dataclasses import dataclass
from math import exp, log, pi
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurements import Measurements
from compute.reconstruction.correspondence.candidates import (
    MAX_EXTENT_MM,
    Candidates,
    MisfitDensity,
    Solve,
    solve_combinations,
)
from compute.reconstruction.correspondence.predicted_candidates import (
    PredictedPoints,
    log_prediction_density,
)
from compute.reconstruction.correspondence.rigid_bodies import BodyMatch
from compute.reconstruction.correspondence.settings import MatchSettings

Array = NDArray[np.float64]

_UNSEEN: Final = 0.25
"""Unexplained peaks of a sensor that are expected beside those that are there, and for each
marker as many more as it has chances to be missed."""
_MIN_LOG_DENSITY: Final = -100.0
_LOG_ROOT_TWO_PI: Final = 0.5 * log(2.0 * pi)


@dataclass(frozen=True, eq=False)
class ErrorEstimate:
    """Error probabilities of groups, from a frame and its likeliest set of markers.

    Args:
        solve: triangulates readings.
        peaks: of the frame.
        settings: the model.
        unassigned_peaks: peaks of each sensor that the set does not explain, shape (S,).
        markers: number of markers in the set.
        predicted: predicted positions of markers; None: none.
    """

    solve: Solve
    peaks: Measurements
    settings: MatchSettings
    unassigned_peaks: Array
    markers: int
    predicted: PredictedPoints | None = None

    @property
    def unexplained(self) -> Array:
        """Expected number of unexplained peaks of each sensor, shape (S,)."""
        expected = _UNSEEN + self.markers * (1.0 - self.settings.detection_probability)
        unexplained: Array = np.maximum(self.unassigned_peaks, 0.0) + expected
        return unexplained

    def error_probability(
        self, candidates: Candidates, misfit_density: MisfitDensity, predicted: MisfitDensity
    ) -> Array:
        """Return the error probabilities of the set's candidates, shape (C,).

        Args:
            candidates: the C candidates.
            misfit_density: of misfits between sensors.
            predicted: of misfits to predicted points.
        """
        doubt: Array = self._expected_false_matches(
            candidates, misfit_density, predicted
        ) + self._foreign_peak_probability(candidates)
        # What may be anywhere fits everywhere, and proves nothing.
        doubt[np.trace(candidates.covariance_mm2, axis1=1, axis2=2) > MAX_EXTENT_MM**2] = 1.0
        return doubt

    def _expected_false_matches(
        self, candidates: Candidates, misfit_density: MisfitDensity, predicted: MisfitDensity
    ) -> Array:
        """Return the expected numbers of wrong combinations that fit as well as these do.

        Were one wrong, its peaks would be unexplained as well: the more of those, the likelier.
        """
        settings = self.settings
        used = candidates.choice >= 0
        seen = used.sum(axis=1)
        seeing = int((self.peaks.count > 0).sum())
        # A marker that these sensors saw, and the others not.
        true = seen * log(settings.detection_probability) + (seeing - seen) * settings.log_missed
        tracked = candidates.predicted >= 0
        # Three of the misfits are to the prediction, of which there is one.
        true += np.where(tracked, 0.0, log(self.markers))
        dof = np.where(tracked, candidates.dof - 3, candidates.dof)
        near = dof * log_misfit_density(misfit_density) + np.where(
            tracked, 3.0 * log_misfit_density(predicted), 0.0
        )
        ways = used @ np.log(self.unexplained)
        odds: Array = np.exp(np.minimum(ways - true + near + 0.5 * candidates.chi2, 0.0))
        return odds

    def body_error_probability(
        self, match: BodyMatch, members: Candidates, misfit_density: MisfitDensity
    ) -> float:
        """Return the expected number of wrong matches that fit as well as a body's does.

        Args:
            match: the body's match, with its chi2.
            members: candidates that are its markers.
            misfit_density: density of wrong distances between points.
        """
        ways = float(((members.choice >= 0) @ np.log(self.unexplained)).sum())
        peaks = int((members.choice >= 0).sum())
        near = match.dof * log_misfit_density(misfit_density) + 0.5 * match.chi2
        return exp(min(ways - peaks * log(self.settings.detection_probability) + near, 0.0))

    def _foreign_peak_probability(self, candidates: Candidates) -> Array:
        """Return the chances that one of a candidate's peaks is not its own, which it missed.

        Its reading is then one of the unexplained peaks near by: as likely as those are dense,
        against the density of its innovation, by what the other sensors say.
        """
        used = candidates.choice >= 0
        which, sensor = np.nonzero(used & (used.sum(axis=1) > 3)[:, None])
        if len(which) == 0:
            return np.zeros(len(candidates))
        without = candidates.choice[which]
        without[np.arange(len(which)), sensor] = -1
        fewer = solve_combinations(self.solve, self.peaks, without)
        which, sensor = which[fewer.row], sensor[fewer.row]
        log_density = candidates.log_marginal[which] - fewer.candidates.log_marginal
        of = candidates.predicted[which]
        tracked = np.flatnonzero(of >= 0)
        if self.predicted is not None and len(tracked):
            # What the prediction says is one more observation, with the peak and without.
            alone = log_prediction_density(
                fewer.candidates.take(tracked), self.predicted, of[tracked]
            )
            log_density[tracked] += candidates.log_density[which[tracked]] - alone
        missed = 1.0 / self.settings.detection_probability - 1.0
        odds = missed * self.density[sensor] * np.exp(-log_density)
        total: Any = np.bincount(which, odds, minlength=len(candidates))
        return np.asarray(total, dtype=np.float64)

    @property
    def density(self) -> Array:
        """Return how dense unexplained peaks are, over where the peaks lie, shape (S,) [1/px]."""
        place, count = self.peaks.position_px, self.peaks.count
        last = place[np.arange(len(place)), np.maximum(count - 1, 0)]
        with np.errstate(divide="ignore", invalid="ignore"):
            density = self.unexplained * (count - 1) / ((last - place[:, 0]) * (count + 1))
        return np.where(count >= 3, density, self.settings.clutter_density_per_px)


def log_misfit_density(misfit_density: MisfitDensity) -> float:
    """Return the log density of wrong misfits at zero over that of noise."""
    # Where nothing was counted nothing was tried, and the figure is not used.
    return max(misfit_density.log_density() + _LOG_ROOT_TWO_PI, _MIN_LOG_DENSITY)
