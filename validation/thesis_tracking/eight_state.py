"""8-state model of [6.11] with its Kalman filter over points in space; section 6.3."""

from dataclasses import dataclass, replace
from math import isfinite
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.tracking.motion_model import ca_transition, cv_transition

Array = NDArray[np.float64]

STATE_SIZE: Final = 8
"""X, Y, Z, their velocities, and the accelerations along X and Y."""

_POSITION: Final = slice(0, 3)
_VELOCITY: Final = slice(3, 6)
_ACCELERATION: Final = slice(6, 8)


@dataclass(frozen=True)
class EightStateModel:
    """Constant acceleration along X and Y, constant velocity along Z: [6.11].

    The text names 8 states as the least "if two accelerations are added". What drives them it
    leaves open ([6.1] has white noise w): here the accelerations along X and Y change by white
    jerk and the velocity along Z by white acceleration. The model is not the same in all
    directions: a target that accelerates along Z is followed late.

    Args:
        acceleration_psd: spectral density of the acceleration along Z [mm^2/s^3], above zero.
        jerk_psd: spectral density of the jerk along X and Y [mm^2/s^5], above zero.

    Raises:
        InvalidParameter: a value outside its range.
    """

    acceleration_psd: float = 1e4
    jerk_psd: float = 1e8

    def __post_init__(self) -> None:
        for name in ("acceleration_psd", "jerk_psd"):
            value = getattr(self, name)
            if not (isfinite(value) and value > 0.0):
                raise InvalidParameter(
                    f"{name} is {value}; it must be above zero and finite", **{name: value}
                )

    @staticmethod
    def transition(interval_s: float) -> Array:
        """Return F of [6.11], shape (8, 8)."""
        matrix = np.eye(STATE_SIZE)
        matrix[_POSITION, _VELOCITY] = interval_s * np.eye(3)
        matrix[:2, _ACCELERATION] = interval_s**2 / 2.0 * np.eye(2)
        matrix[3:5, _ACCELERATION] = interval_s * np.eye(2)
        return matrix

    def noise(self, interval_s: float) -> Array:
        """Return the covariance that an interval adds, shape (8, 8): white noise, integrated."""
        by_jerk = ca_transition(interval_s, self.jerk_psd)[1]
        by_acceleration = cv_transition(interval_s, self.acceleration_psd)[1][:2, :2]
        matrix = np.zeros((STATE_SIZE, STATE_SIZE))
        for axis in range(2):
            own = [axis, 3 + axis, 6 + axis]
            matrix[np.ix_(own, own)] = by_jerk
        matrix[np.ix_([2, 5], [2, 5])] = by_acceleration
        return matrix


@dataclass(frozen=True, eq=False)
class EightState:
    """What is known of a target: a normal distribution of its eight states.

    Args:
        mean: X, Y, Z [mm], their velocities [mm/s], accelerations along X and Y [mm/s^2], (8,).
        covariance: shape (8, 8).
    """

    mean: Array
    covariance: Array

    @classmethod
    def at(
        cls,
        position_mm: Array,
        covariance_mm2: Array,
        velocity_deviation: float,
        acceleration_deviation: float,
    ) -> Self:
        """Return the state of a target that was seen once.

        Args:
            position_mm: shape (3,).
            covariance_mm2: shape (3, 3).
            velocity_deviation: standard deviation of the unknown velocity about zero [mm/s].
            acceleration_deviation: that of the accelerations [mm/s^2].
        """
        covariance = np.zeros((STATE_SIZE, STATE_SIZE))
        covariance[_POSITION, _POSITION] = covariance_mm2
        covariance[_VELOCITY, _VELOCITY] = velocity_deviation**2 * np.eye(3)
        covariance[_ACCELERATION, _ACCELERATION] = acceleration_deviation**2 * np.eye(2)
        return cls(np.concatenate([position_mm, np.zeros(5)]), covariance)

    @property
    def position_mm(self) -> Array:
        """Shape (3,)."""
        return self.mean[_POSITION]

    @property
    def velocity_mm_s(self) -> Array:
        """Shape (3,)."""
        return self.mean[_VELOCITY]

    @property
    def acceleration_mm_s2(self) -> Array:
        """Along X, Y and Z, shape (3,); NaN along Z, which the model has not."""
        return np.append(self.mean[_ACCELERATION], np.nan)

    def predicted(self, model: EightStateModel, interval_s: float) -> Self:
        """Return the state an interval later."""
        transition = model.transition(interval_s)
        covariance = transition @ self.covariance @ transition.T + model.noise(interval_s)
        return replace(self, mean=transition @ self.mean, covariance=covariance)

    def updated(self, position_mm: Array, covariance_mm2: Array) -> tuple[Self, float]:
        """Return the state by a reconstructed point, and the normalised innovation squared.

        Args:
            position_mm: shape (3,).
            covariance_mm2: shape (3, 3).
        """
        innovation = position_mm - self.mean[_POSITION]
        spread = self.covariance[_POSITION, _POSITION] + covariance_mm2
        weighted = np.linalg.solve(spread, innovation)
        gain = np.linalg.solve(spread, self.covariance[_POSITION]).T
        # Joseph's form keeps the covariance positive.
        kept = np.eye(STATE_SIZE)
        kept[:, _POSITION] -= gain
        covariance = kept @ self.covariance @ kept.T + gain @ covariance_mm2 @ gain.T
        state = replace(self, mean=self.mean + gain @ innovation, covariance=covariance)
        return state, float(innovation @ weighted)
