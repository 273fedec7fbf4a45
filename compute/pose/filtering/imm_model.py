"""ImmModel: transition and noise matrices of a tool under each motion mode."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.pose.filtering.pose_filter import (
    ANGULAR_VELOCITY,
    POSITION,
    ROTATION,
    STATES,
    VELOCITY,
)
from compute.pose.settings import ImmSettings, MotionSettings

Array = NDArray[np.float64]

IMM_STATES: Final = STATES + 6
"""The states of PoseState, then acceleration and angular acceleration."""
_STATE_CHAINS: Final = (
    (POSITION, VELOCITY, slice(12, 15)),
    (ROTATION, ANGULAR_VELOCITY, slice(15, 18)),
)
_POWERS: Final = 5
_POWER: Final = np.arange(1, _POWERS + 1)
_WHITE_JERK_DIVISORS: Final = np.array([[20.0, 8.0, 6.0], [8.0, 3.0, 2.0], [6.0, 2.0, 1.0]])
"""Of pose, rate and acceleration: what density and power of the time are divided by (Bar-Shalom,
Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 6.2)."""


@dataclass(frozen=True, eq=False)
class ImmModel:
    """K modes of motion over the 18 states of a pose, its velocities and its accelerations.

    Those in which accelerations do not last hold zeros in their place: so one transition does for
    all of them.

    Args:
        mean_sojourn_s: time that a tool keeps to a mode, in the mean [s].
        constant_velocity: 1 for modes whose accelerations do not last, 0 for the others, shape
            (K,).
        state_mask: 1 for the states that a mode has, 0 for the others, shape (K, 18).
        initial_covariance: covariance of lasting accelerations at first, shape (K, 18, 18).
        noise_terms: what a time adds to the covariance, by powers of the time from 1 to 5,
            shape (5, K * 18 * 18).
    """

    mean_sojourn_s: float
    constant_velocity: Array
    state_mask: Array
    initial_covariance: Array
    noise_terms: Array

    @classmethod
    def of(cls, motion: MotionSettings, settings: ImmSettings) -> "ImmModel":
        """Return the model of these accelerations and modes; it is kept."""
        return _model_of(motion, settings)

    def __len__(self) -> int:
        """Return the number of modes."""
        return len(self.constant_velocity)

    def transition_probabilities(self, step_s: float) -> Array:
        """Return the chances to go from a mode (row) to another over a time, shape (K, K).

        Changes are a Poisson process, to every other mode alike: a Markov chain in continuous
        time.
        """
        count = len(self)
        switch_probability = self.switch_probability(step_s)
        probabilities = np.full((count, count), switch_probability)
        probabilities.flat[:: count + 1] = 1.0 - (count - 1) * switch_probability
        return probabilities

    def switch_probability(self, step_s: float) -> float:
        """Return the chance to go from one mode to a certain other one over a time."""
        count = len(self)
        if count == 1:
            return 0.0
        return float(-np.expm1(-count / (count - 1) * step_s / self.mean_sojourn_s) / count)

    def process_noise(self, step_s: float, mode_probabilities: Array | None = None) -> Array:
        """Return what a time adds to the covariance of each mode, shape (K, 18, 18).

        Args:
            step_s: the time [s].
            mode_probabilities: of each mode, shape (K,): the mean of all is returned, shape (18,
                18).
        """
        found: Array = step_s**_POWER @ self.noise_terms
        if mode_probabilities is None:
            return found.reshape(-1, IMM_STATES, IMM_STATES)
        return (mode_probabilities @ found.reshape(len(mode_probabilities), -1)).reshape(
            IMM_STATES, IMM_STATES
        )


@lru_cache(maxsize=16)
def _model_of(motion: MotionSettings, settings: ImmSettings) -> ImmModel:
    count = len(settings.modes)
    constant_velocity = np.array(
        [one.manoeuvre_time_constant_s is None for one in settings.modes], dtype=np.float64
    )
    state_mask = np.ones((count, IMM_STATES))
    state_mask[constant_velocity > 0.0, STATES:] = 0.0
    initial_covariance = np.zeros((count, IMM_STATES, IMM_STATES))
    noise_terms = np.zeros((_POWERS, count, IMM_STATES, IMM_STATES))
    sizes = motion.acceleration_mm_s2, motion.angular_acceleration_rad_s2
    for index, one in enumerate(settings.modes):
        for parts, size in zip(_STATE_CHAINS, sizes, strict=True):
            variance = (one.acceleration_fraction * size) ** 2
            if one.manoeuvre_time_constant_s is None:
                _add_white_noise(
                    noise_terms[:, index],
                    parts[:2],
                    2.0 * variance * motion.manoeuvre_time_constant_s,
                )
            else:
                _add_white_noise(
                    noise_terms[:, index], parts, 2.0 * variance / one.manoeuvre_time_constant_s
                )
                np.fill_diagonal(initial_covariance[index, parts[2], parts[2]], variance)
    return ImmModel(
        settings.mean_sojourn_s,
        constant_velocity,
        state_mask,
        initial_covariance,
        noise_terms.reshape(_POWERS, -1),
    )


def _add_white_noise(noise_terms: Array, parts: tuple[slice, ...], density: float) -> None:
    """Write what white noise of the last of the parts' changes adds, by powers of the time."""
    count = len(parts)
    divisor = _WHITE_JERK_DIVISORS[3 - count :, 3 - count :]
    for i, first in enumerate(parts):
        for j, second in enumerate(parts):
            power = 2 * count - 1 - i - j
            np.fill_diagonal(noise_terms[power - 1, first, second], density / divisor[i, j])
