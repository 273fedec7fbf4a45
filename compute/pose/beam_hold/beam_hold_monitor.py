"""Beam-hold monitors: deviation of a pose or of markers from set-up (thesis, section 7.2.2)."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.camera.rotation import rotation_vector
from compute.errors import InvalidParameter
from compute.pose.beam_hold.beam_hold_limits import BeamHoldLimits
from compute.pose.beam_hold.beam_hold_state import (
    BeamHoldCause,
    BeamHoldGate,
    GateState,
    LimitCheck,
)
from compute.pose.transform import Transform

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BeamHoldDecision:
    """Whether the beam is held at a time, and why.

    Args:
        time_ns: time on the measurements' clock [ns].
        hold: whether it is held.
        cause: why.
        reason: the cause in words; None while it is not held.
        since_ns: beginning of the present state, held or not [ns].
        shift_mm: shift of the target, or of the marker that most probably exceeds its limit,
            shape (3,) [mm]; None: unknown.
        rotation_rad: rotation vector from the reference, shape (3,) [rad]; None: unknown.
        probability: largest probability of exceeding a limit; None: unknown.
    """

    time_ns: int
    hold: bool
    cause: BeamHoldCause
    reason: str | None
    since_ns: int
    shift_mm: Array | None = None
    rotation_rad: Array | None = None
    probability: float | None = None


class _DeviationMonitor:
    """Limits and the gate of a hold, common to the monitors."""

    def __init__(self, limits: BeamHoldLimits, *, latched: bool) -> None:
        self._limits = limits
        self._gate = BeamHoldGate(limits.rules, latched=latched)

    @property
    def measured_ns(self) -> int | None:
        """Time of the oldest data that were needed last [ns]; None: no data yet."""
        return self._gate.measured_ns

    @property
    def must_acknowledge(self) -> bool:
        """Whether a successor of this monitor must be acknowledged before it releases."""
        return self._gate.must_acknowledge

    def acknowledge(self) -> None:
        """End a latched hold once everything is within the release limits."""
        self._gate.acknowledge()

    def fail(self, why: str) -> BeamHoldDecision:
        """Hold now, as nothing usable is measured; ``why`` in words."""
        return _decision(self._gate.time_ns, self._gate.fail(why))

    def _step(
        self,
        time_ns: int,
        measured: LimitCheck | None,
        shift: Array | None = None,
        rotation: Array | None = None,
        probability: float | None = None,
    ) -> BeamHoldDecision:
        state = self._gate.step(time_ns, measured)
        return _decision(time_ns, state, shift, rotation, probability)


class PoseDeviationMonitor(_DeviationMonitor):
    """Compares a pose with the one at set-up.

    The states depend only on the given times and poses: a replay reproduces them. It fails safe:
    the beam is held until the first measurements are well within the limits, when no measurements
    arrive, and when they are too uncertain. The caller measures the latency from the time of the
    exposure to that of the signal.
    """

    def __init__(
        self,
        reference: Transform,
        limits: BeamHoldLimits,
        target_mm: Array | None = None,
        axes: Array | None = None,
        *,
        latched: bool = False,
    ) -> None:
        """Watch a target.

        Args:
            reference: T_world_body at set-up.
            limits: limits of its motion.
            target_mm: the point to be irradiated, in the body's coordinates, shape (3,) [mm];
                None: the body's origin.
            axes: R_axes_world of the axes of ``axis_mm``, such as the treatment room's, shape
                (3, 3); None: the world's.
            latched: see BeamHoldGate.
        """
        super().__init__(limits, latched=latched)
        self._reference = reference
        self._target = np.zeros(3) if target_mm is None else np.asarray(target_mm, np.float64)
        self._axes = np.eye(3) if axes is None else np.asarray(axes, np.float64)
        self._reference_position = reference.apply(self._target)
        self._reference_covariance = reference.point_covariance(self._target)

    def step(self, time_ns: int, pose: Transform | None) -> BeamHoldDecision:
        """Return the decision after a pose, or, with None, at a time without one.

        Args:
            time_ns: time of the exposure [ns].
            pose: T_world_body with its covariance; None: unknown or unusable.
        """
        if pose is None:
            return self._step(time_ns, None)
        shift = self._axes @ (pose.apply(self._target) - self._reference_position)
        covariance = pose.point_covariance(self._target) + self._reference_covariance
        covariance = self._axes @ covariance @ self._axes.T
        rotation = _rotation_vector(pose.rotation @ self._reference.rotation.T)
        rotation_covariance = np.zeros((3, 3))
        for one in (pose.covariance, self._reference.covariance):
            if one is not None:
                rotation_covariance += one[:3, :3]
        given = (shift, covariance, rotation, rotation_covariance)
        message, probability = self._limits.beyond(*given)
        back, _ = self._limits.beyond(*given, share=self._limits.release_fraction)
        reason = None if message is None else f"the target is {message}"
        return self._step(time_ns, LimitCheck(reason, back is None), shift, rotation, probability)


class MarkerDeviationMonitor(_DeviationMonitor):
    """Compares the positions of markers with those at set-up."""

    def __init__(
        self,
        reference_mm: Array,
        limits: BeamHoldLimits,
        min_markers: int = 3,
        names: tuple[str, ...] | None = None,
        *,
        latched: bool = False,
    ) -> None:
        """Watch markers.

        Args:
            reference_mm: reference positions, shape (M, 3) [mm].
            limits: limits of each marker's shift; ``rotation_rad`` must be None.
            min_markers: fewest visible markers that count as a measurement.
            names: names of the markers, for the reason; None: their numbers from 1.
            latched: see BeamHoldGate.

        Raises:
            InvalidParameter: there are fewer than ``min_markers`` markers, or a limit of rotation.
        """
        self._reference = np.asarray(reference_mm, np.float64)
        if not 1 <= min_markers <= len(self._reference):
            raise InvalidParameter(
                f"min_markers is {min_markers} of {len(self._reference)} markers"
            )
        if limits.rotation_rad is not None:
            raise InvalidParameter("markers do not turn; watch the pose of a tool for rotation_rad")
        super().__init__(limits, latched=latched)
        self._min_markers = min_markers
        self._names = names or tuple(str(one + 1) for one in range(len(self._reference)))

    def step(
        self,
        time_ns: int,
        positions_mm: Array | None,
        covariances_mm2: Array | None = None,
        times_ns: NDArray[np.int64] | None = None,
    ) -> BeamHoldDecision:
        """Return the decision after positions of the markers.

        Args:
            time_ns: time of the exposure [ns].
            positions_mm: shape (M, 3) [mm]; NaN where a marker is not visible; None: none is.
            covariances_mm2: shape (M, 3, 3) [mm^2]; None: exact.
            times_ns: time of each position, shape (M,) [ns]; None: all at ``time_ns``. The longest
                gap counts from the oldest of the markers that are needed.
        """
        if positions_mm is None:
            return self._step(time_ns, None)
        shifts = positions_mm - self._reference
        seen = np.flatnonzero(np.isfinite(shifts).all(axis=1))
        worst: tuple[float, float, int] = (-1.0, 0.0, -1)
        message: str | None = None
        within = True
        for one in seen:
            given = (shifts[one], None if covariances_mm2 is None else covariances_mm2[one])
            beyond, probability = self._limits.beyond(*given)
            within &= self._limits.beyond(*given, share=self._limits.release_fraction)[0] is None
            size = math.hypot(*shifts[one].tolist())
            if (probability, size) > worst[:2]:
                worst = (probability, size, int(one))
                message = None if beyond is None else f'marker "{self._names[one]}" is {beyond}'
        if len(seen) < self._min_markers and message is None:
            return self._step(time_ns, None)
        since_ns = time_ns
        if times_ns is not None:
            # The oldest of the newest ``min_markers``: a marker that moves unseen ages.
            since_ns = int(np.sort(times_ns[seen])[max(len(seen) - self._min_markers, 0)])
        measured = LimitCheck(message, within, since_ns)
        return self._step(time_ns, measured, shifts[worst[2]], None, worst[0])


def _rotation_vector(rotation: Array) -> Array:
    """Return a rotation vector; for rotations below 60 degrees in a tenth of the time."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation.tolist()
    cosine = 0.5 * (xx + yy + zz - 1.0)
    if cosine < 0.5:
        return rotation_vector(rotation)
    axis = 0.5 * (zy - yz), 0.5 * (xz - zx), 0.5 * (yx - xy)
    sine = math.hypot(*axis)
    return np.array(axis) * (math.atan2(sine, cosine) / sine if sine > 0.0 else 1.0)


def _decision(
    time_ns: int,
    found: GateState,
    shift: Array | None = None,
    rotation: Array | None = None,
    probability: float | None = None,
) -> BeamHoldDecision:
    return BeamHoldDecision(
        time_ns, found.hold, found.cause, found.reason, found.since_ns, shift, rotation, probability
    )
