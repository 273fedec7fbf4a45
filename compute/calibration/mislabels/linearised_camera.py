"""LinearisedCamera: label-error hypotheses evaluated in closed form."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.mislabels.hypothesis import Hypothesis
from compute.calibration.mislabels.marginal_likelihood import Evidence

Array = NDArray[np.float64]

MAX_PAIRS_PER_BATCH: Final = 90_000
"""Largest number of ordered pairs of readings evaluated at a time; bounds the memory."""


@dataclass(frozen=True, eq=False)
class LinearisedCamera:
    """A camera linearised at a solution, over the n readings of a sensor.

    Args:
        basis: orthonormal columns that span J over sigma, shape (n, width).
        fitted: readings that the camera predicts, shape (n,) [px].
        readings: readings of the sensor, shape (n,) [px].
        sigma: standard deviations, shape (n,) [px].
        evidence: marginal likelihood of hypotheses.
    """

    basis: Array
    fitted: Array
    readings: Array
    sigma: Array
    evidence: Evidence

    @cached_property
    def pairs(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """All pairs of readings, the lower one first."""
        first, second = np.triu_indices(len(self.readings), 1)
        return first, second

    @cached_property
    def flat_pairs(self) -> NDArray[np.intp]:
        """Indices of the pairs in a flattened (n, n)."""
        first, second = self.pairs
        return np.asarray(first * len(self.readings) + second)

    @cached_property
    def changes(self) -> Array:
        """Change of a normalised residual when another point's reading is put there, shape (n, n).

        Row: the point; column: the reading that is put there.
        """
        return np.asarray((self.readings - self.readings[:, None]) / self.sigma[:, None])

    @cached_property
    def cross_terms(self) -> Array:
        """Minus twice the product of both changes of a pair, shape (n, n)."""
        return np.asarray(-2.0 * self.changes * self.changes.T)

    @cached_property
    def batch_size(self) -> int:
        """Number of hypotheses whose pairs are evaluated at a time."""
        return max(MAX_PAIRS_PER_BATCH // len(self.readings) ** 2, 1)

    @cached_property
    def workspace(self) -> Array:
        """Two work arrays of a batch, (batch, n, n) each; allocated once, as that takes long."""
        return np.empty((2, self.batch_size, len(self.readings), len(self.readings)))


@dataclass(frozen=True, eq=False)
class EvaluatedHypotheses:
    """B hypotheses with their residuals, sums of squares and determinants.

    ``basis`` is of the readings kept, (B, n, width), and ``gain`` @ its transpose the hat matrix;
    ``inverse`` is of the normal equations and ``theta`` their solution.
    """

    hypotheses: Sequence[Hypothesis]
    residual: Array
    basis: Array
    gain: Array
    inverse: Array
    theta: Array
    used: NDArray[np.bool_]
    chi2: Array
    kept: Array
    log_determinant: Array
    log_sigma: Array


def evaluate_hypotheses(
    camera: LinearisedCamera, hypotheses: Sequence[Hypothesis]
) -> EvaluatedHypotheses:
    """Evaluate hypotheses, each from its own normal equations.

    Args:
        camera: the linearised camera.
        hypotheses: B hypotheses.
    """
    n = len(camera.readings)
    repaired = [h.repair(camera.readings, camera.sigma) for h in hypotheses]
    readings = np.array([one for one, _ in repaired]).reshape(-1, n)
    sigma = np.array([one for _, one in repaired]).reshape(-1, n)
    kept = np.isfinite(readings)
    # The basis holds J over the sigma of the point's own reading, also where another was put.
    misfit = np.where(kept, np.where(kept, readings, 0.0) - camera.fitted, 0.0) / camera.sigma
    basis = camera.basis * kept[..., None]
    normal = basis.swapaxes(1, 2) @ basis
    inverse = np.linalg.inv(normal + 1e-12 * np.eye(camera.evidence.parameters))
    gain = basis @ inverse
    theta = (inverse @ (basis.swapaxes(1, 2) @ misfit[..., None]))[..., 0]
    residual = misfit - (basis @ theta[..., None])[..., 0]
    return EvaluatedHypotheses(
        hypotheses,
        residual,
        basis,
        gain,
        inverse,
        theta,
        kept,
        (residual**2).sum(axis=1),
        kept.sum(axis=1),
        np.linalg.slogdet(normal)[1],
        np.where(kept, np.log(sigma), 0.0).sum(axis=1),
    )


def log_priors(camera: LinearisedCamera, hypotheses: Sequence[Hypothesis]) -> Array:
    """Return the log prior probabilities, shape (B,).

    Args:
        camera: the linearised camera.
        hypotheses: B hypotheses.
    """
    return np.array([h.log_prior(len(camera.readings), 0) for h in hypotheses])


def log_posteriors(camera: LinearisedCamera, states: EvaluatedHypotheses) -> Array:
    """Return the unnormalised log posteriors, shape (B,); -inf with too few readings kept.

    Args:
        camera: the linearised camera.
        states: B evaluated hypotheses.
    """
    likelihood = camera.evidence.log_likelihood(
        states.chi2,
        states.kept,
        states.log_determinant,
        states.log_sigma,
        np.array([len(h.wrong) for h in states.hypotheses]),
    )
    score = likelihood + log_priors(camera, states.hypotheses)
    return np.where(states.kept > camera.evidence.parameters, score, -np.inf)
