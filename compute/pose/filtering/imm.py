"""Interacting multiple model filter of a tool: ImmModel, the motion models; ImmState, its state.

While the markers are lit in turn, the motion between two exposures of one marker dominates the
uncertainty. No single acceleration fits: one for a fast hand gives wide predictions of a tool on a
table, one for a tool on a table loses the hand. So a filter runs for each motion model, on the same
readings, and how well each predicts them gives its probability (H. A. P. Blom, Y. Bar-Shalom,
doi:10.1109/9.1299).

The models differ only in the process noise, so one linearisation serves all.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.pose.filtering.pose_filter import (
    ANGULAR_VELOCITY,
    POSITION,
    ROTATION,
    STATES,
    VELOCITY,
    MeasurementPrediction,
    PoseState,
    propagate,
    retract,
)
from compute.pose.settings import ImmSettings, MotionSettings
from compute.transform import exp_so3

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
_IDENTITY: Final = np.eye(IMM_STATES)
_BY_RATE: Final = (np.arange(12), np.array([9, 10, 11, 6, 7, 8, *range(12, 18)]))
_BY_SECOND_DERIVATIVE: Final = (np.arange(6), np.array([15, 16, 17, 12, 13, 14]))


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
    @lru_cache(maxsize=16)
    def of(cls, motion: MotionSettings, settings: ImmSettings) -> "ImmModel":
        """Return the model of these settings; it is cached.

        Args:
            motion: RMS accelerations.
            settings: the motion models.
        """
        count = len(settings.modes)
        constant_velocity = np.array(
            [mode.manoeuvre_time_constant_s is None for mode in settings.modes], dtype=np.float64
        )
        state_mask = np.ones((count, IMM_STATES))
        state_mask[constant_velocity > 0.0, STATES:] = 0.0
        initial_covariance = np.zeros((count, IMM_STATES, IMM_STATES))
        noise_terms = np.zeros((_POWERS, count, IMM_STATES, IMM_STATES))
        sizes = motion.acceleration_mm_s2, motion.angular_acceleration_rad_s2
        for index, mode in enumerate(settings.modes):
            time_constant_s, noise = mode.manoeuvre_time_constant_s, noise_terms[:, index]
            for chain, size in zip(_STATE_CHAINS, sizes, strict=True):
                variance = (mode.acceleration_fraction * size) ** 2
                if time_constant_s is None:
                    density = 2.0 * variance * motion.manoeuvre_time_constant_s
                    _add_white_noise(noise, chain[:2], density)
                else:
                    _add_white_noise(noise, chain, 2.0 * variance / time_constant_s)
                    np.fill_diagonal(initial_covariance[index, chain[2], chain[2]], variance)
        return cls(
            settings.mean_sojourn_s,
            constant_velocity,
            state_mask,
            initial_covariance,
            noise_terms.reshape(_POWERS, -1),
        )

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
        noise: Array = step_s**_POWER @ self.noise_terms
        if mode_probabilities is None:
            return noise.reshape(-1, IMM_STATES, IMM_STATES)
        return (mode_probabilities @ noise.reshape(len(mode_probabilities), -1)).reshape(
            IMM_STATES, IMM_STATES
        )


def _add_white_noise(noise_terms: Array, parts: tuple[slice, ...], density: float) -> None:
    """Add white noise in the derivative of the last of the parts, by powers of the time step."""
    count = len(parts)
    divisor = _WHITE_JERK_DIVISORS[3 - count :, 3 - count :]
    for i, first in enumerate(parts):
        for j, second in enumerate(parts):
            power = 2 * count - 1 - i - j
            np.fill_diagonal(noise_terms[power - 1, first, second], density / divisor[i, j])


@dataclass(frozen=True, eq=False)
class ImmState:
    """A tool's state under each of K motion models, at the time of its last readings.

    Args:
        model: the motion models.
        widest_state: state under the last model, that of the largest accelerations.
        offsets: each model's state less the widest one, shape (K, 18).
        covariances: covariance of each model's state with itself and with the common errors,
            shape (K, 18, 18 + E).
        mode_probabilities: probability of each model, shape (K,).
    """

    model: ImmModel
    widest_state: PoseState
    offsets: Array
    covariances: Array
    mode_probabilities: Array

    @classmethod
    def of(cls, state: PoseState, model: ImmModel) -> "ImmState":
        """Return the states of a tool of unknown motion.

        Args:
            state: the initial state.
            model: the motion models.
        """
        count = len(model)
        covariances = np.zeros((count, IMM_STATES, IMM_STATES + state.common.shape[1]))
        covariances[:, :STATES, :STATES] = state.covariance
        covariances[:, :STATES, IMM_STATES:] = state.common
        covariances[:, :, :IMM_STATES] += model.initial_covariance
        mode_probabilities = np.full(count, 1.0 / count)
        return cls(model, state, np.zeros((count, IMM_STATES)), covariances, mode_probabilities)

    @cached_property
    def combined(self) -> PoseState:
        """The combined state: mean of all models, and the covariance about it."""
        mean, covariances = self._combined_estimate
        return retract(self.widest_state, mean, *_pose_blocks(covariances))

    @cached_property
    def _combined_estimate(self) -> tuple[Array, Array]:
        """Mean of all models less the widest one, and the covariance about it."""
        mean = self.mode_probabilities @ self.offsets
        about = self.offsets - mean
        covariances = (
            self.mode_probabilities @ self.covariances.reshape(len(self.mode_probabilities), -1)
        ).reshape(IMM_STATES, -1)
        covariances[:, :IMM_STATES] += (self.mode_probabilities[:, None] * about).T @ about
        return mean, covariances

    @cached_property
    def packed(self) -> Array:
        """Widest pose, mode probabilities, ``offsets`` and ``covariances`` in one array."""
        pose = self.widest_state
        return np.concatenate(
            [
                pose.rotation.ravel(),
                pose.centroid_mm,
                pose.velocity_mm_s,
                pose.angular_velocity_rad_s,
                self.mode_probabilities,
                self.offsets.ravel(),
                self.covariances.ravel(),
            ]
        )

    @cached_property
    def packed_address(self) -> int:
        """Address of ``packed`` in memory."""
        return int(self.packed.__array_interface__["data"][0])

    def predict_combined(self, time_ns: int) -> PoseState:
        """Return the combined state predicted to a time, without readings."""
        step = 1e-9 * (time_ns - self.widest_state.time_ns)
        if step == 0.0:
            return self.combined
        mean, covariances = self._combined_estimate
        jacobian = _transition_jacobian(self.widest_state, step)[:STATES]
        process_noise = self.model.process_noise(
            step, self.mode_probabilities @ self.model.transition_probabilities(step)
        )
        covariances = jacobian @ covariances
        covariance = covariances[:, :IMM_STATES] @ jacobian.T + process_noise[:STATES, :STATES]
        predicted = propagate(
            self.widest_state,
            time_ns,
            jacobian[ROTATION, ROTATION],
            covariance,
            covariances[:, IMM_STATES:],
        )
        return retract(predicted, jacobian @ mean, predicted.covariance, predicted.common)

    def predict(self, time_ns: int, manoeuvre_factor: float = 1.0) -> "ImmState":
        """Return the states mixed and predicted to the time of the next readings.

        Args:
            time_ns: the time, not before that of the last readings [ns].
            manoeuvre_factor: factor on the accelerations of all models.
        """
        step = 1e-9 * (time_ns - self.widest_state.time_ns)
        if step == 0.0:
            return self
        model, count = self.model, len(self.mode_probabilities)
        joint = self.mode_probabilities[:, None] * model.transition_probabilities(step)
        mode_probabilities = joint.sum(axis=0)
        mixing_probabilities = (joint / mode_probabilities).T
        offsets = mixing_probabilities @ self.offsets
        covariances = (mixing_probabilities @ self.covariances.reshape(count, -1)).reshape(
            self.covariances.shape
        )
        about = self.offsets - offsets[:, None]
        covariances[:, :, :IMM_STATES] += (mixing_probabilities[:, :, None] * about).swapaxes(
            1, 2
        ) @ about
        # Models without persistent accelerations have none; a new one has its initial covariance.
        offsets *= model.state_mask
        covariances *= model.state_mask[:, :, None]
        inner = covariances[:, :, :IMM_STATES]
        inner *= model.state_mask[:, None]
        inner += (manoeuvre_factor**2 * (mixing_probabilities @ model.constant_velocity))[
            :, None, None
        ] * model.initial_covariance
        widest_state = retract(self.widest_state, offsets[-1], *_pose_blocks(covariances[-1]))
        jacobian = _transition_jacobian(widest_state, step)
        covariances = jacobian @ covariances
        half = 0.5 * (
            covariances[:, :, :IMM_STATES] @ jacobian.T
            + manoeuvre_factor**2 * model.process_noise(step)
        )
        # Exactly symmetric: rounding errors would otherwise grow while the tool is tracked.
        np.add(half, half.swapaxes(1, 2), out=covariances[:, :, :IMM_STATES])
        predicted = propagate(
            widest_state, time_ns, jacobian[ROTATION, ROTATION], *_pose_blocks(covariances[-1])
        )
        return ImmState(
            model, predicted, (offsets - offsets[-1]) @ jacobian.T, covariances, mode_probabilities
        )

    def update(
        self, prediction: MeasurementPrediction, residual_px: Array, sigma_px: Array
    ) -> "ImmUpdate":
        """Return the states updated by n readings.

        Args:
            prediction: predicted readings of the widest model.
            residual_px: readings less these predictions, shape (n,) [px].
            sigma_px: standard deviations of the readings, shape (n,) [px].
        """
        jacobian, by_common = prediction.jacobian, prediction.common
        number, size = len(residual_px), self.covariances.shape[2]
        right = np.empty((len(self.mode_probabilities), number, 1 + size))
        right[:, :, 0] = residual_px - self.offsets[:, :6] @ jacobian.T
        # Covariance of the readings with the states and the common errors.
        crossed = right[:, :, 1:]
        np.matmul(jacobian, self.covariances[:, :6], out=crossed)
        if by_common.shape[1]:
            crossed[:, :, :IMM_STATES] += by_common @ self.covariances[:, :, IMM_STATES:].swapaxes(
                1, 2
            )
            crossed[:, :, IMM_STATES:] += by_common
        mode_covariance = crossed[:, :, :6] @ jacobian.T + crossed[:, :, IMM_STATES:] @ by_common.T
        # The second-order part of ``prediction.covariance`` is common to all models.
        combined = prediction.covariance + (mode_covariance - mode_covariance[-1])
        combined.reshape(len(mode_covariance), -1)[:, :: number + 1] += sigma_px**2
        root = np.linalg.cholesky(combined)
        solved = np.linalg.solve(root, right)
        value = solved[:, :, 0]
        gain = solved[:, :, 1 : 1 + IMM_STATES].swapaxes(1, 2)
        offsets = self.offsets + (gain @ value[:, :, None])[:, :, 0]
        nis = np.square(value).sum(axis=1)
        log = np.log(self.mode_probabilities) - 0.5 * nis
        log -= np.log(root.diagonal(axis1=1, axis2=2)).sum(axis=1)
        mode_probabilities = np.exp(log - log.max())
        mode_probabilities /= mode_probabilities.sum()
        covariances = self.covariances - gain @ solved[:, :, 1:]
        widest_state = retract(self.widest_state, offsets[-1], *_pose_blocks(covariances[-1]))
        after = ImmState(
            self.model, widest_state, offsets - offsets[-1], covariances, mode_probabilities
        )
        most_probable = solved[int(mode_probabilities.argmax())]
        whitened = np.concatenate(
            [most_probable[:, :1], most_probable[:, 1 + IMM_STATES :]], axis=1
        )
        return ImmUpdate(after, float(mode_probabilities @ nis), float(nis[-1]), whitened)


def _pose_blocks(covariances: Array) -> tuple[Array, Array]:
    """Return a state's covariance and that with the common errors, without accelerations."""
    return covariances[:STATES, :STATES], covariances[:STATES, IMM_STATES:]


@dataclass(frozen=True, eq=False)
class ImmUpdate:
    """ImmState after readings.

    Args:
        imm: the updated states.
        nis: normalised innovation squared of the readings, averaged over the models by their
            probabilities.
        widest_nis: that of the widest model.
        whitened: whitened innovations of the most probable model, and their Jacobian with respect
            to the common errors, shape (n, 1 + E).
    """

    imm: ImmState
    nis: float
    widest_nis: float
    whitened: Array


def _transition_jacobian(state: PoseState, step_s: float) -> Array:
    """Return d (states after a time) / d states, accelerations included, shape (18, 18)."""
    jacobian = _IDENTITY.copy()
    jacobian[ROTATION, ROTATION] = exp_so3(state.angular_velocity_rad_s * step_s)
    jacobian[_BY_RATE] = step_s
    jacobian[_BY_SECOND_DERIVATIVE] = 0.5 * step_s**2
    return jacobian
