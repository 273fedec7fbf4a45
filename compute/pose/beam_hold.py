"""Beam holds: limits of a patient's motion, and monitors that hold the beam beyond them.

Monitors compare a pose, or the positions of markers, with those at set-up (thesis, section 7.2.2).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from operator import itemgetter
from typing import Final

import numpy as np
from numpy.polynomial.hermite_e import hermegauss
from numpy.typing import NDArray
from scipy.special import ndtr

from compute.camera.model import Vector3
from compute.errors import InvalidParameter
from compute.transform import Transform, rotation_vector

Array = NDArray[np.float64]

_NODES: Final = 32
_ABSCISSAE, _WEIGHTS = hermegauss(_NODES)
_PRODUCT_WEIGHTS: Final = np.outer(_WEIGHTS, _WEIGHTS) / _WEIGHTS.sum() ** 2
_CERTAIN_SIGMAS: Final = 8.0
"""Number of standard deviations beyond which a limit is certainly (1e-14) kept or exceeded."""


class BeamHoldCause(StrEnum):
    """Why the beam is held."""

    NONE = "none"
    """It is not."""
    NO_DATA = "no-data"
    """Nothing was measured yet, or for too long."""
    MOVED = "moved"
    """The patient is, or may be, out of tolerance."""
    SETTLING = "settling"
    """The patient is back, and not yet for long enough."""
    LATCHED = "latched"
    """The patient is back; somebody has to acknowledge what happened."""
    CLOCK = "clock"
    """Time went back."""


@dataclass(frozen=True)
class BeamHoldTiming:
    """Timing rules of the begin and end of a beam hold.

    Args:
        max_gap_ns: longest time without a measurement before the beam is held [ns].
        settle_ns: how long all has to be within the release limits before the beam goes on [ns].
        latched: whether a hold, after the first release, lasts until it is acknowledged.
    """

    max_gap_ns: int = 100_000_000
    settle_ns: int = 500_000_000
    latched: bool = False

    def __post_init__(self) -> None:
        if self.max_gap_ns <= 0:
            raise InvalidParameter(f"max_gap_ns is {self.max_gap_ns}; it must be above 0")
        if self.settle_ns < 0:
            raise InvalidParameter(f"settle_ns is {self.settle_ns}; it must not be negative")


@dataclass(frozen=True)
class BeamHoldLimits:
    """Limits on the motion of a patient.

    Args:
        shift_mm: largest distance of the target, or of a marker, from its reference position
            [mm]; None: unlimited.
        axis_mm: largest shift along each axis [mm]; None: unlimited.
        rotation_rad: largest rotation [rad]; None: unlimited. Not for markers.
        probability: the beam is held when the probability of exceeding a limit is above this. 0.5
            ignores the uncertainty, smaller values hold earlier.
        release_fraction: fraction of the limits within which, at the same probability, a hold may
            end.
        rules: longest gap, settling time, latch.
    """

    shift_mm: float | None = None
    axis_mm: Vector3 | None = None
    rotation_rad: float | None = None
    probability: float = 0.05
    release_fraction: float = 0.8
    rules: BeamHoldTiming = field(default_factory=BeamHoldTiming)

    def __post_init__(self) -> None:
        limits = [self.shift_mm, self.rotation_rad, *(self.axis_mm or ())]
        set_limits = [one for one in limits if one is not None]
        if not set_limits or not all(one > 0.0 and np.isfinite(one) for one in set_limits):
            raise InvalidParameter(
                f"the limits are shift {self.shift_mm}, axes {self.axis_mm}, rotation "
                f"{self.rotation_rad}; give at least one, above 0"
            )
        if not 0.0 < self.probability <= 0.5:
            raise InvalidParameter(
                f"probability is {self.probability}; it must be above 0, at most 0.5"
            )
        if not 0.0 < self.release_fraction <= 1.0:
            raise InvalidParameter(
                f"release_fraction is {self.release_fraction}; it must be above 0, at most 1"
            )

    def check(
        self,
        shift_mm: Array,
        shift_covariance: Array | None,
        rotation_rad: Array | None = None,
        rotation_covariance: Array | None = None,
    ) -> tuple[str | None, bool, float]:
        """Compare a deviation with the limits and with the release limits.

        Args:
            shift_mm: shift from the reference position, shape (3,) [mm].
            shift_covariance: its covariance, shape (3, 3) [mm^2]; None: exact.
            rotation_rad: rotation vector from the reference, shape (3,) [rad]; None: not checked.
            rotation_covariance: its covariance, shape (3, 3) [rad^2]; None: exact.

        Returns:
            The limit that is most probably exceeded, in words, None where no probability is above
            ``probability``; whether all is within the release limits; and the largest of the
            probabilities.
        """
        (probability, size, limit, message), (release_probability, *_) = (
            max(
                self._exceedances(
                    shift_mm, shift_covariance, rotation_rad, rotation_covariance, share
                ),
                key=itemgetter(0),
            )
            for share in (1.0, self.release_fraction)
        )
        within = release_probability <= self.probability
        if probability <= self.probability:
            return None, within, probability
        message = message.format(size=size, limit=limit)
        if probability < 0.5:
            message += f", with a probability of {probability:.0%} to be beyond it; "
            message += f"at most {self.probability:.0%}"
        return message, within, probability

    def _exceedances(
        self,
        shift_mm: Array,
        shift_covariance: Array | None,
        rotation_rad: Array | None,
        rotation_covariance: Array | None,
        share: float,
    ) -> Iterator[tuple[float, float, float, str]]:
        """Yield for each limit its probability of being exceeded, size, limit, and a message."""
        if self.shift_mm is not None:
            limit = share * self.shift_mm
            yield (
                norm_exceedance_probability(shift_mm, shift_covariance, limit),
                math.hypot(*shift_mm.tolist()),
                limit,
                "{size:.2f} mm off its reference position (limit {limit:.2f} mm)",
            )
        for axis, axis_limit in enumerate(self.axis_mm or ()):
            size, limit = float(shift_mm[axis]), share * axis_limit
            variance = 0.0 if shift_covariance is None else float(shift_covariance[axis, axis])
            yield (
                scalar_exceedance_probability(size, variance, limit),
                size,
                limit,
                f"{{size:.2f}} mm off along {'xyz'[axis]} (limit {{limit:.2f}} mm)",
            )
        if self.rotation_rad is not None and rotation_rad is not None:
            limit = share * self.rotation_rad
            yield (
                norm_exceedance_probability(rotation_rad, rotation_covariance, limit),
                math.degrees(math.hypot(*rotation_rad.tolist())),
                math.degrees(limit),
                "turned by {size:.2f} deg (limit {limit:.2f} deg)",
            )


def norm_exceedance_probability(mean: Array, covariance: Array | None, limit: float) -> float:
    """Return P(|x| > limit) of a normally distributed 3-vector x.

    Integrated in closed form along the axis of the largest variance, and by Gauss-Hermite
    quadrature along the other two: to 0.02 where the standard deviations are as large as the limit,
    far better where they are smaller.

    Args:
        mean: shape (3,).
        covariance: shape (3, 3); None: x is exact.
        limit: the limit, in the unit of the mean.
    """
    length = math.hypot(*mean.tolist())
    if covariance is None:
        return float(length > limit)
    # The trace bounds the largest variance and is much cheaper than the eigenvalues: it is checked
    # first. A short mean may be exceeded by deviations in all three directions together.
    reach = _CERTAIN_SIGMAS * math.sqrt(max(float(covariance.trace()), 0.0)) + 1e-12 * limit
    if length + reach < limit:
        return 0.0
    if length - reach > limit:
        return 1.0
    values, axes = np.linalg.eigh(covariance)
    sigma = np.sqrt(np.maximum(values, 0.0))
    if length - limit > _CERTAIN_SIGMAS * sigma[2] + 1e-12 * limit:
        return 1.0
    if not sigma[2] > 0.0:
        return float(length > limit)
    along = axes.T @ mean
    first = (along[0] + sigma[0] * _ABSCISSAE)[:, None]
    second = along[1] + sigma[1] * _ABSCISSAE
    square = limit**2 - first**2 - second**2
    half = np.sqrt(np.maximum(square, 0.0))
    inside = ndtr((half - along[2]) / sigma[2]) - ndtr((-half - along[2]) / sigma[2])
    return float(np.clip(1.0 - (_PRODUCT_WEIGHTS * inside).sum(), 0.0, 1.0))


def scalar_exceedance_probability(mean: float, variance: float, limit: float) -> float:
    """Return P(|x| > limit) of a normally distributed number x.

    Args:
        mean: mean of x.
        variance: its variance, 0 where x is exact.
        limit: the limit, in the unit of the mean.
    """
    if not variance > 0.0:
        return float(abs(mean) > limit)
    sigma = math.sqrt(variance)
    if abs(mean) + _CERTAIN_SIGMAS * sigma < limit:
        return 0.0
    return float(ndtr((mean - limit) / sigma) + ndtr((-mean - limit) / sigma))


@dataclass(frozen=True, eq=False)
class BeamHoldDecision:
    """State of a beam hold at one time, with its cause.

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


@dataclass(frozen=True, eq=False)
class _Deviation:
    """Deviation from set-up, compared with the limits.

    Args:
        beyond: what is, or may be, out of tolerance, in words; None: nothing.
        within: whether everything is within the release limits.
        time_ns: time of the oldest data that it needs [ns].
        shift_mm: as in BeamHoldDecision, like those that follow.
    """

    beyond: str | None
    within: bool
    time_ns: int
    shift_mm: Array
    rotation_rad: Array | None
    probability: float


class _DeviationMonitor:
    """State machine of a hold: held initially, beyond a limit, and without valid data.

    The states depend only on the given times and measurements: a replay reproduces them. It fails
    safe: the beam is held until the first measurements are well within the limits, when no
    measurements arrive, and when they are too uncertain. The caller measures the latency from the
    time of the exposure to that of the signal.
    """

    def __init__(self, limits: BeamHoldLimits, *, latched: bool) -> None:
        """Begin held.

        Args:
            limits: limits of the motion, and the rules of holds.
            latched: whether the first hold lasts until it is acknowledged, as one that goes on
                from another monitor's; whatever the rules say of later ones.
        """
        self._limits, self._rules = limits, limits.rules
        self._time: int | None = None
        self._measured_ns: int | None = None
        self._within_since: int | None = None
        self._released = False
        self._latched = latched
        self._decision: BeamHoldDecision | None = None
        self._why = "nothing was measured yet"
        self._cause = BeamHoldCause.NO_DATA

    def fail(self, why: str) -> BeamHoldDecision:
        """Hold now: there are no measurements, or they are unusable.

        For failures that the times of the measurements do not show. The next measurement may have
        any time.

        Args:
            why: the reason in words.
        """
        time_ns = self._time or 0
        self._hold(BeamHoldCause.NO_DATA, why)
        self._time = self._measured_ns = None
        return self._decide(time_ns, None, counts=False)

    @property
    def measured_ns(self) -> int | None:
        """Time of the oldest data that were needed last [measurements' clock, ns]; None: none."""
        return self._measured_ns

    @property
    def must_acknowledge(self) -> bool:
        """Whether a successor of this monitor must be acknowledged before it releases."""
        return self._latched or (self._rules.latched and self._released)

    def acknowledge(self) -> None:
        """End the latch; the hold ends once all is, and stays, within the release limits."""
        self._latched = False

    def _advance(self, time_ns: int, measured: _Deviation | None) -> BeamHoldDecision:
        """Return the decision after a measurement, or, with None, at a time without one."""
        max_gap_ns = self._rules.max_gap_ns
        gap = None if self._measured_ns is None else time_ns - self._measured_ns
        if self._time is not None and time_ns < self._time:
            self._hold(BeamHoldCause.CLOCK, "the measurements' time went back")
            self._measured_ns = None
        elif gap is not None and gap > max_gap_ns:
            self._hold(
                BeamHoldCause.NO_DATA,
                f"nothing was measured for {gap * 1e-6:.0f} ms; at most "
                f"{max_gap_ns * 1e-6:.0f} ms are allowed",
            )
        self._time = time_ns
        # Data older than the longest gap count as no measurement.
        counts = measured is not None and (
            measured.beyond is not None or time_ns - measured.time_ns <= max_gap_ns
        )
        if measured is not None and counts:
            since_ns = measured.time_ns
            self._measured_ns = (
                since_ns if self._measured_ns is None else max(since_ns, self._measured_ns)
            )
            if measured.beyond is not None:
                self._hold(BeamHoldCause.MOVED, measured.beyond)
            elif not measured.within:
                # Hysteresis: between release limit and limit the state stays as it is.
                self._within_since = None
            elif self._within_since is None:
                self._within_since = time_ns
        return self._decide(time_ns, measured, counts=counts)

    def _hold(self, cause: BeamHoldCause, why: str) -> None:
        self._cause, self._why = cause, why
        self._within_since = None
        self._latched = self._latched or (self._rules.latched and self._released)
        self._released = False

    def _decide(
        self, time_ns: int, measured: _Deviation | None, *, counts: bool
    ) -> BeamHoldDecision:
        since, settle = self._within_since, self._rules.settle_ns
        waited = None if since is None else time_ns - since
        if not self._released and waited is not None and waited >= settle and not self._latched:
            # Release only on a measurement, never because time passed.
            self._released = counts
        cause, reason = BeamHoldCause.NONE, None
        if not self._released:
            cause, reason = self._cause, self._why
            if waited is not None:
                cause = BeamHoldCause.LATCHED if self._latched else BeamHoldCause.SETTLING
                still = (
                    "back within limits; to be acknowledged"
                    if self._latched
                    else f"back within limits for {waited * 1e-6:.0f} of {settle * 1e-6:.0f} ms"
                )
                reason = f"{self._why}; {still}"
        before = self._decision
        same = before is not None and before.hold != self._released
        self._decision = BeamHoldDecision(
            time_ns,
            not self._released,
            cause,
            reason,
            before.since_ns if before is not None and same else time_ns,
            None if measured is None else measured.shift_mm,
            None if measured is None else measured.rotation_rad,
            None if measured is None else measured.probability,
        )
        return self._decision


class PoseDeviationMonitor(_DeviationMonitor):
    """Compares a pose with the one at set-up."""

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
            latched: whether the first hold lasts until it is acknowledged.
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
            return self._advance(time_ns, None)
        shift = self._axes @ (pose.apply(self._target) - self._reference_position)
        covariance = pose.point_covariance(self._target) + self._reference_covariance
        covariance = self._axes @ covariance @ self._axes.T
        rotation = _rotation_vector(pose.rotation @ self._reference.rotation.T)
        rotation_covariance = np.zeros((3, 3))
        for one in (pose.covariance, self._reference.covariance):
            if one is not None:
                rotation_covariance += one[:3, :3]
        message, within, probability = self._limits.check(
            shift, covariance, rotation, rotation_covariance
        )
        beyond = None if message is None else f"the target is {message}"
        deviation = _Deviation(beyond, within, time_ns, shift, rotation, probability)
        return self._advance(time_ns, deviation)


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
            latched: whether the first hold lasts until it is acknowledged.

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
            return self._advance(time_ns, None)
        shifts = positions_mm - self._reference
        visible = np.flatnonzero(np.isfinite(shifts).all(axis=1))
        worst: tuple[float, float, int] = (-1.0, 0.0, -1)
        message: str | None = None
        within = True
        for one in visible:
            covariance = None if covariances_mm2 is None else covariances_mm2[one]
            beyond, is_within, probability = self._limits.check(shifts[one], covariance)
            within &= is_within
            size = math.hypot(*shifts[one].tolist())
            if (probability, size) > worst[:2]:
                worst = (probability, size, int(one))
                message = None if beyond is None else f'marker "{self._names[one]}" is {beyond}'
        if len(visible) < self._min_markers and message is None:
            return self._advance(time_ns, None)
        since_ns = time_ns
        if times_ns is not None:
            # The oldest of the newest ``min_markers``: a marker that moves unseen ages.
            since_ns = int(np.sort(times_ns[visible])[max(len(visible) - self._min_markers, 0)])
        probability, _, marker = worst
        deviation = _Deviation(message, within, since_ns, shifts[marker], None, probability)
        return self._advance(time_ns, deviation)


def _rotation_vector(rotation: Array) -> Array:
    """Return a rotation vector; for rotations below 60 degrees in a tenth of the time."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation.tolist()
    cosine = 0.5 * (xx + yy + zz - 1.0)
    if cosine < 0.5:
        return rotation_vector(rotation)
    axis = 0.5 * (zy - yz), 0.5 * (xz - zx), 0.5 * (yx - xy)
    sine = math.hypot(*axis)
    return np.array(axis) * (math.atan2(sine, cosine) / sine if sine > 0.0 else 1.0)
