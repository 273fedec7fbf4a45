"""Candidates for predicted points: a track's prediction as one more observation."""

from dataclasses import dataclass, replace
from math import log, pi
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements
from compute.reconstruction.correspondence.candidates import (
    FALSE_REJECTION,
    Candidates,
    MisfitDensity,
    Solve,
    solve_combinations,
)
from compute.reconstruction.correspondence.incremental import (
    extend_with_gated_peaks,
    find_gated_peaks,
)
from compute.reconstruction.triangulation import chi2_limit, squared_distances

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_MIN_SENSORS: Final = 3


@dataclass(frozen=True, eq=False)
class PredictedPoints:
    """Predicted positions of markers, from their tracks.

    Args:
        position_mm: shape (T, 3) [mm].
        covariance_mm2: shape (T, 3, 3) [mm^2], process noise included.

    Raises:
        InvalidParameter: shapes that do not fit, or values that are not finite.
    """

    position_mm: Array
    covariance_mm2: Array

    def __post_init__(self) -> None:
        count = len(self.position_mm)
        shapes = np.shape(self.position_mm), np.shape(self.covariance_mm2)
        if shapes != ((count, 3), (count, 3, 3)):
            raise InvalidParameter(
                f"predicted points have the shapes {shapes[0]} and {shapes[1]}; they must be "
                "(T, 3) and (T, 3, 3)"
            )
        if not (np.isfinite(self.position_mm).all() and np.isfinite(self.covariance_mm2).all()):
            raise InvalidParameter("a predicted point is not finite; leave it out")

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.position_mm)


def predicted_candidates(
    solve: Solve,
    model: MeasurementModel,
    peaks: Measurements,
    predicted: PredictedPoints,
    max_combinations: int,
    misfit_density: MisfitDensity,
) -> tuple[Candidates, int]:
    """Return the combinations of three or more peaks that may be a predicted point.

    A prediction is an observation of all three coordinates, so that three sensors' peaks have
    three degrees of freedom with it, and none without.

    Args:
        solve: triangulates readings.
        model: the measurement model.
        peaks: of the exposure, sorted.
        predicted: predicted points with their covariances.
        max_combinations: most combinations to reconstruct.
        misfit_density: counts the peaks in and beside the gates.

    Returns:
        The candidates, and how many combinations were cut.
    """
    free = peaks.usable
    position, covariance = predicted.position_mm, predicted.covariance_mm2
    gated = find_gated_peaks(
        model, peaks, free, position, covariance, (), misfit_density, len(position)
    )
    start = np.full((len(position), len(peaks)), -1)
    rows = np.flatnonzero((gated.count > 0).sum(axis=1) >= _MIN_SENSORS)
    choice, cut = extend_with_gated_peaks(start, gated, rows, _MIN_SENSORS, max_combinations)
    if len(choice) == 0:
        return Candidates.empty(len(peaks)), cut
    meets = solve_combinations(solve, peaks, np.unique(choice, axis=0)).candidates
    # Each of them for each prediction that it lies near.
    chi2, log_density = _distances(
        meets.position_mm[:, None] - position, meets.covariance_mm2[:, None] + covariance
    )
    dof = meets.dof + 3
    limits = np.array([chi2_limit(n_dof, FALSE_REJECTION) for n_dof in range(len(peaks) + 1)])
    row, point = np.nonzero(meets.chi2[:, None] + chi2 <= limits[dof][:, None])
    near = meets.rows(row)
    candidates = replace(
        near,
        chi2=near.chi2 + chi2[row, point],
        dof=near.dof + 3,
        predicted=point,
        log_density=log_density[row, point],
    )
    return candidates, cut


def log_prediction_density(
    candidates: Candidates, predicted: PredictedPoints, index: Indices
) -> Array:
    """Return the log of predicted points' densities at candidates, shape (C,) [1/mm^3].

    Args:
        candidates: C candidates.
        predicted: the points.
        index: which of them for each candidate, shape (C,).
    """
    away = candidates.position_mm - predicted.position_mm[index]
    return _distances(away, candidates.covariance_mm2 + predicted.covariance_mm2[index])[1]


def _distances(away_mm: Array, covariance_mm2: Array) -> tuple[Array, Array]:
    """Return chi2 of differences (..., 3) and the log of their densities, shape (...)."""
    chi2 = squared_distances(away_mm, covariance_mm2)
    log_volume = 3.0 * log(2.0 * pi) + np.log(np.linalg.det(covariance_mm2))
    return chi2, -0.5 * (log_volume + chi2)
