"""ImmState: a tool's state under several motion models (interacting multiple models).

While the markers are lit in turn, the motion between two exposures of one marker dominates the
uncertainty. No single acceleration fits: one for a fast hand gives wide predictions of a tool on a
table, one for a tool on a table loses the hand. So a filter runs for each motion model, on the same
readings, and how well each predicts them gives its probability (H. A. P. Blom, Y. Bar-Shalom,
doi:10.1109/9.1299).

The models differ only in the process noise, so one linearisation serves all.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.rotation import exp_so3
from compute.pose.filtering.imm_model import IMM_STATES, ImmModel
from compute.pose.filtering.pose_filter import (
    ROTATION,
    STATES,
    MeasurementPrediction,
    PoseState,
    propagate,
    retract,
)

Array = NDArray[np.float64]

_IDENTITY: Final = np.eye(IMM_STATES)
_BY_RATE: Final = (np.arange(12), np.array([9, 10, 11, 6, 7, 8, *range(12, 18)]))
_BY_SECOND_DERIVATIVE: Final = (np.arange(6), np.array([15, 16, 17, 12, 13, 14]))


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
        later = propagate(
            self.widest_state,
            time_ns,
            jacobian[ROTATION, ROTATION],
            covariance,
            covariances[:, IMM_STATES:],
        )
        return retract(later, jacobian @ mean, later.covariance, later.common)

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
        later = propagate(
            widest_state, time_ns, jacobian[ROTATION, ROTATION], *_pose_blocks(covariances[-1])
        )
        return ImmState(
            model, later, (offsets - offsets[-1]) @ jacobian.T, covariances, mode_probabilities
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
        own = crossed[:, :, :6] @ jacobian.T + crossed[:, :, IMM_STATES:] @ by_common.T
        # The second-order part of ``prediction.covariance`` is common to all models.
        combined = prediction.covariance + (own - own[-1])
        combined.reshape(len(own), -1)[:, :: number + 1] += sigma_px**2
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
        likeliest = solved[int(mode_probabilities.argmax())]
        whitened = np.concatenate([likeliest[:, :1], likeliest[:, 1 + IMM_STATES :]], axis=1)
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
