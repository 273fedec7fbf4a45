"""Pose fit: a tool's pose from the readings of all sensors, or the reason why there is none."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.mapping.table import CorrectionTable
from compute.measurement.measurement_model import MeasurementModel
from compute.pose.estimation.observability import missing_readings, unobservable_motion
from compute.pose.estimation.pose_equations import PoseCandidates, PoseEquations
from compute.pose.estimation.pose_initialisation import (
    initial_pose_from_points,
    initial_poses_from_readings,
)
from compute.pose.estimation.pose_reliability import PoseReliability, pose_reliability
from compute.pose.rigid_body import CentredMarkers, PoseStatus, RigidBody
from compute.pose.settings import POSE_PARAMETERS, PoseFitSettings
from compute.reconstruction.triangulation import chi2_limit
from compute.reliability import ACCEPTANCE_SIGNIFICANCE
from compute.transform import Transform

Array = NDArray[np.float64]

UNCORRELATED_ITERATIONS = 3
"""Number of iterations before the readings are weighted with the calibration's covariance."""
MAX_SUSPECTS = 4
"""Number of readings that are left out in turn when one is wrong."""
MIN_MARKER_READINGS = 2
"""A reading is excluded as wrong only where so many others of its marker fit."""
SAME_POSE_FRACTION = 1e-3
"""Solutions whose markers are closer than this fraction of the tool's radius are the same."""


@dataclass(frozen=True, eq=False)
class PoseFit:
    """A pose from readings, or the reason why there is none.

    Args:
        status: OK; LOW_RELIABILITY: the pose fits, and a wrong reading could pass unnoticed;
            MISSING: the readings do not determine the pose; INVALID: they do not fit the tool, or
            fit it in two ways.
        reason: why the status is not OK; where it is OK, which reading was excluded; None: none.
        used: readings that the pose was fitted to, shape (M, S).
        rotation: R_world_tool, shape (3, 3); None without a pose, like all that follow.
        translation_mm: the tool's origin, shape (3,) [mm].
        covariance: covariance of a small rotation [rad] about the world's axes, on the left, and
            of the translation [mm], shape (6, 6).
        tip_mm: shape (3,) [mm].
        tip_covariance_mm2: shape (3, 3) [mm^2].
        chi2: weighted sum of squares of the residuals.
        excluded: marker and sensor of readings that were excluded as wrong.
        reliability: of a pose that is OK or LOW_RELIABILITY.
    """

    status: PoseStatus
    reason: str | None
    used: NDArray[np.bool_]
    rotation: Array | None = None
    translation_mm: Array | None = None
    covariance: Array | None = None
    tip_mm: Array | None = None
    tip_covariance_mm2: Array | None = None
    chi2: float | None = None
    excluded: tuple[tuple[int, int], ...] = ()
    reliability: PoseReliability | None = None

    @property
    def dof(self) -> int:
        """Degrees of freedom: number of readings less six."""
        return self.readings_used - POSE_PARAMETERS

    @property
    def readings_used(self) -> int:
        """Number of readings that the pose was fitted to."""
        return int(self.used.sum())

    @property
    def markers_used(self) -> int:
        """Number of markers that the pose was fitted to."""
        return int(self.used.any(axis=1).sum())

    @property
    def residual_sigma(self) -> float | None:
        """Root of chi2 per degree of freedom; None without a pose or without redundancy."""
        if self.chi2 is None or self.dof < 1:
            return None
        return float(np.sqrt(self.chi2 / self.dof))


def fit_pose(
    model: MeasurementModel | CameraStack | Sequence[SensorModel],
    tool: RigidBody,
    readings_px: Array,
    sigma_px: Array,
    *,
    start: Transform | None = None,
    points_mm: Array | None = None,
    parameter_covariance: Array | None = None,
    corrections: CorrectionTable | None = None,
    settings: PoseFitSettings | None = None,
) -> PoseFit:
    """Fit a tool's pose to the readings of its markers, without reconstructing them first.

    Minimises r' S^-1 r over SE(3): r are readings less projections of the markers, S the sum of the
    readings' noise, the calibration's covariance (common to all readings) and the correction
    table's variance. A pose is reported where the readings determine all six degrees of freedom,
    fit the tool (all, or all but one, which is named), and have no second solution that fits as
    well.

    Args:
        model: calibrated cameras, or their ``MeasurementModel`` for repeated use; it has its own
            ``parameter_covariance`` and ``corrections``.
        tool: M markers; the marker of each reading must be known.
        readings_px: shape (M, S) [px]; NaN where a sensor did not see the marker.
        sigma_px: their standard deviations, shape (M, S) or (S,) [px].
        start: initial T_world_tool. Without it, or where it leads to no good fit, the initial pose
            comes from ``points_mm``; without these, all rotations are searched.
        points_mm: reconstructed markers, shape (M, 3) [mm]; NaN where there is none.
        parameter_covariance: joint covariance of the cameras' parameters; None: exact.
        corrections: correction table of the readings; None: none.
        settings: acceptance limits of a fit.

    Raises:
        InvalidParameter: shapes that do not fit.
    """
    if not isinstance(model, MeasurementModel):
        model = MeasurementModel.of(model, parameter_covariance, corrections)
    settings = settings or PoseFitSettings()
    readings, sigma = _validate(model, tool, readings_px, sigma_px)
    centred = CentredMarkers.of(tool)
    equations = PoseEquations(model, centred, readings, sigma)
    reason = missing_readings(centred, equations.used, settings)
    if reason is not None:
        return PoseFit(PoseStatus.MISSING, reason, equations.used)
    first = None
    if start is not None:
        first = start.rotation, start.translation_mm
    elif points_mm is not None:
        first = initial_pose_from_points(tool.markers_mm, points_mm)
    if first is not None:
        first = first[0][None], centred.centroid(*first)[None]
    fit = _fit_from_start(equations, first, settings)
    if fit.status is PoseStatus.INVALID and fit.chi2 is not None:
        fit = _exclude_outlier(equations, fit, settings)
    return _with_reliability(equations, fit, settings)


def _with_reliability(equations: PoseEquations, fit: PoseFit, settings: PoseFitSettings) -> PoseFit:
    """Return a fit with its reliability, by which an OK one may be LOW_RELIABILITY."""
    if fit.status is not PoseStatus.OK:
        return fit
    assert fit.rotation is not None
    assert fit.translation_mm is not None
    used_equations = replace(
        equations, readings_px=np.where(fit.used, equations.readings_px, np.nan)
    )
    centroid = equations.centred.centroid(fit.rotation, fit.translation_mm)
    reliability = pose_reliability(
        used_equations, fit.rotation, centroid, settings.false_rejection_probability
    )
    limit = settings.max_detectable_sigma
    low = None if limit is None else reliability.low_reason(limit)
    if low is None:
        return replace(fit, reliability=reliability)
    reason = low if fit.reason is None else f"{fit.reason}; {low}"
    return replace(fit, status=PoseStatus.LOW_RELIABILITY, reason=reason, reliability=reliability)


def _validate(
    model: MeasurementModel, tool: RigidBody, readings_px: Array, sigma_px: Array
) -> tuple[Array, Array]:
    """Return readings and standard deviations (M, S), both NaN where either is unusable.

    Raises:
        InvalidParameter: an array is of another shape.
    """
    readings = np.asarray(readings_px, dtype=np.float64)
    shape = (len(tool), len(model))
    if readings.shape != shape:
        raise InvalidParameter(
            f'readings of tool "{tool.name}" have the shape {readings.shape}; {shape[0]} markers '
            f"and {shape[1]} sensors need {shape}",
            shape=readings.shape,
        )
    sigma = np.asarray(sigma_px, dtype=np.float64)
    if sigma.shape not in (shape, shape[1:]):
        raise InvalidParameter(
            f"sigma_px has the shape {sigma.shape}; it must be {shape} or {shape[1:]}",
            shape=sigma.shape,
        )
    sigma = np.broadcast_to(sigma, shape)
    usable = np.isfinite(readings) & np.isfinite(sigma) & (sigma > 0.0)
    return np.where(usable, readings, np.nan), np.where(usable, sigma, np.nan)


def _fit_from_start(
    equations: PoseEquations, first: tuple[Array, Array] | None, settings: PoseFitSettings
) -> PoseFit:
    """Fit from an initial pose; without one, or where its fit is not good, from all rotations."""
    limit = chi2_limit(
        len(equations.independent_whitening) - 6, settings.false_rejection_probability
    )
    poses = None if first is None else solutions(equations, *first)
    if poses is None or not (poses.chi2 <= limit).any():
        starts = initial_poses_from_readings(
            equations.model, equations.centred, equations.readings_px, equations.sigma_px
        )
        poses = solutions(equations, *starts)
    used = equations.used
    if len(poses.chi2) == 0 or not np.isfinite(poses.chi2[0]):
        reason = "the readings' planes determine no position, or the search did not converge"
        return PoseFit(PoseStatus.MISSING, reason, used)
    motion = unobservable_motion(poses.gram[0, :6, :6], equations.centred, used, settings)
    if motion is not None:
        return PoseFit(PoseStatus.MISSING, motion, used)
    best = float(poses.chi2[0])
    if best > limit:
        reason = (
            f"the readings do not fit the tool: chi2 is {best:.4g}; at most {limit:.4g} is allowed "
            f"of {int(used.sum()) - 6} degrees of freedom"
        )
        return replace(_pose(equations, poses), status=PoseStatus.INVALID, reason=reason)
    rivals = poses.chi2[1:] <= best + settings.ambiguity_chi2_margin
    if rivals.any():
        reason = (
            f"the readings fit the tool in {1 + int(rivals.sum())} ways: chi2 is {best:.4g} and "
            f"{poses.chi2[1]:.4g}"
        )
        return PoseFit(PoseStatus.INVALID, reason, used)
    return _pose(equations, poses)


def solutions(equations: PoseEquations, rotation: Array, centroid_mm: Array) -> PoseCandidates:
    """Return the distinct solutions reached from K initial poses, lowest chi2 first.

    Args:
        equations: the equations of the pose.
        rotation: initial R_world_tool, shape (K, 3, 3).
        centroid_mm: initial centroids of the markers, shape (K, 3) [mm].
    """
    if equations.has_independent_noise:
        candidates = equations.refine(rotation, centroid_mm, equations.independent_whitening)
    else:
        near = equations.refine(
            rotation, centroid_mm, equations.independent_whitening, UNCORRELATED_ITERATIONS
        )
        value = near.gram[:, 6, 6]
        if not np.isfinite(value).any():
            return near.of(np.empty(0, dtype=np.intp))
        best = int(np.nanargmin(value))
        whitening = equations.whitening(near.rotation[best], near.centroid_mm[best])
        candidates = equations.refine(near.rotation, near.centroid_mm, whitening)
    order = np.argsort(candidates.chi2, kind="stable")
    if len(order) == 1:
        return candidates
    positions = equations.lever_arms(candidates.rotation) + candidates.centroid_mm[:, None, :]
    same = SAME_POSE_FRACTION * equations.centred.radius_mm
    distinct: list[int] = []
    for index in order:
        if np.isfinite(candidates.chi2[index]) and all(
            np.abs(positions[index] - positions[other]).max() > same for other in distinct
        ):
            distinct.append(int(index))
    return candidates.of(np.array(distinct, dtype=np.intp))


def _pose(equations: PoseEquations, poses: PoseCandidates) -> PoseFit:
    """Return the first of the poses with its covariance."""
    centred = equations.centred
    rotation, centroid = poses.rotation[0], poses.centroid_mm[0]
    scaled = np.linalg.inv(poses.gram[0, :6, :6])
    radius = np.array([centred.radius_mm] * 3 + [1.0] * 3)
    here = scaled / (radius[:, None] * radius)
    origin, tip = centred.origin_jacobian(rotation), centred.tip_jacobian(rotation)
    return PoseFit(
        PoseStatus.OK,
        None,
        equations.used,
        rotation,
        centred.translation(rotation, centroid),
        origin @ here @ origin.T,
        centroid + rotation @ centred.tip_mm,
        tip @ here @ tip.T,
        float(poses.gram[0, 6, 6]),
    )


def _exclude_outlier(
    equations: PoseEquations, full_fit: PoseFit, settings: PoseFitSettings
) -> PoseFit:
    """Exclude the one wrong reading, if one explains the misfit unambiguously.

    Suspects are the readings whose exclusion would lower chi2 most (W. Baarda's data snooping,
    1968: ``w^2 = (Q r)^2 / Q_ii`` with ``Q = S^-1 - S^-1 J (J' S^-1 J)^-1 J' S^-1``); each is
    excluded in turn.
    """
    refused = PoseFit(PoseStatus.INVALID, full_fit.reason, equations.used, chi2=full_fit.chi2)
    least = POSE_PARAMETERS + max(settings.min_redundancy, settings.min_redundancy_after_exclusion)
    if settings.max_excluded < 1 or refused.readings_used - 1 < least:
        return refused
    strict = replace(
        settings,
        false_rejection_probability=max(
            settings.false_rejection_probability, ACCEPTANCE_SIGNIFICANCE
        ),
    )
    trials: list[tuple[float, PoseFit]] = []
    for marker, sensor in _suspects(equations, full_fit):
        if equations.used[marker].sum() - 1 < MIN_MARKER_READINGS:
            # The marker itself may be elsewhere, as on a bent or a mirrored body.
            continue
        readings = equations.readings_px.copy()
        readings[marker, sensor] = np.nan
        fewer = replace(equations, readings_px=readings)
        if missing_readings(equations.centred, fewer.used, settings) is not None:
            continue
        trial = _fit_from_start(fewer, None, strict)
        if trial.status is PoseStatus.OK and trial.chi2 is not None:
            trials.append((trial.chi2, replace(trial, excluded=((marker, sensor),))))
    if not trials:
        return refused
    trials.sort(key=itemgetter(0))
    (chi2, best), *others = trials
    if others and others[0][0] <= chi2 + settings.ambiguity_chi2_margin:
        names = " or ".join(
            f"sensor {sensor + 1} of marker {marker + 1}"
            for _, trial in trials
            for marker, sensor in trial.excluded
        )
        reason = f"one reading is wrong, and it is not clear which: {names}"
        return replace(refused, reason=reason)
    marker, sensor = best.excluded[0]
    reason = f"the reading of marker {marker + 1} by sensor {sensor + 1} was excluded as wrong"
    return replace(best, reason=reason)


def _suspects(equations: PoseEquations, full_fit: PoseFit) -> list[tuple[int, int]]:
    """Return marker and sensor of the readings whose exclusion lowers chi2 most, largest first."""
    assert full_fit.rotation is not None
    assert full_fit.translation_mm is not None
    centroid = equations.centred.centroid(full_fit.rotation, full_fit.translation_mm)
    whitening = equations.whitening(full_fit.rotation, centroid)
    rows = whitening @ equations.rows(full_fit.rotation[None], centroid[None])[0]
    basis, _ = np.linalg.qr(rows[:, :6])
    rest = whitening.T @ (np.eye(len(rows)) - basis @ basis.T)
    weight = (rest @ whitening).diagonal()
    lowered = np.where(weight > 0.0, (rest @ rows[:, 6]) ** 2 / np.maximum(weight, 1e-300), 0.0)
    marker, sensor = np.nonzero(equations.used)
    worst = np.argsort(-lowered, kind="stable")[:MAX_SUSPECTS]
    return [(int(marker[index]), int(sensor[index])) for index in worst]
