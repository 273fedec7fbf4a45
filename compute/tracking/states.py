"""States: the filtered states of T tracks under M models of motion, and how models interact."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.tracking.motion_model import STATES, MotionModels

Array = NDArray[np.float64]

LEAST_PROBABILITY = 1e-6
"""Of a model: one that has become certain must be able to turn out wrong."""
_ACCELERATION = slice(6, 9)


@dataclass(eq=False)
class States:
    """What is believed of T markers; arrays of equal length, replaced as a whole.

    Each sensor's readings have a bias that the calibration's error makes. It is the same frame
    after frame, so that no filtering removes it: its covariance with the state is carried along
    and it is never estimated (S. F. Schmidt, Application of State-Space Methods to Navigation
    Problems, 1966; a "consider" filter).

    Args:
        mean: position, velocity, acceleration, shape (T, M, 9).
        covariance: shape (T, M, 9, 9); with the calibration's error in it.
        with_bias: covariance of the state with the sensors' biases, shape (T, M, 9, S).
        probability: of the models, shape (T, M).
    """

    mean: Array
    covariance: Array
    with_bias: Array
    probability: Array

    def __len__(self) -> int:
        """Return the number of tracks."""
        return len(self.mean)

    @classmethod
    def empty(cls, models: int, sensors: int) -> "States":
        """Return the states of no tracks."""
        return cls(
            np.empty((0, models, STATES)),
            np.empty((0, models, STATES, STATES)),
            np.empty((0, models, STATES, sensors)),
            np.empty((0, models)),
        )

    def rows(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> "States":
        """Return a copy of some tracks' states."""
        return States(
            self.mean[index],
            self.covariance[index],
            self.with_bias[index],
            self.probability[index],
        )

    def put(self, index: NDArray[np.intp] | NDArray[np.bool_], states: "States") -> None:
        """Write these states over those of some tracks."""
        self.mean[index] = states.mean
        self.covariance[index] = states.covariance
        self.with_bias[index] = states.with_bias
        self.probability[index] = states.probability

    def joined(self, other: "States") -> "States":
        """Return these states and others after them."""
        return States(
            np.concatenate([self.mean, other.mean]),
            np.concatenate([self.covariance, other.covariance]),
            np.concatenate([self.with_bias, other.with_bias]),
            np.concatenate([self.probability, other.probability]),
        )


@dataclass(frozen=True, eq=False)
class Combined:
    """The one Gaussian with mean and covariance of the models' mixture.

    Args:
        mean: shape (T, 9).
        covariance: shape (T, 9, 9).
        with_bias: shape (T, 9, S).
    """

    mean: Array
    covariance: Array
    with_bias: Array


def predicted(models: MotionModels, states: States, step_s: Array) -> States:
    """Return the states after times (T,) [s] of interacting models.

    Mixing, then every model's own step (H. A. P. Blom, Y. Bar-Shalom, 10.1109/9.1299). A model
    without acceleration is given that of the one that has it when they mix: zeros would pull
    every acceleration towards none.
    """
    if len(models) > 1 and len(states):
        joint = states.probability[:, :, None] * models.switching(step_s)
        ahead = joint.sum(axis=1)
        mean = np.empty_like(states.mean)
        covariance = np.empty_like(states.covariance)
        with_bias = np.empty_like(states.with_bias)
        for to, has in enumerate(models.with_acceleration):
            weights = joint[:, :, to] / ahead[:, to, None]
            mixed = _mixture(models, states, weights)
            mean[:, to], covariance[:, to] = mixed.mean, mixed.covariance
            with_bias[:, to] = mixed.with_bias
            if not has:
                mean[:, to, _ACCELERATION] = 0.0
                covariance[:, to, _ACCELERATION] = 0.0
                covariance[:, to, :, _ACCELERATION] = 0.0
                with_bias[:, to, _ACCELERATION] = 0.0
        states = States(mean, covariance, with_bias, ahead)
    transition, noise = models.steps(step_s)
    return States(
        (transition @ states.mean[..., None])[..., 0],
        transition @ states.covariance @ transition.swapaxes(-1, -2) + noise,
        transition @ states.with_bias,
        states.probability,
    )


def combined(models: MotionModels, states: States) -> Combined:
    """Return the mixture of the models as one Gaussian for each track."""
    if len(models) == 1:
        return Combined(states.mean[:, 0], states.covariance[:, 0], states.with_bias[:, 0])
    return _mixture(models, states, states.probability)


def places(states: States) -> Array:
    """Return the mixtures' mean places alone, shape (T, 3)."""
    mean: Array = (states.probability[..., None] * states.mean[..., :3]).sum(axis=1)
    return mean


def finite(states: States) -> NDArray[np.bool_]:
    """Return which tracks' states are finite in all that their places depend on, shape (T,)."""
    parts = (
        np.isfinite(states.mean).all(axis=(1, 2)),
        np.isfinite(states.covariance).all(axis=(1, 2, 3)),
        np.isfinite(states.probability).all(axis=1),
    )
    return np.asarray(parts[0] & parts[1] & parts[2], dtype=np.bool_)


def weighed(states: States, log_likelihood: Array) -> None:
    """Change the models' probabilities by the likelihoods of what was seen, logs (T, M)."""
    log = np.log(states.probability) + log_likelihood
    raw = np.exp(log - log.max(axis=1, keepdims=True))
    raw = np.maximum(raw / raw.sum(axis=1, keepdims=True), LEAST_PROBABILITY)
    states.probability = raw / raw.sum(axis=1, keepdims=True)


def _mixture(models: MotionModels, states: States, weights: Array) -> Combined:
    """Return mean and covariance of the models' mixture with weights (T, M)."""
    has = models.with_acceleration
    mean, covariance, with_bias = states.mean, states.covariance, states.with_bias
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
    return Combined(
        middle,
        (weights[..., None, None] * spread).sum(axis=1),
        (weights[..., None, None] * with_bias).sum(axis=1),
    )
