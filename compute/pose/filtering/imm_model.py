"""ImmModel: transition and noise matrices of a tool under each motion model."""

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
"""Divisors of density times power of the time, for pose, rate and acceleration (Bar-Shalom, Li,
Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 6.2)."""


@dataclass(frozen=True, eq=False)
class ImmModel:
    """K motion models over the 18 states of a pose, its velocities and its accelerations.

    Models without persistent accelerations hold zeros in their place, so that one transition
    matrix serves all models.

    Args:
        mean_sojourn_s: mean time in one motion model [s].
        constant_velocity: 1 for models without persistent accelerations, else 0, shape (K,).
        state_mask: 1 for the states that a model has, else 0, shape (K, 18).
        initial_covariance: initial covariance of persistent accelerations, shape (K, 18, 18).
        noise_terms: process noise by powers of the time step from 1 to 5,
            shape (5, K * 18 * 18).
    """

    mean_sojourn_s: float
    constant_velocity: Array
    state_mask: Array
    initial_covariance: Array
    noise_terms: Array

    @classmethod
    def of(cls, motion: MotionSettings, settings: ImmSettings) -> "ImmModel":
        """Return the model of these settings; it is cached.

        Args:
            motion: RMS accelerations.
            settings: the motion models.
        """
        return _model_of(motion, settings)

    def __len__(self) -> int:
        """Return the number of motion models."""
        return len(self.constant_velocity)

    def transition_probabilities(self, step_s: float) -> Array:
        """Return the probabilities of model switches (row to column) over a time, shape (K, K).

        A Markov chain in continuous time: switches are a Poisson process, equally likely to every
        other model.
        """
        count = len(self)
        switch_probability = self.switch_probability(step_s)
        probabilities = np.full((count, count), switch_probability)
        probabilities.flat[:: count + 1] = 1.0 - (count - 1) * switch_probability
        return probabilities

    def switch_probability(self, step_s: float) -> float:
        """Return the probability of a switch to one particular other model over a time."""
        count = len(self)
        if count == 1:
            return 0.0
        return float(-np.expm1(-count / (count - 1) * step_s / self.mean_sojourn_s) / count)

    def process_noise(self, step_s: float, mode_probabilities: Array | None = None) -> Array:
        """Return the process noise of each model over a time step, shape (K, 18, 18).

        Args:
            step_s: the time step [s].
            mode_probabilities: probability of each model, shape (K,): the weighted mean of all is
                returned, shape (18, 18).
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
    """Add white noise in the derivative of the last of the parts, by powers of the time step."""
    count = len(parts)
    divisor = _WHITE_JERK_DIVISORS[3 - count :, 3 - count :]
    for i, first in enumerate(parts):
        for j, second in enumerate(parts):
            power = 2 * count - 1 - i - j
            np.fill_diagonal(noise_terms[power - 1, first, second], density / divisor[i, j])
