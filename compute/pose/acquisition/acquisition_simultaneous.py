"""Acquisition of tools whose markers are lit together, from the points of an exposure."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements
from compute.pose.acquisition.marker_labelling import IdentifiedTool, identify_tools
from compute.pose.estimation.pose_equations import PoseEquations
from compute.pose.estimation.pose_fit import PoseFit, fit_pose
from compute.pose.filtering.association import (
    ToolObservation,
    associate,
    common_jacobian,
    without_tools,
)
from compute.pose.filtering.pose_filter import PoseState, initial_state
from compute.pose.rigid_body import CentredMarkers, PoseStatus, RigidBody
from compute.pose.settings import ToolTrackerSettings
from compute.pose.transform import Transform
from compute.reconstruction.point_batch import PointBatch
from compute.reconstruction.triangulation import chi2_limit

Array = NDArray[np.float64]

COVARIANCE_INFLATION = 4.0
"""Factor on the covariance of a pose from points, for the gates of its readings."""


@dataclass(frozen=True, eq=False)
class SimultaneousAcquisition:
    """A tool found in a frame, or the reason why it was not.

    Args:
        state: state of its filter; None: not found.
        status: status of a tool that was not found.
        reason: why it was not found.
        point_count: number of points that belong to no tracked tool.
        nis: chi2 of its readings.
        sensors: readings that the pose was fitted to, shape (M, S).
        excluded: number of readings of each marker that did not fit the others, shape (M,).
    """

    state: PoseState | None
    status: PoseStatus
    reason: str
    point_count: int
    nis: float
    sensors: NDArray[np.bool_]
    excluded: NDArray[np.intp]


def acquire_simultaneous(
    model: MeasurementModel,
    tools: Sequence[RigidBody],
    common_errors: Sequence[int],
    time_ns: int,
    measurements: Measurements,
    tracked: Sequence[ToolObservation],
    points: PointBatch | None,
    settings: ToolTrackerSettings,
) -> list[SimultaneousAcquisition]:
    """Find lost tools in one frame.

    Points of tracked tools are excluded. For a tool that its geometry identifies unambiguously,
    readings are associated around the pose of its points (also those of markers without a point),
    and its pose is fitted to them.

    Args:
        model: the cameras.
        tools: the lost tools.
        common_errors: number of common errors that each state carries.
        time_ns: time of the frame [ns].
        measurements: peaks of the frame that no tracked tool has taken.
        tracked: the tracked tools, after this frame.
        points: reconstructed points of the frame; None: none.
        settings: tolerances.

    Returns:
        One result for each of ``tools``, in their order.
    """
    place, covariance = _unclaimed_points(points, tracked, settings.gate_probability)
    found = {one.tool: one for one in identify_tools(tools, place, covariance, settings.labelling)}
    observations: dict[int, ToolObservation] = {}
    for index, one in found.items():
        if one.ambiguity is not None:
            continue
        centred = CentredMarkers.of(tools[index])
        way = one.labelling
        state = initial_state(
            time_ns,
            way.rotation,
            way.centroid_mm,
            COVARIANCE_INFLATION * way.covariance,
            settings.motion,
            common_errors[index],
        )
        observations[index] = ToolObservation(centred, np.arange(len(tools[index])), state)
    associate(
        model,
        list(observations.values()),
        measurements,
        settings.gate_probability,
        settings.resolution_px,
    )
    rest = without_tools(measurements, list(observations.values()))
    free = rest.usable.sum(axis=1)
    starts = []
    for index, tool in enumerate(tools):
        own, observation = found.get(index), observations.get(index)
        if (
            observation is not None
            and observation.count_contradictions(free) > observation.readings
        ):
            reason = (
                f"{observation.readings} readings are where its geometry among the points puts it, "
                "and "
                f"{observation.count_contradictions(free)} are not where they must be"
            )
            starts.append(_failed(model, tool, PoseStatus.INVALID, reason, len(place)))
        elif own is not None and observation is not None:
            start = _acquire(
                model,
                tool,
                common_errors[index],
                measurements,
                own,
                observation,
                len(place),
                settings,
            )
            off = observation.excluded_nis(model, rest, settings.gate_probability)
            starts.append(replace(start, excluded=start.excluded + (off > 0.0).sum(axis=1)))
        else:
            starts.append(_failure_reason(model, tool, own, len(place), settings))
    return starts


def _unclaimed_points(
    points: PointBatch | None, tracked: Sequence[ToolObservation], probability: float
) -> tuple[Array, Array]:
    """Return positions (N, 3) and covariances of the points that are no tracked tool's marker."""
    if points is None:
        return np.empty((0, 3)), np.empty((0, 3, 3))
    known = np.isfinite(points.position_mm).all(axis=1)
    place, covariance = points.position_mm[known], points.covariance_mm2[known]
    if not len(place) or not tracked:
        return place, covariance
    markers = np.concatenate(
        [observation.state.marker_positions(observation.centred) for observation in tracked]
    )
    off = place[:, None] - markers
    square = np.einsum("nmi,nij,nmj->nm", off, np.linalg.inv(covariance), off)
    free = (square > chi2_limit(3, probability)).all(axis=1)
    return place[free], covariance[free]


def _failure_reason(
    model: MeasurementModel,
    tool: RigidBody,
    found: IdentifiedTool | None,
    points: int,
    settings: ToolTrackerSettings,
) -> SimultaneousAcquisition:
    """Return the status and reason of a tool that was not identified."""
    status, least = PoseStatus.MISSING, settings.labelling.min_markers
    if found is not None:
        status, reason = PoseStatus.INVALID, str(found.ambiguity)
    elif points < least:
        reason = (
            f"{points or 'no'} point{'' if points == 1 else 's'} that may be its markers; its "
            f"geometry is told by {least} or more"
        )
    else:
        reason = f"none of the {points} points that may be its markers lie as its markers do"
    return _failed(model, tool, status, reason, points)


def _failed(
    model: MeasurementModel, tool: RigidBody, status: PoseStatus, reason: str, points: int
) -> SimultaneousAcquisition:
    nothing = np.zeros((len(tool), len(model)), dtype=np.bool_)
    return SimultaneousAcquisition(None, status, reason, points, 0.0, nothing, nothing.sum(axis=1))


def _acquire(
    model: MeasurementModel,
    tool: RigidBody,
    common_errors: int,
    measurements: Measurements,
    found: IdentifiedTool,
    observation: ToolObservation,
    points: int,
    settings: ToolTrackerSettings,
) -> SimultaneousAcquisition:
    """Fit the pose of a tool that was identified."""
    readings, sigma = observation.readings_px(measurements)
    centred = CentredMarkers.of(tool)
    start = Transform(
        found.labelling.rotation,
        centred.translation(found.labelling.rotation, found.labelling.centroid_mm),
    )
    fit = fit_pose(model, tool, readings, sigma, start=start, settings=settings.fit)
    if fit.status is not PoseStatus.OK:
        return _failed(model, tool, fit.status, str(fit.reason), points)
    assert fit.chi2 is not None
    state = _fitted_state(
        model, centred, fit, readings, sigma, common_errors, observation.state.time_ns, settings
    )
    excluded = (np.isfinite(readings) & ~fit.used).sum(axis=1)
    return SimultaneousAcquisition(state, PoseStatus.OK, "", points, fit.chi2, fit.used, excluded)


def _fitted_state(
    model: MeasurementModel,
    centred: CentredMarkers,
    fit: PoseFit,
    readings_px: Array,
    sigma_px: Array,
    common_errors: int,
    time_ns: int,
    settings: ToolTrackerSettings,
) -> PoseState:
    """Return the state of a fitted pose, with its correlation with the common errors.

    With the weights K of the readings the pose error is ``K (G e + noise)``; so true minus
    estimated pose has the covariance ``-K G`` with the common errors e.
    """
    assert fit.rotation is not None
    assert fit.translation_mm is not None
    centroid = centred.centroid(fit.rotation, fit.translation_mm)
    given = np.where(fit.used, readings_px, np.nan)
    equations = PoseEquations(model, centred, given, sigma_px)
    whitening = equations.whitening(fit.rotation, centroid)
    jacobian = whitening @ equations.rows(fit.rotation[None], centroid[None])[0, :, :6]
    jacobian[:, :3] *= centred.radius_mm
    covariance: Array = np.asarray(np.linalg.inv(jacobian.T @ jacobian))
    state = initial_state(
        time_ns, fit.rotation, centroid, covariance, settings.motion, common_errors
    )
    if common_errors == 0:
        return state
    expected = model.predict(equations.lever_arms(fit.rotation) + centroid, with_common_errors=True)
    lit = np.arange(len(readings_px))
    common = common_jacobian(expected, lit, common_errors)[fit.used]
    state.common[:6] = -covariance @ jacobian.T @ (whitening @ common)
    return state
