"""Reliability of least squares (Baarda): normalised residuals and detectable errors."""

from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, chndtrinc

Array = NDArray[np.float64]

POWER: Final = 0.8
"""Probability of finding an error of the size that is called detectable."""
ACCEPTANCE_SIGNIFICANCE: Final = 0.01
"""Probability that correct readings are refused once others were left out: more is asked of them
than where nothing was wrong."""
REDUNDANCY_FLOOR: Final = 1e-3
"""Smallest redundancy number at which a residual is tested; below it nothing checks a reading."""


@cache
def noncentrality(dof: int, significance: float) -> float:
    """Return the non-centrality at which a chi-square test rejects with probability POWER.

    Baarda's lambda_0; its root is the size of an error, in standard deviations of its own
    estimate, that the test finds (W. Baarda, "A testing procedure for use in geodetic networks",
    1968).

    Args:
        dof: degrees of freedom; below 1 it is infinite.
        significance: probability that the test rejects correct data.
    """
    if dof < 1:
        return float("inf")
    return float(chndtrinc(chdtri(dof, significance), dof, 1.0 - POWER))


@dataclass(frozen=True, eq=False)
class ReadingChecks:
    """Internal reliability of n readings in N adjustments of p unknowns.

    Args:
        normalised: Baarda's w, residuals over their own standard deviations with the readings'
            correlation, shape (N, n); 0 where nothing checks the reading.
        redundancy: share of an error of the reading that the others reveal, 0 to 1, shape (N, n).
        sigma_px: standard deviation of an error of the reading as the others estimate it, shape
            (N, n) [px]; infinite where nothing checks it.
        influence: change of the unknowns by an error of the reading, shape (N, p, n) [1/px].
    """

    normalised: Array
    redundancy: Array
    sigma_px: Array
    influence: Array

    def detectable_px(self, noncentrality: float | Array) -> Array:
        """Return the minimal detectable bias of each reading, shape (N, n) [px].

        Args:
            noncentrality: of the test, a number or of shape (N, 1).
        """
        size: Array = np.sqrt(noncentrality) * self.sigma_px
        return size


def check_readings(jacobian: Array, residual_px: Array, whitening: Array) -> ReadingChecks:
    """Test each reading against the others at the solution of a least-squares adjustment.

    With the covariance S of the readings, ``Q = S^-1 - S^-1 J (J' S^-1 J)^-1 J' S^-1`` and the
    residuals v: ``w_i = (S^-1 v)_i / sqrt(Q_ii)`` and ``sigma_i = 1 / sqrt(Q_ii)``; for readings
    that are not correlated this is ``v_i / (sigma sqrt(r_i))`` with the redundancy numbers r_i.

    Args:
        jacobian: of the residuals by the unknowns, up to the sign, shape (N, n, p); zeros for
            readings that are not used.
        residual_px: shape (N, n) [px]; zeros for readings that are not used.
        whitening: W with ``W S W' = 1``, shape (N, n, n) [1/px].
    """
    design = whitening @ jacobian
    transposed = design.swapaxes(-1, -2)
    influence: Array = np.asarray(
        np.linalg.solve(transposed @ design, transposed @ whitening), dtype=np.float64
    )
    # (1 - H) W with the projector H: the squares of a column sum up to Q_ii.
    rest = whitening - design @ influence
    precision = (rest**2).sum(axis=-2)
    redundancy = precision / (whitening**2).sum(axis=-2)
    checked = redundancy > REDUNDANCY_FLOOR
    whitened = whitening @ residual_px[..., None]
    sigma = np.full(precision.shape, np.inf)
    sigma[checked] = 1.0 / np.sqrt(precision[checked])
    normalised = np.where(
        checked, (rest * whitened).sum(axis=-2) * np.where(checked, sigma, 0.0), 0.0
    )
    return ReadingChecks(normalised, redundancy, sigma, influence)
