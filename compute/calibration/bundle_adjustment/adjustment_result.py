"""AdjustmentResult: solution of a bundle adjustment with the covariance of its parameters."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.calibration.bundle_adjustment.normal_equations import (
    AdjustmentState,
    ReducedEquations,
    build_normal_equations,
)
from compute.calibration.bundle_adjustment.parameter_covariance import (
    check_poses,
    global_covariance,
)
from compute.calibration.bundle_adjustment.pose_set import PoseSet
from compute.calibration.bundle_adjustment.robust_loss import loss_weights, total_loss
from compute.calibration.bundle_adjustment.sensor_prior import SensorPrior
from compute.camera.model import SensorModel

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class AdjustmentResult:
    """Least-squares (or robust) estimate of sensors, shapes and poses.

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
        """Return the covariances of one set's poses, the sensors' uncertainty included.

        Shape (B, d, d), in the order of a pose's unknowns: rotations [rad], then translation [mm].
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


def assemble_result(
    state: AdjustmentState,
    residuals: Sequence[Array],
    prior: SensorPrior | None,
    adjusted_parameters: NDArray[np.bool_],
    *,
    limit: float,
    free_datum: bool,
    iterations: int,
) -> AdjustmentResult:
    """Return the result of an adjustment with its covariance and statistics.

    Args:
        state: the solution.
        residuals: over sigma, shape (B, K, S) for each pose set.
        prior: of the sensors' parameters, or None.
        adjusted_parameters: which globals were adjusted, shape (F,).
        limit: Huber's limit of the loss; inf: least squares.
        free_datum: see ``adjust``.
        iterations: number of trial steps.

    Raises:
        UndeterminedParameters: the readings do not determine a pose or a combination of
            parameters.
    """
    weights = loss_weights(residuals, limit)
    equations = build_normal_equations(state, weights, prior)
    check_poses(state, equations)
    reduced = equations.reduced()
    noise_equations = None
    if any((one < 1.0).any() for one in weights):
        variances = [np.where(one < 1.0, limit**2, 1.0) for one in weights]
        noise_equations = build_normal_equations(state, variances, prior)
    covariance = global_covariance(state, reduced, adjusted_parameters, free_datum, noise_equations)
    full = [(one >= 1.0) & poses.seen for one, poses in zip(weights, state.pose_sets, strict=True)]
    chi2 = total_loss(
        state,
        [np.where(use, one, 0.0) for use, one in zip(full, residuals, strict=True)],
        prior,
        np.inf,
    )
    known = sum(int(use.sum()) for use in full)
    for poses in state.pose_sets:
        known += len(poses.shape.equations()[0]) + (3 * len(poses) if poses.prior() else 0)
    if prior is not None:
        known += int(np.linalg.matrix_rank(prior.information, hermitian=True))
    unknown = int(adjusted_parameters.sum()) - (6 if free_datum else 0)
    unknown += sum(len(poses) * poses.unknowns for poses in state.pose_sets)
    return AdjustmentResult(
        state.models,
        state.pose_sets,
        covariance,
        tuple(
            np.where(poses.seen, one, np.nan)
            for poses, one in zip(state.pose_sets, residuals, strict=True)
        ),
        tuple(weights),
        chi2,
        known - unknown,
        iterations,
        reduced,
    )
