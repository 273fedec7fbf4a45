"""Motion models: constant velocity and constant acceleration, exact for any time step."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from compute.tracking.settings import TrackerSettings

Array = NDArray[np.float64]

STATE_SIZE = 9
"""Position, velocity and acceleration, x, y, z each."""


@dataclass(frozen=True)
class MotionModels:
    """M models of one marker's motion, over the same nine states.

    Constant velocity: its acceleration is white noise of spectral density q; constant
    acceleration: its jerk is (Bar-Shalom, Li, Kirubarajan, Estimation with Applications to
    Tracking and Navigation, 2001, sections 6.2.2 and 6.2.3). A model without acceleration holds
    zeros in its place.

    Args:
        has_acceleration: whether each model has acceleration as a state, M of them.
        noise_psd: of the white noise, M of them [mm^2/s^3] or [mm^2/s^5].
        mean_sojourn_s: mean time between two switches from a model to the other one [s].
    """

    has_acceleration: tuple[bool, ...]
    noise_psd: tuple[float, ...]
    mean_sojourn_s: float

    @classmethod
    def of(cls, settings: TrackerSettings) -> "MotionModels":
        """Return the models that the settings ask for."""
        velocity = settings.motion != "acceleration"
        acceleration = settings.motion != "velocity"
        noise_psd = (settings.acceleration_psd,) * velocity + (settings.jerk_psd,) * acceleration
        return cls((False,) * velocity + (True,) * acceleration, noise_psd, settings.mean_sojourn_s)

    def __len__(self) -> int:
        """Return the number of models."""
        return len(self.noise_psd)

    def transitions(self, step_s: Array) -> tuple[Array, Array]:
        """Return transitions and noise covariances over T times [s], each (T, M, 9, 9)."""
        kind = self.has_acceleration, self.noise_psd
        each = [_step(kind, step) for step in step_s.tolist()]
        if not each:
            return np.empty((0, len(self), STATE_SIZE, STATE_SIZE)), np.empty(
                (0, len(self), STATE_SIZE, STATE_SIZE)
            )
        if all(one is each[0] for one in each):
            shape = (len(each), len(self), STATE_SIZE, STATE_SIZE)
            return np.broadcast_to(each[0][0], shape), np.broadcast_to(each[0][1], shape)
        return np.stack([one[0] for one in each]), np.stack([one[1] for one in each])

    def mode_transition_probabilities(self, step_s: Array) -> Array:
        """Return the chances to go from one model to another, shape (T, M, M), rows from.

        Switches are a Poisson process: over any time the chances are exact, as of a Markov chain
        in continuous time with equal rates.
        """
        if len(self) == 1:
            return np.ones((len(step_s), 1, 1))
        change = 0.5 * -np.expm1(-2.0 * step_s / self.mean_sojourn_s)
        chances = np.empty((len(step_s), 2, 2))
        chances[:, 0, 0] = chances[:, 1, 1] = 1.0 - change
        chances[:, 0, 1] = chances[:, 1, 0] = change
        return chances


@lru_cache(maxsize=256)
def _step(kind: tuple[tuple[bool, ...], tuple[float, ...]], t: float) -> tuple[Array, Array]:
    """Return transitions and noise covariances over t [s], each (M, 9, 9)."""
    parts = [
        ca_transition(t, noise_psd) if has_acceleration else cv_transition(t, noise_psd)
        for has_acceleration, noise_psd in zip(*kind, strict=True)
    ]
    axes = np.eye(3)
    return (
        np.stack([np.kron(transition, axes) for transition, _ in parts]),
        np.stack([np.kron(noise, axes) for _, noise in parts]),
    )


def cv_transition(t: float, noise_psd: float) -> tuple[Array, Array]:
    """Return transition and noise of position, velocity (and no acceleration), each (3, 3)."""
    transition = np.array([[1.0, t, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    noise = np.array([[t**3 / 3, t**2 / 2, 0.0], [t**2 / 2, t, 0.0], [0.0, 0.0, 0.0]])
    return transition, noise_psd * noise


def ca_transition(t: float, noise_psd: float) -> tuple[Array, Array]:
    """Return transition and noise of position, velocity and acceleration, each (3, 3)."""
    transition = np.array([[1.0, t, t**2 / 2], [0.0, 1.0, t], [0.0, 0.0, 1.0]])
    noise = np.array(
        [
            [t**5 / 20, t**4 / 8, t**3 / 6],
            [t**4 / 8, t**3 / 3, t**2 / 2],
            [t**3 / 6, t**2 / 2, t],
        ]
    )
    return transition, noise_psd * noise
