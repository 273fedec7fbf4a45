"""BeamHoldLimits: limits of a patient's motion, and the probability of exceeding them."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.polynomial.hermite_e import hermegauss
from numpy.typing import NDArray
from scipy.special import ndtr

from compute.camera.model import Vector3
from compute.errors import InvalidParameter
from compute.pose.beam_hold.beam_hold_state import BeamHoldTiming

Array = NDArray[np.float64]

_AXES: Final = "xyz"
_NODES: Final = 32
_ABSCISSAE, _WEIGHTS = hermegauss(_NODES)
_PRODUCT_WEIGHTS: Final = np.outer(_WEIGHTS, _WEIGHTS) / _WEIGHTS.sum() ** 2
_CERTAIN_SIGMAS: Final = 8.0
"""Number of standard deviations beyond which a limit is certainly (1e-14) kept or exceeded."""


@dataclass(frozen=True)
class BeamHoldLimits:
    """Limits on the motion of a patient.

    Args:
        shift_mm: largest distance of the target, or of a marker, from its reference position
            [mm]; None: unlimited.
        axis_mm: largest shift along each axis [mm]; None: unlimited.
        rotation_rad: largest rotation [rad]; None: unlimited. Not for markers.
        probability: the beam is held when the probability of exceeding a limit is above this. 0.5
            ignores the uncertainty, smaller values hold earlier.
        release_fraction: fraction of the limits within which, at the same probability, a hold may
            end.
        rules: longest gap, settling time, latch.
    """

    shift_mm: float | None = None
    axis_mm: Vector3 | None = None
    rotation_rad: float | None = None
    probability: float = 0.05
    release_fraction: float = 0.8
    rules: BeamHoldTiming = field(default_factory=BeamHoldTiming)

    def __post_init__(self) -> None:
        limits = [self.shift_mm, self.rotation_rad, *(self.axis_mm or ())]
        given = [one for one in limits if one is not None]
        if not given or not all(one > 0.0 and np.isfinite(one) for one in given):
            raise InvalidParameter(
                f"the limits are shift {self.shift_mm}, axes {self.axis_mm}, turn "
                f"{self.rotation_rad}; "
                "give at least one, above 0"
            )
        if not 0.0 < self.probability <= 0.5:
            raise InvalidParameter(
                f"probability is {self.probability}; it must be above 0, at most 0.5"
            )
        if not 0.0 < self.release_fraction <= 1.0:
            raise InvalidParameter(
                f"release_fraction is {self.release_fraction}; it must be above 0, at most 1"
            )

    def beyond(
        self,
        shift_mm: Array,
        shift_covariance: Array | None,
        rotation_rad: Array | None = None,
        rotation_covariance: Array | None = None,
        share: float = 1.0,
    ) -> tuple[str | None, float]:
        """Return which limit is most probably exceeded, in words, and the probability.

        Args:
            shift_mm: shift from the reference position, shape (3,) [mm].
            shift_covariance: its covariance, shape (3, 3) [mm^2]; None: exact.
            rotation_rad: rotation vector from the reference, shape (3,) [rad]; None: not checked.
            rotation_covariance: its covariance, shape (3, 3) [rad^2]; None: exact.
            share: factor on the limits.

        Returns:
            The exceeded limit in words, None where no probability is above ``probability``; and the
            largest of the probabilities.
        """
        worst, message = -1.0, ""
        for probability, what in self._exceedance_probabilities(
            shift_mm, shift_covariance, rotation_rad, rotation_covariance, share
        ):
            if probability > worst:
                worst, message = probability, what
        if worst <= self.probability:
            return None, worst
        message = self._describe(message, shift_mm, rotation_rad, share)
        if worst < 0.5:
            message += f", with a probability of {worst:.0%} to be beyond it; "
            message += f"at most {self.probability:.0%}"
        return message, worst

    def _exceedance_probabilities(
        self,
        shift_mm: Array,
        shift_covariance: Array | None,
        rotation_rad: Array | None,
        rotation_covariance: Array | None,
        share: float,
    ) -> Iterator[tuple[float, str]]:
        """Yield the probability of being beyond ``share`` of each limit, and which that is."""
        if self.shift_mm is not None:
            yield (
                norm_exceedance_probability(shift_mm, shift_covariance, share * self.shift_mm),
                "shift",
            )
        for axis, most in enumerate(self.axis_mm or ()):
            variance = 0.0 if shift_covariance is None else float(shift_covariance[axis, axis])
            yield (
                scalar_exceedance_probability(float(shift_mm[axis]), variance, share * most),
                _AXES[axis],
            )
        if self.rotation_rad is not None and rotation_rad is not None:
            yield (
                norm_exceedance_probability(
                    rotation_rad, rotation_covariance, share * self.rotation_rad
                ),
                "turn",
            )

    def _describe(
        self, what: str, shift_mm: Array, rotation_rad: Array | None, share: float
    ) -> str:
        if what == "shift":
            size, limit = float(np.linalg.norm(shift_mm)), share * (self.shift_mm or 0.0)
            return f"{size:.2f} mm off its place (limit {limit:.2f} mm)"
        if what == "turn":
            size = float(np.linalg.norm(rotation_rad)) if rotation_rad is not None else 0.0
            limit = np.degrees(share * (self.rotation_rad or 0.0))
            return f"turned by {np.degrees(size):.2f} deg (limit {limit:.2f} deg)"
        axis = _AXES.index(what)
        most = share * (self.axis_mm or (0.0, 0.0, 0.0))[axis]
        return f"{shift_mm[axis]:.2f} mm off along {what} (limit {most:.2f} mm)"


def norm_exceedance_probability(mean: Array, covariance: Array | None, limit: float) -> float:
    """Return P(|x| > limit) of a normally distributed 3-vector x.

    Integrated in closed form along the axis of the largest variance, and by Gauss-Hermite
    quadrature along the other two: to 0.02 where the standard deviations are as large as the limit,
    far better where they are smaller.

    Args:
        mean: shape (3,).
        covariance: shape (3, 3); None: x is exact.
        limit: the limit, in the unit of the mean.
    """
    length = math.hypot(*mean.tolist())
    if covariance is None:
        return float(length > limit)
    # The trace bounds the largest variance and is much cheaper than the eigenvalues: it is checked
    # first. A short mean may be exceeded by deviations in all three directions together.
    reach = _CERTAIN_SIGMAS * math.sqrt(max(float(covariance.trace()), 0.0)) + 1e-12 * limit
    if length + reach < limit:
        return 0.0
    if length - reach > limit:
        return 1.0
    values, axes = np.linalg.eigh(covariance)
    sigma = np.sqrt(np.maximum(values, 0.0))
    if length - limit > _CERTAIN_SIGMAS * sigma[2] + 1e-12 * limit:
        return 1.0
    if not sigma[2] > 0.0:
        return float(length > limit)
    along = axes.T @ mean
    first = (along[0] + sigma[0] * _ABSCISSAE)[:, None]
    second = along[1] + sigma[1] * _ABSCISSAE
    square = limit**2 - first**2 - second**2
    half = np.sqrt(np.maximum(square, 0.0))
    inside = ndtr((half - along[2]) / sigma[2]) - ndtr((-half - along[2]) / sigma[2])
    return float(np.clip(1.0 - (_PRODUCT_WEIGHTS * inside).sum(), 0.0, 1.0))


def scalar_exceedance_probability(mean: float, variance: float, limit: float) -> float:
    """Return P(|x| > limit) of a normally distributed number x.

    Args:
        mean: mean of x.
        variance: its variance, 0 where x is exact.
        limit: the limit, in the unit of the mean.
    """
    if not variance > 0.0:
        return float(abs(mean) > limit)
    sigma = math.sqrt(variance)
    if abs(mean) + _CERTAIN_SIGMAS * sigma < limit:
        return 0.0
    return float(ndtr((mean - limit) / sigma) + ndtr((-mean - limit) / sigma))
