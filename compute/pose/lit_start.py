"""Lit start: tools whose markers are lit together, found among the points of a frame."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from compute.pose.association import FramePeaks, Look, associate, common_slopes
from compute.pose.identify import Identified, identify_tools
from compute.pose.marker_frame import MarkerFrame
from compute.pose.pose_equations import PoseEquations
from compute.pose.pose_filter import PoseState, resting_state
from compute.pose.pose_fit import PoseFit, fit_pose
from compute.pose.reading_model import ReadingModel
from compute.pose.rigid_body import RigidBody
from compute.pose.settings import ToolTrackerSettings
from compute.pose.tool_pose import PoseStatus
from compute.pose.transform import Transform
from compute.reconstruction.estimate import PointBatch
from compute.reconstruction.points import chi2_limit

Array = NDArray[np.float64]

WIDER = 4.0
"""Factor on the covariance of a pose from points, with which the readings are looked for."""


@dataclass(frozen=True, eq=False)
class LitStart:
    """A tool found in a frame, or why it was not.

    Args:
        state: of its filter; None: not found.
        status: of a tool that was not found.
        reason: why it was not found.
        seen: how many points there were that are not of tracked tools.
        nis: misfit of its readings.
        sensors: which readings it was found from, shape (M, S).
        left_out: how many readings of each marker did not fit the others, shape (M,).
    """

    state: PoseState | None
    status: PoseStatus
    reason: str
    seen: int
    nis: float
    sensors: NDArray[np.bool_]
    left_out: NDArray[np.intp]


def find_lit(
    model: ReadingModel,
    tools: Sequence[RigidBody],
    errors: Sequence[int],
    time_ns: int,
    seen: FramePeaks,
    tracked: Sequence[Look],
    points: PointBatch | None,
    settings: ToolTrackerSettings,
) -> list[LitStart]:
    """Find lost tools in one frame.

    Points of tools that are tracked are left out. A tool that is told by its geometry without doubt
    has its readings looked for where it must be, also those of markers that have no point, and its
    pose is fitted to them.

    Args:
        model: the cameras.
        tools: those that are lost.
        errors: number of common errors that each state is to carry.
        time_ns: of the frame [ns].
        seen: the frame's peaks that are not taken.
        tracked: the tools that are tracked, after this frame.
        points: the frame's points.
        settings: tolerances.
    """
    place, covariance = _free_points(points, tracked, settings.gate_probability)
    found = {one.tool: one for one in identify_tools(tools, place, covariance, settings.identify)}
    looks: dict[int, Look] = {}
    for index, one in found.items():
        if one.doubt is not None:
            continue
        frame = MarkerFrame.of(tools[index])
        way = one.way
        state = resting_state(
            time_ns,
            way.rotation,
            way.centroid_mm,
            WIDER * way.covariance,
            settings.motion,
            errors[index],
        )
        looks[index] = Look(frame, np.arange(len(tools[index])), state)
    associate(model, list(looks.values()), seen, settings.gate_probability, settings.merge_px)
    rest = seen.without(list(looks.values()))
    free = rest.usable.sum(axis=1)
    starts = []
    for index, tool in enumerate(tools):
        own, look = found.get(index), looks.get(index)
        if look is not None and look.contradictions(free) > look.readings:
            reason = (
                f"{look.readings} readings are where its geometry among the points puts it, and "
                f"{look.contradictions(free)} are not where they must be"
            )
            starts.append(_without(model, tool, PoseStatus.INVALID, reason, len(place)))
        elif own is not None and look is not None:
            start = _start(model, tool, errors[index], seen, own, look, len(place), settings)
            off = look.left_out(model, rest, settings.gate_probability)
            starts.append(replace(start, left_out=start.left_out + (off > 0.0).sum(axis=1)))
        else:
            starts.append(_no_start(model, tool, own, len(place), settings))
    return starts


def _free_points(
    points: PointBatch | None, tracked: Sequence[Look], probability: float
) -> tuple[Array, Array]:
    """Return places (N, 3) and covariances of the points that are no tracked tool's marker."""
    if points is None:
        return np.empty((0, 3)), np.empty((0, 3, 3))
    known = np.isfinite(points.position_mm).all(axis=1)
    place, covariance = points.position_mm[known], points.covariance_mm2[known]
    if not len(place) or not tracked:
        return place, covariance
    markers = np.concatenate([look.state.places(look.frame) for look in tracked])
    off = place[:, None] - markers
    square = np.einsum("nmi,nij,nmj->nm", off, np.linalg.inv(covariance), off)
    free = (square > chi2_limit(3, probability)).all(axis=1)
    return place[free], covariance[free]


def _no_start(
    model: ReadingModel,
    tool: RigidBody,
    found: Identified | None,
    points: int,
    settings: ToolTrackerSettings,
) -> LitStart:
    """Say why a tool was not identified."""
    status, least = PoseStatus.MISSING, settings.identify.least_markers
    if found is not None:
        status, reason = PoseStatus.INVALID, str(found.doubt)
    elif points < least:
        reason = (
            f"{points or 'no'} point{'' if points == 1 else 's'} that may be its markers; its "
            f"geometry is told by {least} or more"
        )
    else:
        reason = f"none of the {points} points that may be its markers lie as its markers do"
    return _without(model, tool, status, reason, points)


def _without(
    model: ReadingModel, tool: RigidBody, status: PoseStatus, reason: str, points: int
) -> LitStart:
    nothing = np.zeros((len(tool), model.sensors), dtype=np.bool_)
    return LitStart(None, status, reason, points, 0.0, nothing, nothing.sum(axis=1))


def _start(
    model: ReadingModel,
    tool: RigidBody,
    errors: int,
    seen: FramePeaks,
    found: Identified,
    look: Look,
    points: int,
    settings: ToolTrackerSettings,
) -> LitStart:
    """Fit the pose of a tool that was identified."""
    readings, sigma = look.readings_px(seen)
    frame = MarkerFrame.of(tool)
    start = Transform(
        found.way.rotation, frame.translation(found.way.rotation, found.way.centroid_mm)
    )
    fit = fit_pose(model, tool, readings, sigma, start=start, settings=settings.fit)
    if fit.status is not PoseStatus.OK:
        return _without(model, tool, fit.status, str(fit.reason), points)
    assert fit.chi2 is not None
    state = _fitted_state(model, frame, fit, readings, sigma, errors, look.state.time_ns, settings)
    left_out = (np.isfinite(readings) & ~fit.used).sum(axis=1)
    return LitStart(state, PoseStatus.OK, "", points, fit.chi2, fit.used, left_out)


def _fitted_state(
    model: ReadingModel,
    frame: MarkerFrame,
    fit: PoseFit,
    readings_px: Array,
    sigma_px: Array,
    errors: int,
    time_ns: int,
    settings: ToolTrackerSettings,
) -> PoseState:
    """Return the state of a fitted pose, with its correlation with the common errors.

    The pose is off by ``K (G e + noise)``, K the weights of the readings; so what is true less what
    is stated has the covariance ``-K G`` with the common errors e.
    """
    assert fit.rotation is not None
    assert fit.translation_mm is not None
    centroid = frame.centroid(fit.rotation, fit.translation_mm)
    given = np.where(fit.used, readings_px, np.nan)
    equations = PoseEquations(model, frame, given, sigma_px)
    whitening = equations.whitening(fit.rotation, centroid)
    slopes = whitening @ equations.rows(fit.rotation[None], centroid[None])[0, :, :6]
    slopes[:, :3] *= frame.radius_mm
    covariance: Array = np.asarray(np.linalg.inv(slopes.T @ slopes))
    state = resting_state(time_ns, fit.rotation, centroid, covariance, settings.motion, errors)
    if errors == 0:
        return state
    expected = model.full(equations.arms(fit.rotation) + centroid)
    lit = np.arange(len(readings_px))
    common = common_slopes(expected, lit, errors)[fit.used]
    state.common[:6] = -covariance @ slopes.T @ (whitening @ common)
    return state
