"""Motion models (constant velocity, constant acceleration) and IMM states of tracks under them."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from compute.reconstruction.point_batch import Batch
from compute.tracking.settings import TrackerSettings

Array = NDArray[np.float64]

STATE_SIZE = 9
"""Position, velocity and acceleration, x, y, z each."""
MIN_MODE_PROBABILITY = 1e-6
"""Lower limit of a model's probability: one that has become certain can still turn out wrong."""
_ACCELERATION = slice(6, 9)


@dataclass(frozen=True)
class MotionModels:
    """M motion models of one marker, over the same nine states.

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
        shape = (len(each), len(self), STATE_SIZE, STATE_SIZE)
        if each and all(one is each[0] for one in each):
            return np.broadcast_to(each[0][0], shape), np.broadcast_to(each[0][1], shape)
        transition, noise = (np.array([one[i] for one in each]).reshape(shape) for i in (0, 1))
        return transition, noise

    def mode_transition_probabilities(self, step_s: Array) -> Array:
        """Return the transition probabilities of the models, shape (T, M, M); rows: from.

        Switches are a Poisson process: those of a Markov chain in continuous time with equal rates,
        exact for any time step.
        """
        if len(self) == 1:
            return np.ones((len(step_s), 1, 1))
        change = 0.5 * -np.expm1(-2.0 * step_s / self.mean_sojourn_s)
        transition = np.empty((len(step_s), 2, 2))
        transition[:, 0, 0] = transition[:, 1, 1] = 1.0 - change
        transition[:, 0, 1] = transition[:, 1, 0] = change
        return transition


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
    """Return transition and process noise of the constant-velocity model, each (3, 3).

    The state of one axis is position, velocity and acceleration; the last is held at zero.

    Args:
        t: time step [s].
        noise_psd: spectral density of the white acceleration [mm^2/s^3].
    """
    transition = np.array([[1.0, t, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    noise = np.array([[t**3 / 3, t**2 / 2, 0.0], [t**2 / 2, t, 0.0], [0.0, 0.0, 0.0]])
    return transition, noise_psd * noise


def ca_transition(t: float, noise_psd: float) -> tuple[Array, Array]:
    """Return transition and process noise of the constant-acceleration model, each (3, 3).

    The state of one axis is position, velocity and acceleration.

    Args:
        t: time step [s].
        noise_psd: spectral density of the white jerk [mm^2/s^5].
    """
    transition = np.array([[1.0, t, t**2 / 2], [0.0, 1.0, t], [0.0, 0.0, 1.0]])
    noise = np.array(
        [
            [t**5 / 20, t**4 / 8, t**3 / 6],
            [t**4 / 8, t**3 / 3, t**2 / 2],
            [t**3 / 6, t**2 / 2, t],
        ]
    )
    return transition, noise_psd * noise


@dataclass(eq=False)
class ImmStates(Batch):
    """Means and covariances of T tracks under M models; arrays are replaced as a whole.

    The calibration's error biases each sensor's readings. The bias is the same in every frame, so
    that no filtering removes it: its covariance with the state is propagated and the bias is never
    estimated (S. F. Schmidt, Application of State-Space Methods to Navigation
    Problems, 1966; a "consider" filter).

    Args:
        mean: position, velocity, acceleration, shape (T, M, 9).
        covariance: shape (T, M, 9, 9), the calibration's error included.
        bias_cross_covariance: covariance of the state with the sensors' biases, shape (T, M, 9, S).
        probability: of the models, shape (T, M).
    """

    mean: Annotated[Array, "M", STATE_SIZE]
    covariance: Annotated[Array, "M", STATE_SIZE, STATE_SIZE]
    bias_cross_covariance: Annotated[Array, "M", STATE_SIZE, "S"]
    probability: Annotated[Array, "M"]


@dataclass(frozen=True, eq=False)
class CombinedState:
    """Gaussian with the mean and covariance of the models' mixture.

    Args:
        mean: shape (T, 9).
        covariance: shape (T, 9, 9).
        bias_cross_covariance: shape (T, 9, S).
    """

    mean: Array
    covariance: Array
    bias_cross_covariance: Array


def mix_and_predict(models: MotionModels, states: ImmStates, step_s: Array) -> ImmStates:
    """Mix the models' states, then predict each by its own model.

    The IMM's first two steps (H. A. P. Blom, Y. Bar-Shalom, 10.1109/9.1299). A model without
    acceleration takes that of the one that has it when they mix: zeros would pull every
    acceleration towards none.

    Args:
        models: M motion models.
        states: of T tracks.
        step_s: time step of each track, shape (T,) [s].
    """
    if len(models) > 1 and len(states):
        joint = states.probability[:, :, None] * models.mode_transition_probabilities(step_s)
        ahead = joint.sum(axis=1)
        mixed = _mixtures(models, states, (joint / ahead[:, None, :]).swapaxes(1, 2))
        for to, has in enumerate(models.has_acceleration):
            if not has:
                mixed.mean[:, to, _ACCELERATION] = 0.0
                mixed.covariance[:, to, _ACCELERATION] = 0.0
                mixed.covariance[:, to, :, _ACCELERATION] = 0.0
                mixed.bias_cross_covariance[:, to, _ACCELERATION] = 0.0
        states = ImmStates(mixed.mean, mixed.covariance, mixed.bias_cross_covariance, ahead)
    transition, noise = models.transitions(step_s)
    return ImmStates(
        (transition @ states.mean[..., None])[..., 0],
        transition @ states.covariance @ transition.swapaxes(-1, -2) + noise,
        transition @ states.bias_cross_covariance,
        states.probability,
    )


def combine_modes(models: MotionModels, states: ImmStates) -> CombinedState:
    """Return the mixture of the models as one Gaussian for each track.

    Args:
        models: M motion models.
        states: of T tracks.
    """
    if len(models) == 1:
        return CombinedState(
            states.mean[:, 0], states.covariance[:, 0], states.bias_cross_covariance[:, 0]
        )
    mixed = _mixtures(models, states, states.probability[:, None])
    return CombinedState(
        mixed.mean[:, 0], mixed.covariance[:, 0], mixed.bias_cross_covariance[:, 0]
    )


def mean_positions(states: ImmStates) -> Array:
    """Return the mean positions of the mixtures, shape (T, 3) [mm]."""
    mean: Array = (states.probability[..., None] * states.mean[..., :3]).sum(axis=1)
    return mean


def position_spreads(states: ImmStates) -> tuple[Array, Array]:
    """Return mean positions (T, 3) and root traces of their covariances (T,) of mixtures [mm]."""
    squares = np.trace(states.covariance[..., :3, :3], axis1=2, axis2=3)
    if states.probability.shape[1] == 1:
        return states.mean[:, 0, :3], np.sqrt(squares[:, 0])
    mean = mean_positions(states)
    squares += ((states.mean[..., :3] - mean[:, None]) ** 2).sum(axis=2)
    return mean, np.sqrt((states.probability * squares).sum(axis=1))


def is_finite(states: ImmStates) -> NDArray[np.bool_]:
    """Return which tracks' states are finite in all that their positions depend on, shape (T,)."""
    finite = np.isfinite(states.mean).all(axis=(1, 2))
    finite &= np.isfinite(states.covariance).all(axis=(1, 2, 3))
    finite &= np.isfinite(states.probability).all(axis=1)
    return np.asarray(finite)


def update_mode_probabilities(states: ImmStates, log_likelihood: Array) -> None:
    """Update the models' probabilities by Bayes' rule, in place.

    Args:
        states: of T tracks.
        log_likelihood: of each track's readings under each model, shape (T, M).
    """
    log = np.log(states.probability) + log_likelihood
    raw = np.exp(log - log.max(axis=1, keepdims=True))
    raw = np.maximum(raw / raw.sum(axis=1, keepdims=True), MIN_MODE_PROBABILITY)
    states.probability = raw / raw.sum(axis=1, keepdims=True)


def _mixtures(models: MotionModels, states: ImmStates, weights: Array) -> CombinedState:
    """Return means and covariances of K mixtures of the models with weights (T, K, M).

    Their shapes are those of one mixture, with an axis of K behind the first.
    """
    has = models.has_acceleration
    mean, covariance = states.mean, states.covariance
    if any(has) and not all(has):
        source = has.index(True)
        mean, covariance = mean.copy(), covariance.copy()
        acceleration = covariance[:, source, _ACCELERATION, _ACCELERATION]
        for model, model_has in enumerate(has):
            if not model_has:
                mean[:, model, _ACCELERATION] = mean[:, source, _ACCELERATION]
                covariance[:, model, _ACCELERATION, _ACCELERATION] = acceleration
    mixed_mean = weights @ mean
    # The square root of the weights on both sides: symmetric to the last digit.
    off = np.sqrt(weights)[..., None] * (mean[:, None] - mixed_mean[:, :, None])
    tracks, mixtures, count = weights.shape
    bias = states.bias_cross_covariance
    mixed_covariance = weights @ covariance.reshape(tracks, count, STATE_SIZE**2)
    mixed_bias = weights @ bias.reshape(tracks, count, STATE_SIZE * bias.shape[-1])
    return CombinedState(
        mixed_mean,
        mixed_covariance.reshape(tracks, mixtures, STATE_SIZE, STATE_SIZE)
        + off.swapaxes(-1, -2) @ off,
        mixed_bias.reshape(tracks, mixtures, STATE_SIZE, bias.shape[-1]),
    )
