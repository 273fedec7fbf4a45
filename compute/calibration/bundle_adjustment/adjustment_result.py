"""AdjustmentResult: what an adjustment ends with, with the covariance of everything in it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.normal_equations import ReducedEquations
from compute.calibration.bundle_adjustment.pose_set import PoseSet
from compute.camera.model import SensorModel

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class AdjustmentResult:
    """Sensors, shapes and poses that fit the readings best.

    Args:
        models: the sensors.
        pose_sets: the poses, with their shapes.
        global_covariance: of the sensors' parameters, in the order of
            ``SensorModel.parameter_names``, then of the shapes' unknowns, shape (F, F). For the
            readings' standard deviations as given; held parameters are 0.
        residuals: (fitted - read) / sigma of each set, (B, K, S); NaN where not seen.
        weights: 1, and less for readings beyond the robust loss's limit, (B, K, S).
        chi2: sum of squared residuals, of those that count fully, with the priors'.
        dof: readings that count fully, and priors, less unknowns.
        iterations: steps that were tried.
    """

    models: tuple[SensorModel, ...]
    pose_sets: tuple[PoseSet, ...]
    global_covariance: Array
    residuals: tuple[Array, ...]
    weights: tuple[Array, ...]
    chi2: float
    dof: int
    iterations: int
    _reduced: ReducedEquations

    @property
    def sensor_covariance(self) -> Array:
        """Joint covariance of the sensors' parameters, shape (P, P)."""
        count = sum(model.parameter_count for model in self.models)
        return self.global_covariance[:count, :count]

    def eliminated(self, index: int = 0) -> tuple[Array, Array]:
        """Return V^-1 (B, d, d) and V^-1 W' (B, d, F) of one set's normal equations."""
        return self._reduced.inverses[index], self._reduced.back_substitution[index]

    def pose_covariance(self, index: int = 0) -> Array:
        """Return the covariances of one set's poses, the sensors' part included, (B, d, d).

        In the order of a pose's unknowns: its turns, then its translation [mm].
        """
        carried = self._reduced.back_substitution[index]
        covariance: Array = self._reduced.inverses[index] + np.einsum(
            "bif,fg,bjg->bij", carried, self.global_covariance, carried, optimize=True
        )
        return covariance

    def pose_sensor_covariance(self, index: int = 0) -> Array:
        """Return the covariances between one set's poses and the globals, shape (B, d, F)."""
        carried: Array = -self._reduced.back_substitution[index] @ self.global_covariance
        return carried

    def marker_covariance(self, index: int = 0) -> Array:
        """Return the covariances of one set's markers, shape (B, K, 3, 3) [mm^2].

        Of the pose only: a shape's own uncertainty is left out.
        """
        slopes = self.pose_sets[index].marker_jacobian()
        covariance: Array = np.einsum(
            "bkid,bde,bkje->bkij", slopes, self.pose_covariance(index), slopes, optimize=True
        )
        return covariance
