"""Pivot calibration: a tool's tip from poses rotated about a fixed point."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from compute.errors import HighError, NoConvergence, TooFewPoses, TooLittleRotation
from compute.pose.tool_calibration.calibration_poses import (
    CalibrationPoses,
    OrientationCoverage,
    check_agreement,
)
from compute.robust_statistics import biweight
from compute.transform import point_jacobian

Array = NDArray[np.float64]

UNKNOWNS: Final = 6
_OUTLIER_THRESHOLD: Final = float(np.sqrt(chi2.isf(1e-4, 3)))
"""Distance in standard deviations above which a pose is excluded: one correct one in 10,000."""
_MEDIAN_SIGMAS: Final = float(np.sqrt(chi2.median(3)))
_RANDOM_TRIPLES: Final = 120
"""With 40 % wrong poses one triple in five is right: among these one is, practically always."""
_MAX_ITERATIONS: Final = 50


@dataclass(frozen=True)
class PivotSettings:
    """Requirements of a pivot calibration.

    Args:
        min_poses: smallest number of poses that agree.
        min_swing_rad: smallest RMS angle by which each direction of the tool must swing [rad].
            The standard deviation of the tip in a direction is that of a pose over the root of
            their number, over the sine of this angle.
        max_rms_mm: largest RMS distance of the tip from the fixed point [mm].
        max_outlier_fraction: largest fraction of poses that may be excluded, below a half.
    """

    min_poses: int = 10
    min_swing_rad: float = float(np.radians(5.0))
    max_rms_mm: float = 1.0
    max_outlier_fraction: float = 0.4


@dataclass(frozen=True, eq=False)
class PivotResult:
    """A tip, and how well it is known.

    Args:
        tip_mm: in the tool's coordinates, shape (3,) [mm].
        tip_covariance_mm2: shape (3, 3) [mm^2]; where poses scatter more than their covariances
            say, by their scatter.
        pivot_mm: the fixed point in the world, shape (3,) [mm].
        pivot_covariance_mm2: shape (3, 3) [mm^2].
        distance_mm: of the tip from the fixed point at each pose, shape (N,) [mm].
        rms_mm: root of the mean square of those used [mm].
        residual_sigma: root of chi2 per degree of freedom of those used, about 1 where the
            covariances are right; None: there were none.
        outlying: indices of the poses that do not fit the others and were left out.
        orientations: how far the tool was turned, of the poses used.
    """

    tip_mm: Array
    tip_covariance_mm2: Array
    pivot_mm: Array
    pivot_covariance_mm2: Array
    distance_mm: Array
    rms_mm: float
    residual_sigma: float | None
    outlying: tuple[int, ...]
    orientations: OrientationCoverage


def pivot_calibration(
    rotations: Array,
    translations_mm: Array,
    covariances: Array | None = None,
    settings: PivotSettings | None = None,
) -> PivotResult:
    """Return the point of a tool that stayed fixed while the tool was rotated.

    Solves ``R_i tip + t_i = pivot`` for tip and pivot. The initial estimate is the linear solution
    of the triple of poses that most poses agree with. It is refined with Tukey's loss, weighted
    with the covariance of ``R_i tip + t_i``, with the orientations adjusted within theirs
    (Z. Yaniv, doi:10.1117/12.2081348, compares the unweighted methods). Outliers are then excluded.

    Args:
        rotations: R_world_tool, shape (N, 3, 3).
        translations_mm: shape (N, 3) [mm].
        covariances: covariance of rotation [rad] and translation [mm] as in ToolPose, shape
            (N, 6, 6); None: unknown, all poses have equal weight.
        settings: requirements of the poses.

    Raises:
        TooFewPoses: fewer poses than required, or fewer that agree.
        TooLittleRotation: a direction of the tool swung too little; the tip is not determined
            along it.
        HighError: the tip did not stay at one point.
        InvalidParameter, NonFiniteValue: an array is of a wrong shape, or not finite.
        NoConvergence: the adjustment did not converge.
    """
    criteria = settings or PivotSettings()
    poses = CalibrationPoses(rotations, translations_mm, covariances)
    count, sigma_known = len(poses), poses.covariances is not None
    if count < criteria.min_poses:
        raise TooFewPoses(
            f"{count} poses; a pivot calibration needs at least {criteria.min_poses}, with the "
            "tool turned about its tip to and fro and to the sides",
            poses=count,
            needed=criteria.min_poses,
        )
    _check_rotation(OrientationCoverage.of(poses.rotations), criteria)
    unknowns = _robust_fit(poses, _initial_estimate(poses))
    limits = criteria.min_poses, criteria.max_outlier_fraction, "the tip moved, or there was none"
    used = _inliers(poses, unknowns)
    for _ in range(3):
        check_agreement(used, *limits)
        unknowns = _least_squares(poses.of(used), unknowns)
        again = _inliers(poses, unknowns, used)
        if (again == used).all():
            break
        used = again
    check_agreement(used, *limits)
    some = poses.of(used)
    orientations = OrientationCoverage.of(some.rotations)
    _check_rotation(orientations, criteria)
    distance = np.linalg.norm(_residuals(poses, unknowns), axis=1)
    rms = float(np.sqrt((distance[used] ** 2).mean()))
    if rms > criteria.max_rms_mm:
        raise HighError(
            f"the tip is {rms:.3g} mm RMS off the fixed point over {len(some)} poses; it "
            f"must be within {criteria.max_rms_mm:g} mm: hold it in a pit, and check that the "
            "markers are firm on the tool",
            rms_mm=rms,
            max_mm=criteria.max_rms_mm,
        )
    normal, misfit = _normal(some, unknowns)
    factor = misfit / (3 * len(some) - UNKNOWNS)
    inverse: Array = np.asarray(np.linalg.inv(normal), np.float64)
    covariance = inverse * (max(1.0, factor) if sigma_known else factor)
    return PivotResult(
        unknowns[:3],
        covariance[:3, :3],
        unknowns[3:],
        covariance[3:, 3:],
        distance,
        rms,
        float(np.sqrt(factor)) if sigma_known else None,
        tuple(np.flatnonzero(~used).tolist()),
        orientations,
    )


def _check_rotation(orientations: OrientationCoverage, criteria: PivotSettings) -> None:
    least = float(orientations.swing_rad[0])
    if least >= criteria.min_swing_rad:
        return
    x, y, z = orientations.axes[0]
    raise TooLittleRotation(
        f"{orientations.describe()}. Each must swing by at least "
        f"{np.degrees(criteria.min_swing_rad):.1f} deg RMS: the tip is not determined along "
        f"({x:.2f}, {y:.2f}, {z:.2f}); turn the tool about other axes too",
        swing_deg=np.degrees(orientations.swing_rad).tolist(),
        range_deg=float(np.degrees(orientations.range_rad)),
        min_deg=float(np.degrees(criteria.min_swing_rad)),
        undetermined=[float(x), float(y), float(z)],
    )


def _initial_estimate(poses: CalibrationPoses) -> Array:
    """Return tip and pivot (6,) that bring most poses together, each try from three of them."""
    # A fixed seed: the same poses give the same result to the last bit.
    rng = np.random.default_rng(0)
    picks = np.argpartition(rng.random((_RANDOM_TRIPLES, len(poses))), 3, axis=1)[:, :3]
    # Minimum-norm: three poses of nearly the same orientation give a poor start and score badly.
    tries = np.einsum(
        "kij,kj->ki",
        np.linalg.pinv(_design(poses.rotations[picks]).reshape(-1, 9, 6), rcond=1e-4),
        -poses.translations_mm[picks].reshape(_RANDOM_TRIPLES, 9),
    )
    every = _design(poses.rotations).reshape(-1, 6)
    all_poses = np.linalg.lstsq(every, -poses.translations_mm.reshape(-1), rcond=None)[0]
    tries = np.concatenate([all_poses[None], tries])
    scores = [np.median(np.linalg.norm(_residuals(poses, one), axis=1)) for one in tries]
    return np.asarray(tries[int(np.argmin(scores))])


def _residuals(poses: CalibrationPoses, unknowns: Array) -> Array:
    """Return ``R_i tip + t_i - pivot``, shape (N, 3) [mm]."""
    residual: Array = poses.rotations @ unknowns[:3] + poses.translations_mm - unknowns[3:]
    return residual


def _design(rotations: Array) -> Array:
    """Return d residuals / d (tip, pivot), shape (..., 3, 6)."""
    return np.concatenate([rotations, np.broadcast_to(-np.eye(3), rotations.shape)], axis=-1)


def _information(poses: CalibrationPoses, unknowns: Array) -> tuple[Array, Array]:
    """Return d residuals / d pose, shape (N, 3, 6), and the residuals' information (N, 3, 3)."""
    jacobian = point_jacobian(poses.rotations @ unknowns[:3])
    if poses.covariances is None:
        return jacobian, np.broadcast_to(np.eye(3), (len(poses), 3, 3))
    information = np.linalg.inv(jacobian @ poses.covariances @ jacobian.swapaxes(1, 2))
    return jacobian, np.asarray(information, np.float64)


def _normalised_residuals(poses: CalibrationPoses, unknowns: Array) -> Array:
    """Return the residuals in standard deviations, or in mm where these are unknown, (N,)."""
    residual = _residuals(poses, unknowns)
    _, information = _information(poses, unknowns)
    normalised: Array = np.sqrt(np.einsum("ni,nij,nj->n", residual, information, residual))
    return normalised


def _scale(normalised_residuals: Array, sigma_known: bool) -> float:
    return max(
        float(np.median(normalised_residuals)) / _MEDIAN_SIGMAS, 1.0 if sigma_known else 1e-9
    )


def _inliers(
    poses: CalibrationPoses, unknowns: Array, among: NDArray[np.bool_] | None = None
) -> NDArray[np.bool_]:
    """Return which poses fit, by the scatter of those ``among`` them, shape (N,)."""
    normalised = _normalised_residuals(poses, unknowns)
    scale = _scale(
        normalised if among is None else normalised[among], poses.covariances is not None
    )
    return normalised <= _OUTLIER_THRESHOLD * scale


def _robust_fit(poses: CalibrationPoses, unknowns: Array) -> Array:
    """Return tip and pivot under Tukey's loss, the scale falling with the scatter."""
    for _ in range(20):
        normalised = _normalised_residuals(poses, unknowns)
        scale = _scale(normalised, poses.covariances is not None)
        # The loss expects a scalar deviation; the median of a 3D distance is larger.
        weight = biweight(normalised / scale / np.sqrt(3.0) * 1.5)
        step = _gauss_newton_step(poses, unknowns, weight)
        unknowns = unknowns + step
        if np.abs(step).max() < 1e-7:
            break
    return unknowns


def _least_squares(poses: CalibrationPoses, unknowns: Array) -> Array:
    """Return tip and pivot by weighted least squares.

    Raises:
        NoConvergence: the steps do not become small within ``_MAX_ITERATIONS``.
    """
    for _ in range(_MAX_ITERATIONS):
        step = _gauss_newton_step(poses, unknowns, np.ones(len(poses)))
        unknowns = unknowns + step
        if np.abs(step).max() < 1e-9 * (1.0 + np.abs(unknowns).max()):
            return unknowns
    raise NoConvergence(
        f"the pivot calibration did not converge in {_MAX_ITERATIONS} steps; the last moved the "
        f"tip by {np.linalg.norm(step[:3]):.2g} mm"
    )


def _gauss_newton_step(poses: CalibrationPoses, unknowns: Array, weight: Array) -> Array:
    jacobian, information = _information(poses, unknowns)
    weighted = np.einsum("nij,nj->ni", information, _residuals(poses, unknowns))
    design = _design(poses.adjusted_rotations(jacobian, weighted))
    normal = np.einsum("n,nia,nij,njb->ab", weight, design, information, design, optimize=True)
    gradient = np.einsum("n,nia,ni->a", weight, design, weighted)
    return -np.linalg.solve(normal, gradient)


def _normal(poses: CalibrationPoses, unknowns: Array) -> tuple[Array, float]:
    """Return the normal matrix (6, 6) and chi2."""
    _, information = _information(poses, unknowns)
    design, residual = _design(poses.rotations), _residuals(poses, unknowns)
    normal = np.einsum("nia,nij,njb->ab", design, information, design, optimize=True)
    return normal, float(np.einsum("ni,nij,nj->", residual, information, residual))
