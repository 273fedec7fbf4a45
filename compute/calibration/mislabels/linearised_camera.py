"""A linearised camera and explanations of its readings worked out in it."""

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
"""Pairs of readings, in both orders, that are worked out at a time: bounds the memory."""


@dataclass(frozen=True, eq=False)
class LinearisedCamera:
    """A camera linearised at a solution, over the n readings that the sensor has.

    Args:
        basis: orthonormal columns that span J over sigma, shape (n, width).
        fitted: what the camera reads, shape (n,) [px].
        readings: what the sensor read, shape (n,) [px].
        sigma: deviations, shape (n,) [px].
        evidence: of the explanations.
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
        """Where the pairs are in a flattened (n, n)."""
        first, second = self.pairs
        return np.asarray(first * len(self.readings) + second)

    @cached_property
    def changes(self) -> Array:
        """What a reading in place of another's adds there [deviations], shape (n, n).

        The row is the place, the column the reading that comes.
        """
        return np.asarray((self.readings - self.readings[:, None]) / self.sigma[:, None])

    @cached_property
    def cross_terms(self) -> Array:
        """Minus twice the product of both changes of a pair, shape (n, n)."""
        return np.asarray(-2.0 * self.changes * self.changes.T)

    @cached_property
    def batch_size(self) -> int:
        """Explanations whose pairs are worked out at a time."""
        return max(MAX_PAIRS_PER_BATCH // len(self.readings) ** 2, 1)

    @cached_property
    def workspace(self) -> Array:
        """Memory for that, twice (together, n, n): asked for anew it takes longer than the work."""
        return np.empty((2, self.batch_size, len(self.readings), len(self.readings)))


@dataclass(frozen=True, eq=False)
class EvaluatedHypotheses:
    """Explanations worked out: their residuals, squares, determinants.

    ``basis`` is of what is kept, (B, n, width), and ``gain`` @ its transpose the hat matrix;
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
    """Work explanations out one by one, each by its own normal equations."""
    n = len(camera.readings)
    repaired = [h.repair(camera.readings, camera.sigma) for h in hypotheses]
    readings = np.array([one for one, _ in repaired]).reshape(-1, n)
    sigma = np.array([one for _, one in repaired]).reshape(-1, n)
    kept = np.isfinite(readings)
    # The basis holds J over the deviation at its first place; one that moved keeps its reading's.
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
    """Return the logarithms of the explanations' chances before looking, shape (B,)."""
    return np.array([h.log_prior(len(camera.readings), 0) for h in hypotheses])


def log_posteriors(camera: LinearisedCamera, states: EvaluatedHypotheses) -> Array:
    """Return the log posterior of each but for a constant, (B,); -inf where too little is kept."""
    likelihood = camera.evidence.log_likelihood(
        states.chi2,
        states.kept,
        states.log_determinant,
        states.log_sigma,
        np.array([len(h.wrong) for h in states.hypotheses]),
    )
    score = likelihood + log_priors(camera, states.hypotheses)
    return np.where(states.kept > camera.evidence.parameters, score, -np.inf)
