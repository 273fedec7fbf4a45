"""Pivot calibration: a tool's tip from poses rotated about a fixed point."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from compute.camera.rotation import rotation_matrix
from compute.errors import HighError, NoConvergence, TooFewPoses, TooLittleRotation
from compute.pose.tool_calibration.calibration_poses import OrientationCoverage, validate_poses
from compute.pose.transform import cross_matrix
from compute.robust_statistics import biweight

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
    wanted = settings or PivotSettings()
    rotations, translations, pose_covariances = validate_poses(
        rotations, translations_mm, covariances
    )
    count = len(translations)
    if count < wanted.min_poses:
        raise TooFewPoses(
            f"{count} poses; a pivot calibration needs at least {wanted.min_poses}, with the "
            "tool turned about its tip to and fro and to the sides",
            poses=count,
            needed=wanted.min_poses,
        )
    _check_rotation(OrientationCoverage.of(rotations), wanted)
    unknowns = _robust_fit(
        rotations, translations, pose_covariances, _initial_estimate(rotations, translations)
    )
    used = _inliers(rotations, translations, pose_covariances, unknowns)
    for _ in range(3):
        _check_used(used, wanted)
        some = None if pose_covariances is None else pose_covariances[used]
        unknowns = _least_squares(rotations[used], translations[used], some, unknowns)
        again = _inliers(rotations, translations, pose_covariances, unknowns, used)
        if (again == used).all():
            break
        used = again
    _check_used(used, wanted)
    orientations = OrientationCoverage.of(rotations[used])
    _check_rotation(orientations, wanted)
    residual = _residuals(rotations, translations, unknowns)
    distance = np.linalg.norm(residual, axis=1)
    rms = float(np.sqrt((distance[used] ** 2).mean()))
    if rms > wanted.max_rms_mm:
        raise HighError(
            f"the tip is {rms:.3g} mm RMS off the fixed point over {int(used.sum())} poses; it "
            f"must be within {wanted.max_rms_mm:g} mm: hold it in a pit, and check that the "
            "markers are firm on the tool",
            rms_mm=rms,
            max_mm=wanted.max_rms_mm,
        )
    covariances = None if pose_covariances is None else pose_covariances[used]
    normal, misfit = _normal(rotations[used], translations[used], covariances, unknowns)
    factor = misfit / (3 * used.sum() - UNKNOWNS)
    covariance = np.linalg.inv(normal) * (factor if pose_covariances is None else max(1.0, factor))
    return PivotResult(
        unknowns[:3],
        covariance[:3, :3],
        unknowns[3:],
        covariance[3:, 3:],
        distance,
        rms,
        None if pose_covariances is None else float(np.sqrt(factor)),
        tuple(np.flatnonzero(~used).tolist()),
        orientations,
    )


def _check_rotation(orientations: OrientationCoverage, wanted: PivotSettings) -> None:
    least = float(orientations.swing_rad[0])
    if least >= wanted.min_swing_rad:
        return
    x, y, z = orientations.axes[0]
    raise TooLittleRotation(
        f"{orientations.describe()}. Each must swing by at least "
        f"{np.degrees(wanted.min_swing_rad):.1f} deg RMS: the tip is not determined along "
        f"({x:.2f}, {y:.2f}, {z:.2f}); turn the tool about other axes too",
        swing_deg=np.degrees(orientations.swing_rad).tolist(),
        range_deg=float(np.degrees(orientations.range_rad)),
        min_deg=float(np.degrees(wanted.min_swing_rad)),
        undetermined=[float(x), float(y), float(z)],
    )


def _check_used(used: NDArray[np.bool_], wanted: PivotSettings) -> None:
    left = int(used.sum())
    if left >= max(wanted.min_poses, (1.0 - wanted.max_outlier_fraction) * len(used)):
        return
    first = np.flatnonzero(~used)[:10].tolist()
    raise HighError(
        f"{len(used) - left} of {len(used)} poses do not fit the others (the first: {first}); "
        f"at least {wanted.min_poses} poses and {1.0 - wanted.max_outlier_fraction:.0%} of them "
        "must "
        "agree: the tip moved, or there was none",
        outlying=len(used) - left,
        poses=len(used),
    )


def _initial_estimate(rotations: Array, translations: Array) -> Array:
    """Return tip and pivot (6,) that bring most poses together, each try from three of them."""
    count = len(translations)
    # A fixed seed: the same poses give the same result to the last bit.
    rng = np.random.default_rng(0)
    picks = np.argpartition(rng.random((_RANDOM_TRIPLES, count)), 3, axis=1)[:, :3]
    design = np.concatenate(
        [rotations[picks], np.broadcast_to(-np.eye(3), (_RANDOM_TRIPLES, 3, 3, 3))], axis=-1
    ).reshape(_RANDOM_TRIPLES, 9, 6)
    # Minimum-norm: three poses of nearly the same orientation give a poor start and score badly.
    tries = np.einsum(
        "kij,kj->ki",
        np.linalg.pinv(design, rcond=1e-4),
        -translations[picks].reshape(_RANDOM_TRIPLES, 9),
    )
    every = np.concatenate([rotations, np.broadcast_to(-np.eye(3), rotations.shape)], axis=-1)
    whole = np.linalg.lstsq(every.reshape(-1, 6), -translations.reshape(-1), rcond=None)[0]
    tries = np.concatenate([whole[None], tries])
    scores = [
        float(np.median(np.linalg.norm(_residuals(rotations, translations, one), axis=1)))
        for one in tries
    ]
    return np.asarray(tries[int(np.argmin(scores))])


def _residuals(rotations: Array, translations: Array, unknowns: Array) -> Array:
    """Return ``R_i tip + t_i - pivot``, shape (N, 3) [mm]."""
    residual: Array = rotations @ unknowns[:3] + translations - unknowns[3:]
    return residual


def _information(
    rotations: Array, pose_covariances: Array | None, unknowns: Array
) -> tuple[Array, Array]:
    """Return the slopes of what is off to the pose (N, 3, 6) and its information (N, 3, 3)."""
    jacobian = np.empty((len(rotations), 3, 6))
    jacobian[..., :3] = -cross_matrix(rotations @ unknowns[:3])
    jacobian[..., 3:] = np.eye(3)
    if pose_covariances is None:
        return jacobian, np.broadcast_to(np.eye(3), (len(rotations), 3, 3))
    information = np.linalg.inv(jacobian @ pose_covariances @ jacobian.swapaxes(1, 2))
    return jacobian, np.asarray(information, np.float64)


def _normalised_residuals(
    rotations: Array, translations: Array, pose_covariances: Array | None, unknowns: Array
) -> Array:
    """Return how far each pose is off, in its deviations, or in mm where none are known, (N,)."""
    residual = _residuals(rotations, translations, unknowns)
    _, information = _information(rotations, pose_covariances, unknowns)
    normalised_residuals: Array = np.sqrt(
        np.einsum("ni,nij,nj->n", residual, information, residual)
    )
    return normalised_residuals


def _scale(normalised_residuals: Array, pose_covariances: Array | None) -> float:
    found = float(np.median(normalised_residuals)) / _MEDIAN_SIGMAS
    return max(found, 1.0) if pose_covariances is not None else max(found, 1e-9)


def _inliers(
    rotations: Array,
    translations: Array,
    pose_covariances: Array | None,
    unknowns: Array,
    among: NDArray[np.bool_] | None = None,
) -> NDArray[np.bool_]:
    """Return which poses fit, by the scatter of those ``among`` them, shape (N,)."""
    normalised_residuals = _normalised_residuals(
        rotations, translations, pose_covariances, unknowns
    )
    return normalised_residuals <= _OUTLIER_THRESHOLD * _scale(
        normalised_residuals if among is None else normalised_residuals[among], pose_covariances
    )


def _robust_fit(
    rotations: Array, translations: Array, pose_covariances: Array | None, unknowns: Array
) -> Array:
    """Return tip and pivot under Tukey's loss, the scale falling with the scatter."""
    for _ in range(20):
        normalised_residuals = _normalised_residuals(
            rotations, translations, pose_covariances, unknowns
        )
        # The loss expects a scalar deviation; the median of a 3D distance is larger.
        weight = biweight(
            normalised_residuals
            / _scale(normalised_residuals, pose_covariances)
            / np.sqrt(3.0)
            * 1.5
        )
        step = _gauss_newton_step(rotations, translations, pose_covariances, unknowns, weight)
        unknowns = unknowns + step
        if np.abs(step).max() < 1e-7:
            break
    return unknowns


def _least_squares(
    rotations: Array, translations: Array, pose_covariances: Array | None, unknowns: Array
) -> Array:
    """Return tip and pivot by weighted least squares."""
    weight = np.ones(len(translations))
    for _ in range(_MAX_ITERATIONS):
        step = _gauss_newton_step(rotations, translations, pose_covariances, unknowns, weight)
        unknowns = unknowns + step
        if np.abs(step).max() < 1e-9 * (1.0 + np.abs(unknowns).max()):
            return unknowns
    raise NoConvergence(
        f"the pivot calibration did not converge in {_MAX_ITERATIONS} steps; the last moved the "
        "tip by "
        f"{np.linalg.norm(step[:3]):.2g} mm"
    )


def _gauss_newton_step(
    rotations: Array,
    translations: Array,
    pose_covariances: Array | None,
    unknowns: Array,
    weight: Array,
) -> Array:
    residual = _residuals(rotations, translations, unknowns)
    jacobian, information = _information(rotations, pose_covariances, unknowns)
    pull = np.einsum("nij,nj->ni", information, residual)
    right = rotations
    if pose_covariances is not None:
        # The likelihood's gradient is that at the adjusted orientations: with the measured ones,
        # their noise would pull the tip towards the tool's origin.
        turn = np.einsum("nij,nkj,nk->ni", pose_covariances, jacobian, pull)[:, :3]
        right = rotation_matrix(-turn) @ rotations
    design = np.concatenate([right, np.broadcast_to(-np.eye(3), right.shape)], axis=-1)
    normal = np.einsum("n,nia,nij,njb->ab", weight, design, information, design, optimize=True)
    gradient = np.einsum("n,nia,ni->a", weight, design, pull)
    return -np.linalg.solve(normal, gradient)


def _normal(
    rotations: Array, translations: Array, pose_covariances: Array | None, unknowns: Array
) -> tuple[Array, float]:
    """Return the normal matrix (6, 6) and chi2."""
    _, information = _information(rotations, pose_covariances, unknowns)
    design = np.concatenate([rotations, np.broadcast_to(-np.eye(3), rotations.shape)], axis=-1)
    residual = _residuals(rotations, translations, unknowns)
    normal = np.einsum("nia,nij,njb->ab", design, information, design, optimize=True)
    return normal, float(np.einsum("ni,nij,nj->", residual, information, residual))
