"""Regimes: a tool's state as it is at rest, moved gently, moved steadily, and moved briskly.

While the markers are lit in turn, what a tool may do between two exposures of one marker is most of
its uncertainty. No single figure is right for it: one that holds a brisk hand says nothing of a
tool on a table, one of a tool on a table loses the hand. So a filter runs for each regime, on the
same readings, and how well each had predicted them says which holds: interacting multiple models
(H. A. P. Blom, Y. Bar-Shalom, doi:10.1109/9.1299).

They differ in what a time adds to the covariance; so one linearisation does for all.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.pose.pose_filter import STATES, TURN, Innovations, PoseState, advanced, moved
from compute.pose.regime_model import MOVING, RegimeModel
from compute.pose.small import one_rotation

Array = NDArray[np.float64]

_SAME: Final = np.eye(MOVING)
_BY_CHANGE: Final = (np.arange(12), np.array([9, 10, 11, 6, 7, 8, *range(12, 18)]))
_BY_SECOND_CHANGE: Final = (np.arange(6), np.array([15, 16, 17, 12, 13, 14]))


@dataclass(frozen=True, eq=False)
class Regimes:
    """A tool's state under each of K regimes, at the instant of its last readings.

    Args:
        model: how it changes under each.
        widest: the state under the last regime, that of the largest accelerations.
        off: each regime's state less the widest's, shape (K, 18).
        spread: covariance of each regime's state with itself and with the common errors, shape
            (K, 18, 18 + E).
        chance: probability of each regime, shape (K,).
    """

    model: RegimeModel
    widest: PoseState
    off: Array
    spread: Array
    chance: Array

    @classmethod
    def of(cls, state: PoseState, model: RegimeModel) -> "Regimes":
        """Return the regimes of a tool of whose motion nothing else is known yet."""
        count = len(model)
        spread = np.zeros((count, MOVING, MOVING + state.common.shape[1]))
        spread[:, :STATES, :STATES] = state.covariance
        spread[:, :STATES, MOVING:] = state.common
        spread[:, :, :MOVING] += model.begun
        chance = np.full(count, 1.0 / count)
        return cls(model, state, np.zeros((count, MOVING)), spread, chance)

    @cached_property
    def whole(self) -> PoseState:
        """The state of all regimes together: their mean, and the covariance about it."""
        mean, spread = self._together
        return moved(self.widest, mean, *_parts(spread))

    @cached_property
    def _together(self) -> tuple[Array, Array]:
        """The mean of all regimes less the widest, and their spread about it."""
        mean = self.chance @ self.off
        about = self.off - mean
        spread = (self.chance @ self.spread.reshape(len(self.chance), -1)).reshape(MOVING, -1)
        spread[:, :MOVING] += (self.chance[:, None] * about).T @ about
        return mean, spread

    @cached_property
    def packed(self) -> Array:
        """All numbers one after another: the widest's pose, the chances, ``off`` and ``spread``."""
        pose = self.widest
        return np.concatenate(
            [
                pose.rotation.ravel(),
                pose.centroid_mm,
                pose.velocity_mm_s,
                pose.turn_rate_rad_s,
                self.chance,
                self.off.ravel(),
                self.spread.ravel(),
            ]
        )

    @cached_property
    def packed_at(self) -> int:
        """Where ``packed`` begins in memory."""
        return int(self.packed.__array_interface__["data"][0])

    def ahead(self, time_ns: int) -> PoseState:
        """Return what all regimes together expect at an instant, without readings."""
        step = 1e-9 * (time_ns - self.widest.time_ns)
        if step == 0.0:
            return self.whole
        mean, spread = self._together
        slopes = _slopes(self.widest, step)[:STATES]
        noise = self.model.noise(step, self.chance @ self.model.switching(step))
        spread = slopes @ spread
        covariance = spread[:, :MOVING] @ slopes.T + noise[:STATES, :STATES]
        later = advanced(self.widest, time_ns, slopes[TURN, TURN], covariance, spread[:, MOVING:])
        return moved(later, slopes @ mean, later.covariance, later.common)

    def predict(self, time_ns: int, manoeuvre: float = 1.0) -> "Regimes":
        """Return the regimes at the instant of the next readings.

        Args:
            time_ns: the instant, not before that of the last readings.
            manoeuvre: factor on the accelerations of all regimes.
        """
        step = 1e-9 * (time_ns - self.widest.time_ns)
        if step == 0.0:
            return self
        model, count = self.model, len(self.chance)
        joint = self.chance[:, None] * model.switching(step)
        chance = joint.sum(axis=0)
        came_from = (joint / chance).T
        off = came_from @ self.off
        spread = (came_from @ self.spread.reshape(count, -1)).reshape(self.spread.shape)
        about = self.off - off[:, None]
        spread[:, :, :MOVING] += (came_from[:, :, None] * about).swapaxes(1, 2) @ about
        # Where an acceleration does not last there is none; one that begins to is anything.
        off *= model.states
        spread *= model.states[:, :, None]
        inner = spread[:, :, :MOVING]
        inner *= model.states[:, None]
        inner += (manoeuvre**2 * (came_from @ model.brief))[:, None, None] * model.begun
        widest = moved(self.widest, off[-1], *_parts(spread[-1]))
        slopes = _slopes(widest, step)
        spread = slopes @ spread
        half = 0.5 * (spread[:, :, :MOVING] @ slopes.T + manoeuvre**2 * model.noise(step))
        # Symmetric to the bit: what rounding leaves would grow for as long as the tool is followed.
        np.add(half, half.swapaxes(1, 2), out=spread[:, :, :MOVING])
        later = advanced(widest, time_ns, slopes[TURN, TURN], *_parts(spread[-1]))
        return Regimes(model, later, (off - off[-1]) @ slopes.T, spread, chance)

    def update(self, told: Innovations, residual_px: Array, sigma_px: Array) -> "RegimesUpdate":
        """Return the regimes after n readings.

        Args:
            told: what the widest regime expects of them.
            residual_px: what they are less that, shape (n,) [px].
            sigma_px: their own deviations, shape (n,) [px].
        """
        slopes, by_common = told.slopes, told.common
        number, size = len(residual_px), self.spread.shape[2]
        right = np.empty((len(self.chance), number, 1 + size))
        right[:, :, 0] = residual_px - self.off[:, :6] @ slopes.T
        # Covariance of the readings with the states and the common errors.
        crossed = right[:, :, 1:]
        np.matmul(slopes, self.spread[:, :6], out=crossed)
        if by_common.shape[1]:
            crossed[:, :, :MOVING] += by_common @ self.spread[:, :, MOVING:].swapaxes(1, 2)
            crossed[:, :, MOVING:] += by_common
        own = crossed[:, :, :6] @ slopes.T + crossed[:, :, MOVING:] @ by_common.T
        # What ``told`` holds besides, the curvature's part, is all regimes'.
        whole = told.covariance + (own - own[-1])
        whole.reshape(len(own), -1)[:, :: number + 1] += sigma_px**2
        root = np.linalg.cholesky(whole)
        solved = np.linalg.solve(root, right)
        value = solved[:, :, 0]
        gain = solved[:, :, 1 : 1 + MOVING].swapaxes(1, 2)
        off = self.off + (gain @ value[:, :, None])[:, :, 0]
        nis = np.square(value).sum(axis=1)
        log = np.log(self.chance) - 0.5 * nis
        log -= np.log(root.diagonal(axis1=1, axis2=2)).sum(axis=1)
        chance = np.exp(log - log.max())
        chance /= chance.sum()
        spread = self.spread - gain @ solved[:, :, 1:]
        widest = moved(self.widest, off[-1], *_parts(spread[-1]))
        after = Regimes(self.model, widest, off - off[-1], spread, chance)
        likeliest = solved[int(chance.argmax())]
        whitened = np.concatenate([likeliest[:, :1], likeliest[:, 1 + MOVING :]], axis=1)
        return RegimesUpdate(after, float(chance @ nis), float(nis[-1]), whitened)


def _parts(spread: Array) -> tuple[Array, Array]:
    """Return a state's covariance and that with the common errors, without accelerations."""
    return spread[:STATES, :STATES], spread[:STATES, MOVING:]


@dataclass(frozen=True, eq=False)
class RegimesUpdate:
    """Regimes after readings.

    Args:
        regimes: they now.
        nis: normalised innovation squared of the readings, of the regimes as likely as they are.
        widest_nis: of the widest regime.
        whitened: innovations of the likeliest regime, of unit covariance, and their slopes by the
            common errors, shape (n, 1 + E).
    """

    regimes: Regimes
    nis: float
    widest_nis: float
    whitened: Array


def _slopes(state: PoseState, step_s: float) -> Array:
    """Return d (states after a time) / d states, accelerations included, shape (18, 18)."""
    slopes = _SAME.copy()
    slopes[TURN, TURN] = one_rotation(state.turn_rate_rad_s * step_s)
    slopes[_BY_CHANGE] = step_s
    slopes[_BY_SECOND_CHANGE] = 0.5 * step_s**2
    return slopes
