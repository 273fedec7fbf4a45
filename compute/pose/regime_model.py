"""RegimeModel: how a tool's state changes under each regime of motion, as matrices made once."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.pose.pose_filter import PLACE, RATE, SPEED, STATES, TURN
from compute.pose.settings import MotionSettings, RegimeSettings

Array = NDArray[np.float64]

MOVING: Final = STATES + 6
"""The states of PoseState, then acceleration and angular acceleration."""
_KINDS: Final = ((PLACE, SPEED, slice(12, 15)), (TURN, RATE, slice(15, 18)))
_POWERS: Final = 5
_POWER: Final = np.arange(1, _POWERS + 1)
_WHITE_JERK: Final = np.array([[20.0, 8.0, 6.0], [8.0, 3.0, 2.0], [6.0, 2.0, 1.0]])
"""Of pose, rate and acceleration: what density and power of the time are divided by (Bar-Shalom,
Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 6.2)."""


@dataclass(frozen=True, eq=False)
class RegimeModel:
    """K regimes of motion over the 18 states of a pose, its velocities and its accelerations.

    Those in which accelerations do not last hold zeros in their place: so one transition does for
    all of them.

    Args:
        mean_s: time that a tool keeps to a regime, in the mean [s].
        brief: 1 for regimes whose accelerations do not last, 0 for the others, shape (K,).
        states: 1 for the states that a regime has, 0 for the others, shape (K, 18).
        begun: covariance of lasting accelerations at first, shape (K, 18, 18).
        terms: what a time adds to the covariance, by powers of the time from 1 to 5,
            shape (5, K * 18 * 18).
    """

    mean_s: float
    brief: Array
    states: Array
    begun: Array
    terms: Array

    @classmethod
    def of(cls, motion: MotionSettings, settings: RegimeSettings) -> "RegimeModel":
        """Return the model of these accelerations and regimes; it is kept."""
        return _model_of(motion, settings)

    def __len__(self) -> int:
        """Return the number of regimes."""
        return len(self.brief)

    def switching(self, step_s: float) -> Array:
        """Return the chances to go from a regime (row) to another over a time, shape (K, K).

        Changes are a Poisson process, to every other regime alike: a Markov chain in continuous
        time.
        """
        count = len(self)
        change = self.change(step_s)
        chances = np.full((count, count), change)
        chances.flat[:: count + 1] = 1.0 - (count - 1) * change
        return chances

    def change(self, step_s: float) -> float:
        """Return the chance to go from one regime to a certain other one over a time."""
        count = len(self)
        if count == 1:
            return 0.0
        return float(-np.expm1(-count / (count - 1) * step_s / self.mean_s) / count)

    def noise(self, step_s: float, chance: Array | None = None) -> Array:
        """Return what a time adds to the covariance of each regime, shape (K, 18, 18).

        Args:
            step_s: the time [s].
            chance: of each regime, shape (K,): the mean of all is returned, shape (18, 18).
        """
        found: Array = step_s**_POWER @ self.terms
        if chance is None:
            return found.reshape(-1, MOVING, MOVING)
        return (chance @ found.reshape(len(chance), -1)).reshape(MOVING, MOVING)


@lru_cache(maxsize=16)
def _model_of(motion: MotionSettings, settings: RegimeSettings) -> RegimeModel:
    count = len(settings.kinds)
    brief = np.array([one.steady_s is None for one in settings.kinds], dtype=np.float64)
    states = np.ones((count, MOVING))
    states[brief > 0.0, STATES:] = 0.0
    begun = np.zeros((count, MOVING, MOVING))
    terms = np.zeros((_POWERS, count, MOVING, MOVING))
    sizes = motion.acceleration_mm_s2, motion.turn_acceleration_rad_s2
    for index, one in enumerate(settings.kinds):
        for parts, size in zip(_KINDS, sizes, strict=True):
            variance = (one.share * size) ** 2
            if one.steady_s is None:
                _fill(terms[:, index], parts[:2], 2.0 * variance * motion.steady_s)
            else:
                _fill(terms[:, index], parts, 2.0 * variance / one.steady_s)
                np.fill_diagonal(begun[index, parts[2], parts[2]], variance)
    return RegimeModel(settings.mean_s, brief, states, begun, terms.reshape(_POWERS, -1))


def _fill(terms: Array, parts: tuple[slice, ...], density: float) -> None:
    """Write what white noise of the last of the parts' changes adds, by powers of the time."""
    count = len(parts)
    divisor = _WHITE_JERK[3 - count :, 3 - count :]
    for i, first in enumerate(parts):
        for j, second in enumerate(parts):
            power = 2 * count - 1 - i - j
            np.fill_diagonal(terms[power - 1, first, second], density / divisor[i, j])
