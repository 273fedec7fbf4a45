"""Refinement of the bars' clock errors by the readings of markers that move.

What a network tells of a clock is good to some tens of microseconds, in which a marker of 2 m/s
moves as far as its point is uncertain. But eight readings of a point check one another, and a bar
that is timed wrongly is off along all of its markers' motions: the error is estimated by a Kalman
filter with one state a bar, which returns to what the network says while nothing moves. The errors
of the calibration are the same in all frames, so that averaging does not remove them: their share
is carried along and not estimated (S. F. Schmidt, 1966; a "consider" filter).

Temporal calibration of sensors by what they measure: J. Kelly, G. S. Sukhatme, "A general framework
for temporal calibration of multiple proprioceptive and exteroceptive sensors", 2014,
10.1007/978-3-642-28572-1_14.
"""

from dataclasses import dataclass
from math import exp, inf
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.fusion.clock_errors import ClockSensitivity
from compute.parameter_checks import require

Array = NDArray[np.float64]

CORRELATION_S: Final = 60.0
"""Time constant with which a clock's error forgets what it was."""
MAX_SIGMA: Final = 4.0
"""An estimate beyond this many standard deviations of what is stated contradicts it."""


@dataclass(frozen=True, eq=False)
class ClockEstimate:
    """Errors of B clocks.

    Args:
        error_s: shape (B,) [s].
        covariance_s2: shape (B, B) [s^2].
        contradicted: which are farther from zero than their stated uncertainty allows, shape (B,).
    """

    error_s: Array
    covariance_s2: Array
    contradicted: NDArray[np.bool_]


class ClockRefinement:
    """Estimates the errors of B clocks from points of all bars.

    Args:
        sigma_s: stated standard deviation of each clock's error, B of them [s].
        correlation_s: time constant of the errors [s].

    Raises:
        InvalidParameter: a standard deviation is negative or not finite, or the time constant is
            not positive.
    """

    def __init__(self, sigma_s: Array, correlation_s: float = CORRELATION_S) -> None:
        require(0.0 < correlation_s < inf, "be positive and finite", correlation_s=correlation_s)
        self._correlation_s = correlation_s
        self._error = np.zeros(len(sigma_s))
        self._covariance = np.zeros((len(sigma_s), len(sigma_s)))
        self._common = np.zeros((len(sigma_s), 0))
        self._stated = np.zeros(len(sigma_s))
        self.set_sigma(sigma_s)
        self._covariance = np.diag(self._stated**2)

    def set_sigma(self, sigma_s: Array) -> None:
        """Take what is stated of the clocks from now on, shape (B,) [s]; raises as the class."""
        for sigma in sigma_s.tolist():
            require(0.0 <= sigma < inf, "be 0 or more and finite", sigma_s=sigma)
        self._stated = np.array(sigma_s, dtype=np.float64)

    @property
    def estimate(self) -> ClockEstimate:
        """The errors now, the calibration's share in their covariance."""
        covariance = self._covariance + self._common @ self._common.T
        # Never worse than what is stated, which no reading has touched.
        sigma = np.sqrt(np.diagonal(covariance))
        ratio = np.minimum(1.0, self._stated / np.where(sigma > 0.0, sigma, 1.0))
        covariance = covariance * ratio[:, None] * ratio
        contradicted = np.abs(self._error) > MAX_SIGMA * np.hypot(self._stated, sigma)
        return ClockEstimate(self._error.copy(), covariance, contradicted)

    def predict(self, elapsed_s: float) -> None:
        """Let time pass since the last call [s]: the errors go back to what is stated."""
        kept = exp(-max(elapsed_s, 0.0) / self._correlation_s)
        self._error = kept * self._error
        self._common = kept * self._common
        self._covariance = kept**2 * self._covariance + (1.0 - kept**2) * np.diag(self._stated**2)

    def update(self, sensitivity: ClockSensitivity, applied_s: Array) -> None:
        """Learn from points of all bars.

        From many at once, some tenths of a second of them: the noise of rates gives each point of a
        marker at rest information that it has not, which only the sum over many does without.

        Args:
            sensitivity: of N points, with the common errors.
            applied_s: clock errors that are taken out of the readings already, shape (B,) [s].
        """
        noise = sensitivity.information.sum(axis=0)
        slope = noise - np.diag(sensitivity.by_noise.sum(axis=0))
        # The score has the mean ``slope @ error`` and the covariance ``noise``.
        weight = slope @ np.linalg.pinv(noise, hermitian=True)
        information = weight @ slope
        score = weight @ (sensitivity.score.sum(axis=0) + slope @ applied_s)
        bars = len(self._error)
        self._covariance = np.linalg.solve(
            np.eye(bars) + self._covariance @ information, self._covariance
        )
        self._covariance = 0.5 * (self._covariance + self._covariance.T)
        self._error = self._error + self._covariance @ (score - information @ self._error)
        common = weight @ sensitivity.common.sum(axis=0)
        if self._common.shape[1] != common.shape[1]:
            # Another calibration: its errors are others.
            self._common = np.zeros(common.shape)
        kept = np.eye(bars) - self._covariance @ information
        self._common = kept @ self._common + self._covariance @ common
