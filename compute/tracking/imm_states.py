"""ImmStates: states of T tracks under M motion models (interacting multiple models)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.tracking.motion_model import STATE_SIZE, MotionModels

Array = NDArray[np.float64]

MIN_MODE_PROBABILITY = 1e-6
"""Of a model: one that has become certain must be able to turn out wrong."""
_ACCELERATION = slice(6, 9)


@dataclass(eq=False)
class ImmStates:
    """What is believed of T markers; arrays of equal length, replaced as a whole.

    Each sensor's readings have a bias that the calibration's error makes. It is the same frame
    after frame, so that no filtering removes it: its covariance with the state is carried along
    and it is never estimated (S. F. Schmidt, Application of State-Space Methods to Navigation
    Problems, 1966; a "consider" filter).

    Args:
        mean: position, velocity, acceleration, shape (T, M, 9).
        covariance: shape (T, M, 9, 9); with the calibration's error in it.
        bias_cross_covariance: covariance of the state with the sensors' biases, shape (T, M, 9, S).
        probability: of the models, shape (T, M).
    """

    mean: Array
    covariance: Array
    bias_cross_covariance: Array
    probability: Array

    def __len__(self) -> int:
        """Return the number of tracks."""
        return len(self.mean)

    @classmethod
    def empty(cls, models: int, sensors: int) -> "ImmStates":
        """Return the states of no tracks."""
        return cls(
            np.empty((0, models, STATE_SIZE)),
            np.empty((0, models, STATE_SIZE, STATE_SIZE)),
            np.empty((0, models, STATE_SIZE, sensors)),
            np.empty((0, models)),
        )

    def rows(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> "ImmStates":
        """Return a copy of some tracks' states."""
        return ImmStates(
            self.mean[index],
            self.covariance[index],
            self.bias_cross_covariance[index],
            self.probability[index],
        )

    def put(self, index: NDArray[np.intp] | NDArray[np.bool_], states: "ImmStates") -> None:
        """Write these states over those of some tracks."""
        self.mean[index] = states.mean
        self.covariance[index] = states.covariance
        self.bias_cross_covariance[index] = states.bias_cross_covariance
        self.probability[index] = states.probability

    def concatenate(self, other: "ImmStates") -> "ImmStates":
        """Return these states and others after them."""
        return ImmStates(
            np.concatenate([self.mean, other.mean]),
            np.concatenate([self.covariance, other.covariance]),
            np.concatenate([self.bias_cross_covariance, other.bias_cross_covariance]),
            np.concatenate([self.probability, other.probability]),
        )


@dataclass(frozen=True, eq=False)
class CombinedState:
    """The one Gaussian with mean and covariance of the models' mixture.

    Args:
        mean: shape (T, 9).
        covariance: shape (T, 9, 9).
        bias_cross_covariance: shape (T, 9, S).
    """

    mean: Array
    covariance: Array
    bias_cross_covariance: Array


def mix_and_predict(models: MotionModels, states: ImmStates, step_s: Array) -> ImmStates:
    """Return the states after times (T,) [s] of interacting models.

    Mixing, then every model's own step (H. A. P. Blom, Y. Bar-Shalom, 10.1109/9.1299). A model
    without acceleration is given that of the one that has it when they mix: zeros would pull
    every acceleration towards none.
    """
    if len(models) > 1 and len(states):
        joint = states.probability[:, :, None] * models.mode_transition_probabilities(step_s)
        ahead = joint.sum(axis=1)
        mean = np.empty_like(states.mean)
        covariance = np.empty_like(states.covariance)
        bias_cross_covariance = np.empty_like(states.bias_cross_covariance)
        for to, has in enumerate(models.has_acceleration):
            weights = joint[:, :, to] / ahead[:, to, None]
            mixed = _mixture(models, states, weights)
            mean[:, to], covariance[:, to] = mixed.mean, mixed.covariance
            bias_cross_covariance[:, to] = mixed.bias_cross_covariance
            if not has:
                mean[:, to, _ACCELERATION] = 0.0
                covariance[:, to, _ACCELERATION] = 0.0
                covariance[:, to, :, _ACCELERATION] = 0.0
                bias_cross_covariance[:, to, _ACCELERATION] = 0.0
        states = ImmStates(mean, covariance, bias_cross_covariance, ahead)
    transition, noise = models.transitions(step_s)
    return ImmStates(
        (transition @ states.mean[..., None])[..., 0],
        transition @ states.covariance @ transition.swapaxes(-1, -2) + noise,
        transition @ states.bias_cross_covariance,
        states.probability,
    )


def combine_modes(models: MotionModels, states: ImmStates) -> CombinedState:
    """Return the mixture of the models as one Gaussian for each track."""
    if len(models) == 1:
        return CombinedState(
            states.mean[:, 0], states.covariance[:, 0], states.bias_cross_covariance[:, 0]
        )
    return _mixture(models, states, states.probability)


def mean_positions(states: ImmStates) -> Array:
    """Return the mixtures' mean places alone, shape (T, 3)."""
    mean: Array = (states.probability[..., None] * states.mean[..., :3]).sum(axis=1)
    return mean


def is_finite(states: ImmStates) -> NDArray[np.bool_]:
    """Return which tracks' states are finite in all that their places depend on, shape (T,)."""
    parts = (
        np.isfinite(states.mean).all(axis=(1, 2)),
        np.isfinite(states.covariance).all(axis=(1, 2, 3)),
        np.isfinite(states.probability).all(axis=1),
    )
    return np.asarray(parts[0] & parts[1] & parts[2], dtype=np.bool_)


def update_mode_probabilities(states: ImmStates, log_likelihood: Array) -> None:
    """Change the models' probabilities by the likelihoods of what was seen, logs (T, M)."""
    log = np.log(states.probability) + log_likelihood
    raw = np.exp(log - log.max(axis=1, keepdims=True))
    raw = np.maximum(raw / raw.sum(axis=1, keepdims=True), MIN_MODE_PROBABILITY)
    states.probability = raw / raw.sum(axis=1, keepdims=True)


def _mixture(models: MotionModels, states: ImmStates, weights: Array) -> CombinedState:
    """Return mean and covariance of the models' mixture with weights (T, M)."""
    has = models.has_acceleration
    mean, covariance, bias_cross_covariance = (
        states.mean,
        states.covariance,
        states.bias_cross_covariance,
    )
    if any(has) and not all(has):
        source = has.index(True)
        mean, covariance = mean.copy(), covariance.copy()
        for model, own in enumerate(has):
            if not own:
                mean[:, model, _ACCELERATION] = mean[:, source, _ACCELERATION]
                covariance[:, model, _ACCELERATION, _ACCELERATION] = covariance[
                    :, source, _ACCELERATION, _ACCELERATION
                ]
    middle = (weights[..., None] * mean).sum(axis=1)
    off = mean - middle[:, None]
    spread = covariance + off[..., :, None] * off[..., None, :]
    return CombinedState(
        middle,
        (weights[..., None, None] * spread).sum(axis=1),
        (weights[..., None, None] * bias_cross_covariance).sum(axis=1),
    )
