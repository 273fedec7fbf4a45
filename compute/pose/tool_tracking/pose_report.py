"""Pose report: a filter state as a ToolPose, with status and reason."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import MeasurementModel
from compute.pose.centred_markers import CentredMarkers
from compute.pose.estimation.observability import observability
from compute.pose.filtering.pose_filter import PoseState
from compute.pose.rigid_body import RigidBody
from compute.pose.settings import ToolTrackerSettings
from compute.pose.tool_pose import PoseStatus, ToolPose

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TrackSupport:
    """What the pose of a tool rests on.

    Args:
        nis: normalised innovations squared of its last frames.
        readings: how many readings of each.
        sensors: which sensor read which marker, shape (M, S).
    """

    nis: tuple[float, ...]
    readings: tuple[int, ...]
    sensors: NDArray[np.bool_]

    @property
    def residual_sigma(self) -> float | None:
        """Root of the innovations squared per reading; None without any."""
        count = sum(self.readings)
        return sqrt(sum(self.nis) / count) if count else None


def missing_pose(
    tool: RigidBody, status: PoseStatus, reason: str, time_ns: int, sequence: int
) -> ToolPose:
    """Return that there is no pose, and why."""
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
        state: of its filter.
        support: what the state rests on.
        sequence: number of the frame.
        outside: what of it lies outside of the volume that is vouched for; None: nothing.
        settings: limits.
    """
    centred = CentredMarkers.of(tool)
    here = state.covariance[:6, :6]
    most = (settings.fit.max_sigma_fraction * centred.radius_mm) ** 2
    a, b, c, x, y, z = here.diagonal().tolist()
    # No motion is less certain than all together: that is checked first, it costs next to nothing.
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
    """Return what of a tool lies outside of the table's hull or the calibration's volume."""
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
