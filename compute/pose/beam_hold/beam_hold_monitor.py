"""PoseDeviationMonitor: beam hold when a patient leaves the tolerance (thesis, section 7.2.2)."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import Vector3
from compute.camera.rotation import rotation_vector
from compute.errors import InvalidParameter
from compute.pose.beam_hold.beam_hold_state import (
    BeamHoldCause,
    BeamHoldGate,
    BeamHoldTiming,
    GateState,
    LimitCheck,
)
from compute.pose.beam_hold.exceedance_probability import (
    norm_exceedance_probability,
    scalar_exceedance_probability,
)
from compute.pose.transform import Transform

Array = NDArray[np.float64]

_AXES: Final = "xyz"


@dataclass(frozen=True)
class BeamHoldLimits:
    """How far a patient may move.

    Args:
        shift_mm: largest distance of the target, or of a marker, from its place [mm]; None: any.
        axis_mm: largest shift along each axis [mm]; None: any.
        rotation_rad: largest turn [rad]; None: any. Not for markers.
        probability: the beam is held when that of being beyond a limit is above this. 0.5 leaves
            uncertainty aside, less holds sooner.
        release_fraction: share of the limits within which, by the same probability, a hold may end.
        rules: gap, settling, latch.
    """

    shift_mm: float | None = None
    axis_mm: Vector3 | None = None
    rotation_rad: float | None = None
    probability: float = 0.05
    release_fraction: float = 0.8
    rules: BeamHoldTiming = field(default_factory=BeamHoldTiming)

    def __post_init__(self) -> None:
        limits = [self.shift_mm, self.rotation_rad, *(self.axis_mm or ())]
        given = [one for one in limits if one is not None]
        if not given or not all(one > 0.0 and np.isfinite(one) for one in given):
            raise InvalidParameter(
                f"the limits are shift {self.shift_mm}, axes {self.axis_mm}, turn "
                f"{self.rotation_rad}; "
                "give at least one, above 0"
            )
        if not 0.0 < self.probability <= 0.5:
            raise InvalidParameter(
                f"probability is {self.probability}; it must be above 0, at most 0.5"
            )
        if not 0.0 < self.release_fraction <= 1.0:
            raise InvalidParameter(
                f"release_fraction is {self.release_fraction}; it must be above 0, at most 1"
            )

    def beyond(
        self,
        shift_mm: Array,
        shift_covariance: Array | None,
        rotation_rad: Array | None = None,
        rotation_covariance: Array | None = None,
        share: float = 1.0,
    ) -> tuple[str | None, float]:
        """Return what is beyond ``share`` of a limit, for a person, and its probability."""
        worst, message = -1.0, ""
        for probability, what in self._exceedance_probabilities(
            shift_mm, shift_covariance, rotation_rad, rotation_covariance, share
        ):
            if probability > worst:
                worst, message = probability, what
        if worst <= self.probability:
            return None, worst
        message = self._describe(message, shift_mm, rotation_rad, share)
        if worst < 0.5:
            message += f", with a probability of {worst:.0%} to be beyond it; "
            message += f"at most {self.probability:.0%}"
        return message, worst

    def _exceedance_probabilities(
        self,
        shift_mm: Array,
        shift_covariance: Array | None,
        rotation_rad: Array | None,
        rotation_covariance: Array | None,
        share: float,
    ) -> Iterator[tuple[float, str]]:
        """Yield the probability of being beyond ``share`` of each limit, and which that is."""
        if self.shift_mm is not None:
            yield (
                norm_exceedance_probability(shift_mm, shift_covariance, share * self.shift_mm),
                "shift",
            )
        for axis, most in enumerate(self.axis_mm or ()):
            variance = 0.0 if shift_covariance is None else float(shift_covariance[axis, axis])
            yield (
                scalar_exceedance_probability(float(shift_mm[axis]), variance, share * most),
                _AXES[axis],
            )
        if self.rotation_rad is not None and rotation_rad is not None:
            yield (
                norm_exceedance_probability(
                    rotation_rad, rotation_covariance, share * self.rotation_rad
                ),
                "turn",
            )

    def _describe(
        self, what: str, shift_mm: Array, rotation_rad: Array | None, share: float
    ) -> str:
        if what == "shift":
            size, limit = float(np.linalg.norm(shift_mm)), share * (self.shift_mm or 0.0)
            return f"{size:.2f} mm off its place (limit {limit:.2f} mm)"
        if what == "turn":
            size = float(np.linalg.norm(rotation_rad)) if rotation_rad is not None else 0.0
            limit = np.degrees(share * (self.rotation_rad or 0.0))
            return f"turned by {np.degrees(size):.2f} deg (limit {limit:.2f} deg)"
        axis = _AXES.index(what)
        most = share * (self.axis_mm or (0.0, 0.0, 0.0))[axis]
        return f"{shift_mm[axis]:.2f} mm off along {what} (limit {most:.2f} mm)"


@dataclass(frozen=True, eq=False)
class BeamHoldDecision:
    """Whether the beam is held at an instant, and why.

    Args:
        time_ns: the instant, on the measurements' clock [ns].
        hold: whether it is held.
        cause: why.
        reason: the same for a person; None while it is not held.
        since_ns: when the present state, held or not, began [ns].
        shift_mm: of the target, or the marker that moved most, shape (3,) [mm]; None: not known.
        rotation_rad: rotation vector from the reference, shape (3,) [rad]; None: not known.
        probability: of being beyond the limit that is nearest to it; None: not known.
    """

    time_ns: int
    hold: bool
    cause: BeamHoldCause
    reason: str | None
    since_ns: int
    shift_mm: Array | None = None
    rotation_rad: Array | None = None
    probability: float | None = None


class PoseDeviationMonitor:
    """Watches a pose beside the one that it had at set-up.

    A function of the times and poses that it was given: a replay gives the same states. Safe
    when in doubt: held until the first measurements are well within, when none come, and when
    they are too uncertain. Latency is the caller's to measure, from the exposure's time to the
    instant at which the signal leaves.
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
            limits: how far it may move.
            target_mm: the point to be irradiated, in the body's coordinates, shape (3,) [mm];
                None: the body's origin.
            axes: R_axes_world of the axes of ``axis_mm``, such as the treatment room's, shape
                (3, 3); None: the world's.
        """
        self._reference, self._limits = reference, limits
        self._target = np.zeros(3) if target_mm is None else np.asarray(target_mm, np.float64)
        self._axes = np.eye(3) if axes is None else np.asarray(axes, np.float64)
        self._reference_position = reference.apply(self._target)
        self._reference_covariance = reference.point_covariance(self._target)
        self._gate = BeamHoldGate(limits.rules, latched=latched)

    @property
    def measured_ns(self) -> int | None:
        """When the oldest of what is needed was measured [ns]; None: not yet."""
        return self._gate.measured_ns

    @property
    def must_acknowledge(self) -> bool:
        """Whether what goes on from here has to be acknowledged before it releases."""
        return self._gate.must_acknowledge

    def acknowledge(self) -> None:
        """End a latched hold, once all is back."""
        self._gate.acknowledge()

    def fail(self, why: str) -> BeamHoldDecision:
        """Hold now, as nothing usable is measured; ``why`` for a person."""
        return _to_state(self._gate.time_ns, self._gate.fail(why))

    def step(self, time_ns: int, pose: Transform | None) -> BeamHoldDecision:
        """Return the state after a pose, or, with None, at a time without one.

        Args:
            time_ns: of the exposure [ns].
            pose: T_world_body with its covariance; None: it is not known, or not to be used.
        """
        if pose is None:
            return _step_gate(time_ns, self._gate, None)
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
        return _step_gate(
            time_ns, self._gate, LimitCheck(reason, back is None), shift, rotation, probability
        )


class MarkerDeviationMonitor:
    """Watches a set of markers, each beside the place that it had at set-up."""

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
            reference_mm: where they are to be, shape (M, 3) [mm].
            limits: how far each may move; ``rotation_rad`` means nothing here.
            min_markers: with fewer of them seen, nothing was measured.
            names: of the markers, for the reason; None: their numbers from 1.
            latched: see BeamHoldGate.

        Raises:
            InvalidParameter: there are fewer markers, or a limit of turns.
        """
        self._reference = np.asarray(reference_mm, np.float64)
        if not 1 <= min_markers <= len(self._reference):
            raise InvalidParameter(
                f"min_markers is {min_markers} of {len(self._reference)} markers"
            )
        if limits.rotation_rad is not None:
            raise InvalidParameter("markers do not turn; watch the pose of a tool for rotation_rad")
        self._limits, self._min_markers = limits, min_markers
        self._names = names or tuple(str(one + 1) for one in range(len(self._reference)))
        self._gate = BeamHoldGate(limits.rules, latched=latched)

    @property
    def measured_ns(self) -> int | None:
        """When the oldest of what is needed was measured [ns]; None: not yet."""
        return self._gate.measured_ns

    @property
    def must_acknowledge(self) -> bool:
        """Whether what goes on from here has to be acknowledged before it releases."""
        return self._gate.must_acknowledge

    def acknowledge(self) -> None:
        """End a latched hold, once all is back."""
        self._gate.acknowledge()

    def fail(self, why: str) -> BeamHoldDecision:
        """Hold now, as nothing usable is measured; ``why`` for a person."""
        return _to_state(self._gate.time_ns, self._gate.fail(why))

    def step(
        self,
        time_ns: int,
        positions_mm: Array | None,
        covariances_mm2: Array | None = None,
        times_ns: NDArray[np.int64] | None = None,
    ) -> BeamHoldDecision:
        """Return the state after positions of the markers.

        Args:
            time_ns: of the exposure [ns].
            positions_mm: shape (M, 3) [mm]; NaN where a marker is not seen; None: none is.
            covariances_mm2: shape (M, 3, 3) [mm^2]; None: exact.
            times_ns: when each was seen, shape (M,) [ns]; None: all now. The longest gap counts
                from the oldest of the markers that are needed.
        """
        if positions_mm is None:
            return _step_gate(time_ns, self._gate, None)
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
            return _step_gate(time_ns, self._gate, None)
        since_ns = time_ns
        if times_ns is not None:
            # Of the newest that are enough, the oldest: one that moves unseen is not forgotten.
            since_ns = int(np.sort(times_ns[seen])[max(len(seen) - self._min_markers, 0)])
        measured = LimitCheck(message, within, since_ns)
        return _step_gate(time_ns, self._gate, measured, shifts[worst[2]], None, worst[0])


def _rotation_vector(rotation: Array) -> Array:
    """Return a rotation vector; of turns below 60 degrees in a tenth of the time."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation.tolist()
    cosine = 0.5 * (xx + yy + zz - 1.0)
    if cosine < 0.5:
        return rotation_vector(rotation)
    axis = 0.5 * (zy - yz), 0.5 * (xz - zx), 0.5 * (yx - xy)
    sine = math.hypot(*axis)
    return np.array(axis) * (math.atan2(sine, cosine) / sine if sine > 0.0 else 1.0)


def _step_gate(
    time_ns: int,
    gate: BeamHoldGate,
    measured: LimitCheck | None,
    shift: Array | None = None,
    rotation: Array | None = None,
    probability: float | None = None,
) -> BeamHoldDecision:
    return _to_state(time_ns, gate.step(time_ns, measured), shift, rotation, probability)


def _to_state(
    time_ns: int,
    found: GateState,
    shift: Array | None = None,
    rotation: Array | None = None,
    probability: float | None = None,
) -> BeamHoldDecision:
    return BeamHoldDecision(
        time_ns, found.hold, found.cause, found.reason, found.since_ns, shift, rotation, probability
    )
