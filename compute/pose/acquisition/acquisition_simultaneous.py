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
    without_peaks,
)
from compute.pose.filtering.pose_filter import PoseState, initial_state
from compute.pose.rigid_body import CentredMarkers, PoseStatus, RigidBody
from compute.pose.settings import ToolTrackerSettings
from compute.reconstruction.point_batch import PointBatch
from compute.reconstruction.triangulation import chi2_limit
from compute.transform import Transform

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
        sigma_px: standard deviations of its readings, shape (M, S) [px]; NaN where there is none.
    """

    state: PoseState | None
    status: PoseStatus
    reason: str
    point_count: int
    nis: float
    sensors: NDArray[np.bool_]
    excluded: NDArray[np.intp]
    sigma_px: Array


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
    position, covariance = _unclaimed_points(points, tracked, settings.gate_probability)
    identified = {
        one.tool: one for one in identify_tools(tools, position, covariance, settings.labelling)
    }
    observations = {
        index: ToolObservation(
            CentredMarkers.of(tools[index]),
            np.arange(len(tools[index])),
            initial_state(
                time_ns,
                one.labelling.rotation,
                one.labelling.centroid_mm,
                COVARIANCE_INFLATION * one.labelling.covariance,
                settings.motion,
                common_errors[index],
            ),
        )
        for index, one in identified.items()
        if one.ambiguity is None
    }
    associate(
        model,
        observations.values(),
        measurements,
        settings.gate_probability,
        settings.resolution_px,
    )
    rest = without_peaks(measurements, [one.peaks for one in observations.values()])
    free = rest.usable.sum(axis=1)

    def acquire(index: int, tool: RigidBody) -> SimultaneousAcquisition:
        identified_tool, observation = identified.get(index), observations.get(index)
        if identified_tool is None or observation is None:
            reason = _not_identified(identified_tool, len(position), settings)
            status = PoseStatus.MISSING if identified_tool is None else PoseStatus.INVALID
            return _failed(model, tool, status, reason, len(position))
        against = observation.count_contradictions(free)
        if against > observation.readings:
            reason = (
                f"{observation.readings} readings are where its geometry among the points puts it, "
                f"and {against} are not where they must be"
            )
            return _failed(model, tool, PoseStatus.INVALID, reason, len(position))
        readings, sigma = observation.readings_px(measurements)
        labelling, centred = identified_tool.labelling, observation.centred
        translation = centred.translation(labelling.rotation, labelling.centroid_mm)
        start = Transform(labelling.rotation, translation)
        fit = fit_pose(model, tool, readings, sigma, start=start, settings=settings.fit)
        off = observation.excluded_nis(model, rest, settings.gate_probability) > 0.0
        if fit.status not in (PoseStatus.OK, PoseStatus.LOW_RELIABILITY):
            failed = _failed(model, tool, fit.status, str(fit.reason), len(position))
            return replace(failed, excluded=off.sum(axis=1))
        assert fit.chi2 is not None
        state = _fitted_state(model, observation, fit, readings, sigma, settings)
        excluded = (np.isfinite(readings) & ~fit.used).sum(axis=1) + off.sum(axis=1)
        return SimultaneousAcquisition(
            state, PoseStatus.OK, "", len(position), fit.chi2, fit.used, excluded, sigma
        )

    return [acquire(index, tool) for index, tool in enumerate(tools)]


def _unclaimed_points(
    points: PointBatch | None, tracked: Sequence[ToolObservation], probability: float
) -> tuple[Array, Array]:
    """Return positions (N, 3) and covariances of the points that are no tracked tool's marker."""
    if points is None:
        return np.empty((0, 3)), np.empty((0, 3, 3))
    finite = np.isfinite(points.position_mm).all(axis=1)
    position, covariance = points.position_mm[finite], points.covariance_mm2[finite]
    if not len(position) or not tracked:
        return position, covariance
    markers = np.concatenate(
        [observation.state.marker_positions(observation.centred) for observation in tracked]
    )
    off = position[:, None] - markers
    square = np.einsum("nmi,nij,nmj->nm", off, np.linalg.inv(covariance), off)
    free = (square > chi2_limit(3, probability)).all(axis=1)
    return position[free], covariance[free]


def _not_identified(
    identified_tool: IdentifiedTool | None, points: int, settings: ToolTrackerSettings
) -> str:
    """Return why a tool was not identified, or not unambiguously."""
    least = settings.labelling.min_markers
    if identified_tool is not None:
        return str(identified_tool.ambiguity)
    if points < least:
        return (
            f"{points or 'no'} point{'' if points == 1 else 's'} that may be its markers; its "
            f"geometry is distinguished by {least} or more"
        )
    return f"none of the {points} points that may be its markers lie as its markers do"


def _failed(
    model: MeasurementModel, tool: RigidBody, status: PoseStatus, reason: str, points: int
) -> SimultaneousAcquisition:
    nothing = np.zeros((len(tool), len(model)), dtype=np.bool_)
    return SimultaneousAcquisition(
        None,
        status,
        reason,
        points,
        0.0,
        nothing,
        nothing.sum(axis=1),
        np.full(nothing.shape, np.nan),
    )


def _fitted_state(
    model: MeasurementModel,
    observation: ToolObservation,
    fit: PoseFit,
    readings_px: Array,
    sigma_px: Array,
    settings: ToolTrackerSettings,
) -> PoseState:
    """Return the state of a fitted pose, with its correlation with the common errors.

    With the weights K of the readings the pose error is ``K (G e + noise)``; so true minus
    estimated pose has the covariance ``-K G`` with the common errors e.
    """
    assert fit.rotation is not None
    assert fit.translation_mm is not None
    centred, common_errors = observation.centred, observation.state.common.shape[1]
    centroid = centred.centroid(fit.rotation, fit.translation_mm)
    equations = PoseEquations(model, centred, np.where(fit.used, readings_px, np.nan), sigma_px)
    whitening = equations.whitening(fit.rotation, centroid)
    jacobian = whitening @ equations.rows(fit.rotation[None], centroid[None])[0, :, :6]
    jacobian[:, :3] *= centred.radius_mm
    covariance: Array = np.asarray(np.linalg.inv(jacobian.T @ jacobian))
    time_ns = observation.state.time_ns
    state = initial_state(
        time_ns, fit.rotation, centroid, covariance, settings.motion, common_errors
    )
    if common_errors:
        markers = equations.lever_arms(fit.rotation) + centroid
        expected = model.predict(markers, with_common_errors=True)
        common = common_jacobian(expected, observation.lit, common_errors)[fit.used]
        state.common[:6] = -covariance @ jacobian.T @ (whitening @ common)
    return state
