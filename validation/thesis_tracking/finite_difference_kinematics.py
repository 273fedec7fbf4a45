"""Velocity and acceleration of a marker by differences of its last three points."""

from collections import deque
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.tracking.motion_model import cv_transition

Array = NDArray[np.float64]

POINTS: Final = 3
START_SPEED_MM_S: Final = 500.0
"""Standard deviation of a velocity that is not known yet, along each axis."""
START_ACCELERATION_MM_S2: Final = 3000.0
_MEAN_VELOCITY, _MEAN_ACCELERATION = 1.0 / 3.0, 23.0 / 30.0
"""What white noise makes of the difference between the last velocity and the mean of an interval
h: this times density times h; and of the last acceleration and the second difference."""


class FiniteDifferenceKinematics:
    """The last three points of a marker, as section 6.3 takes its kinematics from them.

    Velocity is the difference of the last two over their time, acceleration the difference of the
    two velocities: both are of the times between, half an interval and one interval ago. The
    covariance is that of the points', taken as independent, and of what the motion may have done
    since those times, by ``acceleration_psd`` and ``jerk_psd``. (Errors of the calibration are
    the same in all points and cancel in differences: so it is rather too large.) After the last
    point the marker goes on by [6.1] in space, at constant velocity.

    Args:
        acceleration_psd: spectral density [mm^2/s^3].
        jerk_psd: spectral density [mm^2/s^5].
    """

    def __init__(self, acceleration_psd: float, jerk_psd: float) -> None:
        self._white_acceleration = acceleration_psd
        self._white_jerk = jerk_psd
        self._time_ns: deque[int] = deque(maxlen=POINTS)
        self._place: deque[Array] = deque(maxlen=POINTS)
        self._spread: deque[Array] = deque(maxlen=POINTS)
        self._state: tuple[Array, Array] | None = None

    @property
    def is_complete(self) -> bool:
        """Whether there are points enough for velocity and acceleration."""
        return len(self._place) == POINTS

    def add(self, time_ns: int, position_mm: Array, covariance_mm2: Array) -> None:
        """Add a point, (3,) and (3, 3)."""
        self._time_ns.append(time_ns)
        self._place.append(position_mm)
        self._spread.append(covariance_mm2)
        self._state = self._differences() if self.is_complete else self._initial_state()

    def at(self, time_ns: int) -> tuple[Array, Array]:
        """Return position, velocity and acceleration, (9,), and covariance, (9, 9), at a time."""
        assert self._state is not None
        mean, covariance = self._state
        step_s = (time_ns - self._time_ns[-1]) * 1e-9
        if step_s <= 0.0:
            return mean, covariance
        transition, noise = cv_transition(step_s, self._white_acceleration)
        transition[2, 2], noise[2, 2] = 1.0, self._white_jerk * step_s
        whole = np.kron(transition, np.eye(3))
        return whole @ mean, whole @ covariance @ whole.T + np.kron(noise, np.eye(3))

    def _initial_state(self) -> tuple[Array, Array]:
        mean, covariance = np.zeros(9), np.zeros((9, 9))
        mean[:3], covariance[:3, :3] = self._place[-1], self._spread[-1]
        covariance[3:6, 3:6] = START_SPEED_MM_S**2 * np.eye(3)
        covariance[6:, 6:] = START_ACCELERATION_MM_S2**2 * np.eye(3)
        return mean, covariance

    def _differences(self) -> tuple[Array, Array]:
        first, centre, last = self._time_ns
        before_s, now_s = (centre - first) * 1e-9, (last - centre) * 1e-9
        half_s = (before_s + now_s) / 2.0
        # Rows: position, velocity, acceleration; columns: the three points.
        by_point = np.array([[0.0, 0.0, 1.0], [0.0, -1.0 / now_s, 1.0 / now_s], [0.0, 0.0, 0.0]])
        before = np.array([-1.0 / before_s, 1.0 / before_s, 0.0])
        by_point[2] = (by_point[1] - before) / half_s
        mean = (by_point @ np.array(self._place)).ravel()
        covariance = np.zeros((9, 9))
        for column, spread in zip(by_point.T, self._spread, strict=True):
            covariance += np.kron(np.outer(column, column), spread)
        velocity = self._white_acceleration * now_s * _MEAN_VELOCITY
        acceleration = self._white_jerk * half_s * _MEAN_ACCELERATION
        covariance[range(3, 9), range(3, 9)] += [velocity] * 3 + [acceleration] * 3
        return mean, covariance
