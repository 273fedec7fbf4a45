"""ErrorEstimate: probability that a group is wrong, besides that from competing sets."""

from dataclasses import dataclass
from math import log
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurements import Measurements
from compute.reconstruction.correspondence.candidates import (
    MAX_EXTENT_MM,
    Candidates,
    MatchSettings,
    MisfitDensity,
    Solve,
    UnexplainedPeaks,
    solve_combinations,
)
from compute.reconstruction.correspondence.predicted_candidates import (
    PredictedPoints,
    log_prediction_density,
)

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ErrorEstimate:
    """Error probabilities of groups, from a frame and its most probable set of markers.

    Args:
        solve: triangulates readings.
        peaks: of the frame.
        settings: the model.
        unexplained: peaks that the set does not explain.
        markers: number of markers in the set.
        predicted: predicted positions of markers; None: none.
    """

    solve: Solve
    peaks: Measurements
    settings: MatchSettings
    unexplained: UnexplainedPeaks
    markers: int
    predicted: PredictedPoints | None = None

    def error_probability(
        self, candidates: Candidates, misfit_density: MisfitDensity, predicted: MisfitDensity
    ) -> Array:
        """Return the error probabilities of the set's candidates, shape (C,).

        Args:
            candidates: the C candidates.
            misfit_density: of misfits between sensors.
            predicted: of misfits to predicted points.
        """
        error_probability: Array = self._expected_false_matches(
            candidates, misfit_density, predicted
        ) + self._foreign_peak_probability(candidates)
        # What may be anywhere fits everywhere, and proves nothing.
        error_probability[
            np.trace(candidates.covariance_mm2, axis1=1, axis2=2) > MAX_EXTENT_MM**2
        ] = 1.0
        return error_probability

    def _expected_false_matches(
        self, candidates: Candidates, misfit_density: MisfitDensity, predicted: MisfitDensity
    ) -> Array:
        """Return the expected numbers of wrong combinations that fit as well as these do.

        Were one wrong, its peaks would be unexplained as well: the more of those, the likelier.
        """
        settings = self.settings
        used = candidates.choice >= 0
        used_count = used.sum(axis=1)
        seeing = int((self.peaks.count > 0).sum())
        # A marker that these sensors saw, and the others not.
        true = (
            used_count * log(settings.detection_probability)
            + (seeing - used_count) * settings.log_missed
        )
        tracked = candidates.predicted >= 0
        # Three of the misfits are to the prediction, of which there is one.
        true += np.where(tracked, 0.0, log(self.markers))
        dof = np.where(tracked, candidates.dof - 3, candidates.dof)
        near = dof * misfit_density.log_ratio() + np.where(
            tracked, 3.0 * predicted.log_ratio(), 0.0
        )
        ways = used @ np.log(self.unexplained.expected)
        odds: Array = np.exp(np.minimum(ways - true + near + 0.5 * candidates.chi2, 0.0))
        return odds

    def _foreign_peak_probability(self, candidates: Candidates) -> Array:
        """Return the probabilities that one of a candidate's peaks is another marker's.

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
                fewer.candidates.rows(tracked), self.predicted, of[tracked]
            )
            log_density[tracked] += candidates.log_density[which[tracked]] - alone
        missed = 1.0 / self.settings.detection_probability - 1.0
        odds = missed * self.unexplained.density_per_px[sensor] * np.exp(-log_density)
        total: Any = np.bincount(which, odds, minlength=len(candidates))
        return np.asarray(total, dtype=np.float64)
