"""Pose report: a filter state as a ToolPose, with status, reason and consistency test.

A calibration error is the same in all exposures, so residuals of several exposures are correlated.
The chi-square test therefore whitens the residuals of recent exposures jointly where their
sensitivities to the common errors are known.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import MeasurementModel
from compute.pose.estimation.observability import observability
from compute.pose.filtering.pose_filter import PoseState
from compute.pose.rigid_body import CentredMarkers, RigidBody
from compute.pose.settings import ToolTrackerSettings
from compute.pose.tool_pose import PoseStatus, ToolPose
from compute.reconstruction.triangulation import chi2_limit

Array = NDArray[np.float64]

_MIN_VARIANCE: Final = 0.05
"""Smallest variance of a combination of whitened readings: smaller ones are rounding errors."""


@dataclass(frozen=True, eq=False)
class ExposureResiduals:
    """Residuals of the readings of one exposure.

    Args:
        sum_of_squares: sum of their normalised squares, excluded readings included.
        count: number of readings.
        excluded: number of excluded readings of each marker, shape (M,).
        whitened: whitened innovations of the readings that were used, and their Jacobian with
            respect to the common errors, shape (n, 1 + E); None: unknown.
    """

    sum_of_squares: float
    count: int
    excluded: NDArray[np.intp]
    whitened: Array | None = None

    @cached_property
    def any_excluded(self) -> bool:
        """Whether any reading was excluded."""
        return bool(np.count_nonzero(self.excluded))


def chi2_test(
    exposures: Sequence[ExposureResiduals], probability: float
) -> tuple[float, int, float]:
    """Return the sum of squares of several exposures, the number of readings, and the limit.

    Where the sum is too large for independent errors, and the common errors are known, it is that
    of the jointly whitened readings.

    Args:
        exposures: residuals of the exposures.
        probability: probability that correct readings are rejected.
    """
    sum_of_squares = sum(one.sum_of_squares for one in exposures)
    count = sum(one.count for one in exposures)
    limit = _limit(count, probability)
    if sum_of_squares > limit:
        known = [one.whitened for one in exposures if one.whitened is not None]
        if known and known[0].shape[1] > 1:
            sum_of_squares = min(sum_of_squares, _jointly_whitened(sum_of_squares, known))
    return sum_of_squares, count, limit


_limit: Final = lru_cache(maxsize=1024)(chi2_limit)


def _jointly_whitened(sum_of_squares: float, whitened: Sequence[Array]) -> float:
    """Return the sum of squares with the innovations of all exposures whitened jointly."""
    value = np.concatenate([one[:, 0] for one in whitened])
    common = np.concatenate([one[:, 1:] for one in whitened])
    covariance = common @ common.T
    first = 0
    for one in whitened:
        own = slice(first, first + len(one))
        covariance[own, own] = np.eye(len(one))
        first += len(one)
    size, axes = np.linalg.eigh(covariance)
    alone = float(value @ value)
    along = axes.T @ value
    return sum_of_squares - alone + float((along**2 / np.maximum(size, _MIN_VARIANCE)).sum())


@dataclass(frozen=True, eq=False)
class TrackSupport:
    """Readings that a tool's pose is based on.

    Args:
        nis: normalised innovation squared of each of its last frames.
        readings: number of readings of each.
        sensors: which sensor read which marker, shape (M, S).
    """

    nis: tuple[float, ...]
    readings: tuple[int, ...]
    sensors: NDArray[np.bool_]

    @property
    def residual_sigma(self) -> float | None:
        """Root of the mean normalised innovation squared per reading; None without any."""
        count = sum(self.readings)
        return sqrt(sum(self.nis) / count) if count else None


def missing_pose(
    tool: RigidBody, status: PoseStatus, reason: str, time_ns: int, sequence: int
) -> ToolPose:
    """Return a ToolPose without a pose.

    Args:
        tool: the tool.
        status: why there is no pose.
        reason: the same in words.
        time_ns: middle of the exposure [ns].
        sequence: number of the frame.
    """
    return ToolPose(tool.name, status, reason, time_ns, sequence)


def report(
    tool: RigidBody,
    state: PoseState,
    support: TrackSupport,
    sequence: int,
    outside: str | None,
    settings: ToolTrackerSettings,
) -> ToolPose:
    """Return the pose of a tracked tool.

    Args:
        tool: the tool.
        state: state of its filter.
        support: readings that the state is based on.
        sequence: number of the frame.
        outside: which part of the tool is outside the calibrated volume; None: none.
        settings: limits.
    """
    centred = CentredMarkers.of(tool)
    here = state.covariance[:6, :6]
    most = (settings.fit.max_sigma_fraction * centred.radius_mm) ** 2
    a, b, c, x, y, z = here.diagonal().tolist()
    # The trace bounds the largest eigenvalue and is much cheaper: it is checked first.
    if not centred.radius_mm**2 * (a + b + c) + (x + y + z) <= most:
        radius = np.array([centred.radius_mm] * 3 + [1.0] * 3)
        scaled = here * (radius[:, None] * radius)
        if not np.linalg.eigvalsh(scaled)[-1] <= most:
            judged = observability(np.linalg.inv(scaled), centred, support.sensors, settings.fit)
            why = judged.reason or "the pose is not told by what was seen"
            return missing_pose(tool, PoseStatus.MISSING, why, state.time_ns, sequence)
    reported_pose = state.reported_pose(centred)
    tip_sd = sqrt(reported_pose.tip_covariance_mm2.trace())
    limit = settings.max_tip_sd_mm if tool.max_tip_sd_mm is None else tool.max_tip_sd_mm
    used = int(np.count_nonzero(support.sensors))
    markers = sum(map(any, support.sensors.tolist()))
    status = PoseStatus.OK
    reason: str | None = None
    if tip_sd > limit:
        status = PoseStatus.HIGH_ERROR
        reason = (
            f"the tip's standard deviation is {tip_sd:.3g} mm, of {used} readings of "
            f"{markers} of {len(tool)} markers; "
            f"{limit:.3g} mm is the most"
        )
    elif outside is not None:
        status, reason = PoseStatus.OUT_OF_VOLUME, outside
    return ToolPose(
        tool.name,
        status,
        reason,
        state.time_ns,
        sequence,
        reported_pose.rotation,
        reported_pose.translation_mm,
        reported_pose.covariance,
        reported_pose.tip_mm,
        reported_pose.tip_covariance_mm2,
        support.residual_sigma,
        markers,
        used,
        reported_pose.velocity_mm_s,
        reported_pose.angular_velocity_rad_s,
    )


def outside_volume(
    model: MeasurementModel,
    tool: RigidBody,
    state: PoseState,
    support: TrackSupport,
    settings: ToolTrackerSettings,
) -> str | None:
    """Return, in words, which part of a tool is outside the calibrated volume or the table's hull.

    Args:
        model: the cameras, with the correction table.
        tool: the tool.
        state: state of its filter.
        support: readings that the state is based on.
        settings: the calibrated volume.

    Returns:
        None where all of the tool is inside.
    """
    centred = CentredMarkers.of(tool)
    if settings.volume_mm is not None:
        low, high = np.array(settings.volume_mm)
        tip = state.centroid_mm + state.rotation @ centred.tip_mm
        names = ["the tip", *(f"marker {index + 1}" for index in range(len(tool)))]
        marker_positions = np.vstack([tip, state.marker_positions(centred)])
        beyond = ((marker_positions < low) | (marker_positions > high)).any(axis=1)
        if beyond.any():
            place = marker_positions[beyond][0]
            out = [name for name, far in zip(names, beyond, strict=True) if far]
            return (
                f"{_listed(out)} outside of the volume of the calibration, at {_place(place)}; it "
                f"reaches from {_place(low)} to {_place(high)}"
            )
    if model.corrections is not None:
        inside = model.inside_hull(state.marker_positions(centred))
        foreign = (support.sensors & ~inside).any(axis=1)
        if foreign.any():
            names = [f"marker {index + 1}" for index in np.flatnonzero(foreign)]
            return f"{_listed(names)} where the correction table does not vouch for its readings"
    return None


def _listed(names: Sequence[str]) -> str:
    if len(names) == 1:
        return f"{names[0]} is"
    return f"{', '.join(names[:-1])} and {names[-1]} are"


def _place(place: Array) -> str:
    return "(" + ", ".join(f"{value:.0f}" for value in place) + ") mm"
