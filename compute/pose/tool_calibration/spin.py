"""Spin calibration: the long axis of a tool from poses rotated about it."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from compute.errors import (
    HighError,
    InvalidParameter,
    NoConvergence,
    TooFewPoses,
    TooLittleRotation,
)
from compute.pose.tool_calibration.calibration_poses import (
    CalibrationPoses,
    OrientationCoverage,
    check_agreement,
)
from compute.pose.tool_calibration.spin_axis import ROWS, UNKNOWNS, SpinAxis

Array = NDArray[np.float64]

_OUTLIER_THRESHOLD: Final = float(np.sqrt(chi2.isf(1e-4, ROWS)))
_MEDIAN_SIGMAS: Final = float(np.sqrt(chi2.median(ROWS)))
_GROSS: Final = 5.0
_MAX_ITERATIONS: Final = 50


@dataclass(frozen=True)
class SpinSettings:
    """Requirements of a spin calibration.

    Args:
        min_poses: smallest number of poses that agree.
        min_swing_rad: smallest RMS angle by which directions across the axis must swing [rad].
        max_tilt_rad: largest RMS angle of the axis from its mean direction [rad].
        max_rms_mm: largest RMS distance of the axis from its mean position [mm].
        max_outlier_fraction: largest fraction of poses that may be excluded, below a half.
    """

    min_poses: int = 10
    min_swing_rad: float = float(np.radians(20.0))
    max_tilt_rad: float = float(np.radians(1.0))
    max_rms_mm: float = 1.0
    max_outlier_fraction: float = 0.4


@dataclass(frozen=True, eq=False)
class SpinResult:
    """An axis, and how well it is known.

    Args:
        direction: of the axis in the tool's coordinates, of length 1, shape (3,).
        direction_covariance: shape (3, 3), of rank 2: nothing along the direction.
        point_mm: of the axis, the nearest to the tool's origin, shape (3,) [mm].
        point_covariance_mm2: shape (3, 3) [mm^2]; along the axis it is what the direction's
            makes of the nearest point.
        world_direction: of the axis in the world, shape (3,).
        world_point_mm: a point of it in the world, shape (3,) [mm].
        tilt_rad: RMS angle of the axis off its mean direction, of the poses used [rad].
        rms_mm: RMS distance of ``point_mm`` from the axis in the world [mm].
        residual_sigma: root of chi2 per degree of freedom; None without covariances.
        outlying: indices of the poses that were left out.
        orientations: how far the tool was turned.
    """

    direction: Array
    direction_covariance: Array
    point_mm: Array
    point_covariance_mm2: Array
    world_direction: Array
    world_point_mm: Array
    tilt_rad: float
    rms_mm: float
    residual_sigma: float | None
    outlying: tuple[int, ...]
    orientations: OrientationCoverage


def spin_calibration(
    rotations: Array,
    translations_mm: Array,
    covariances: Array | None = None,
    along: Array | None = None,
    settings: SpinSettings | None = None,
) -> SpinResult:
    """Return the axis about which a tool was turned; it may slide along it.

    Solves ``R_i a = A`` and, across A, ``R_i c + t_i = C`` for the axis's directions a, A and
    points c, C in tool and world: linear, then weighted by the poses' covariances.

    Args:
        rotations: R_world_tool, shape (N, 3, 3).
        translations_mm: shape (N, 3) [mm].
        covariances: of rotation [rad] and translation [mm], as in ToolPose, (N, 6, 6); None: not
            known, the scatter of directions and of points tells.
        along: a direction (3,) of the tool that the axis points along, such as from the markers to
            the tip; None: its largest component is positive.
        settings: requirements on the poses.

    Raises:
        TooFewPoses: there are fewer than asked for.
        TooLittleRotation: the tool was turned less than asked for.
        HighError: there is no single axis: its direction or its position varies.
        InvalidParameter, NonFiniteValue: the arrays are not what they should be.
        NoConvergence: the adjustment did not end.
    """
    criteria = settings or SpinSettings()
    poses = CalibrationPoses(rotations, translations_mm, covariances)
    count, sigma_known = len(poses), poses.covariances is not None
    if count < criteria.min_poses:
        raise TooFewPoses(
            f"{count} poses; a spin calibration needs at least {criteria.min_poses}, with the "
            "tool turned about its long axis",
            poses=count,
            needed=criteria.min_poses,
        )
    _check_rotation(OrientationCoverage.of(poses.rotations), criteria)
    axis = _initial_estimate(poses)
    used = _close_poses(poses, axis)
    for _ in range(5):
        axis, weight = _least_squares(poses, axis, used)
        again = _inliers(poses, weight, axis, used)
        if (again == used).all():
            break
        used = again
        cause = "the tool was not turned about one axis"
        check_agreement(used, criteria.min_poses, criteria.max_outlier_fraction, cause)
    some = poses.of(used)
    orientations = OrientationCoverage.of(some.rotations)
    _check_rotation(orientations, criteria)
    off = axis.differences(some)
    tilt = float(np.sqrt((off[:, :2] ** 2).sum(axis=1).mean()))
    rms = float(np.sqrt((off[:, 2:] ** 2).sum(axis=1).mean()))
    _check_axis(tilt, rms, criteria)
    design = axis.design(some.rotations)
    information = weight[used]
    normal = np.einsum("nia,nij,njb->ab", design, information, design, optimize=True)
    factor = float(np.einsum("ni,nij,nj->", off, information, off))
    factor /= ROWS * used.sum() - UNKNOWNS
    covariance = np.linalg.inv(normal) * (max(1.0, factor) if sigma_known else 1.0)
    sign = _sign(axis.tool_direction, along)
    across = axis.across_tool
    # The point is the closest to the origin: it depends on the direction.
    slide = np.outer(axis.tool_direction, axis.tool_point) @ across.T
    jacobian = np.concatenate([-slide, across.T], axis=1)
    joint = covariance[np.ix_([0, 1, 4, 5], [0, 1, 4, 5])]
    return SpinResult(
        sign * axis.tool_direction,
        across.T @ covariance[:2, :2] @ across,
        axis.tool_point,
        jacobian @ joint @ jacobian.T,
        sign * axis.world_direction,
        axis.world_point,
        tilt,
        rms,
        float(np.sqrt(factor)) if sigma_known else None,
        tuple(np.flatnonzero(~used).tolist()),
        orientations,
    )


def _check_rotation(orientations: OrientationCoverage, criteria: SpinSettings) -> None:
    if orientations.swing_rad[1] >= criteria.min_swing_rad:
        return
    raise TooLittleRotation(
        f"{orientations.describe()}. Directions across the axis must swing by at least "
        f"{np.degrees(criteria.min_swing_rad):.1f} deg RMS: turn the tool further about its axis",
        swing_deg=np.degrees(orientations.swing_rad).tolist(),
        min_deg=float(np.degrees(criteria.min_swing_rad)),
    )


def _check_axis(tilt: float, rms: float, criteria: SpinSettings) -> None:
    if tilt > criteria.max_tilt_rad:
        raise HighError(
            f"the tool was not turned about a single axis: the one that moved least tilted by "
            f"{np.degrees(tilt):.2f} deg RMS; it must be within "
            f"{np.degrees(criteria.max_tilt_rad):.2f} deg",
            tilt_deg=float(np.degrees(tilt)),
            max_deg=float(np.degrees(criteria.max_tilt_rad)),
        )
    if rms > criteria.max_rms_mm:
        raise HighError(
            f"the axis did not stay at one position: it is {rms:.3g} mm RMS off; it must be within "
            f"{criteria.max_rms_mm:g} mm",
            rms_mm=rms,
            max_mm=criteria.max_rms_mm,
        )


def _sign(direction: Array, along: Array | None) -> float:
    if along is None:
        return float(np.sign(direction[np.argmax(np.abs(direction))]))
    cosine = float(direction @ along / np.linalg.norm(along))
    if not abs(cosine) > 0.1:
        raise InvalidParameter(
            f"along is {np.round(along, 3).tolist()}, across the axis "
            f"{np.round(direction, 3).tolist()} or of no length: it does not say which way the "
            "axis points"
        )
    return float(np.sign(cosine))


def _initial_estimate(poses: CalibrationPoses) -> SpinAxis:
    """Return the axis of the half of the poses that fit one another best.

    By steps of concentration (P. J. Rousseeuw, K. Van Driessen, doi:10.1007/s10618-005-0024-4).
    """
    half = np.arange(len(poses))
    for _ in range(10):
        axis = SpinAxis.linear(poses.of(half))
        off = axis.differences(poses)
        parts = np.stack([(off[:, :2] ** 2).sum(axis=1), (off[:, 2:] ** 2).sum(axis=1)], axis=1)
        size = (parts / np.maximum(np.median(parts, axis=0), 1e-24)).sum(axis=1)
        best = np.sort(np.argsort(size, kind="stable")[: (len(poses) + 1) // 2])
        if np.array_equal(best, half):
            break
        half = best
    return axis


def _close_poses(poses: CalibrationPoses, axis: SpinAxis) -> NDArray[np.bool_]:
    """Return the poses that are not grossly off the start, by the medians, shape (N,)."""
    off = axis.differences(poses)
    sizes = np.stack([np.hypot(off[:, 0], off[:, 1]), np.hypot(off[:, 2], off[:, 3])], axis=1)
    near: NDArray[np.bool_] = (sizes <= _GROSS * np.median(sizes, axis=0) + 1e-12).all(axis=1)
    return near


def _weights(poses: CalibrationPoses, axis: SpinAxis, used: NDArray[np.bool_]) -> Array:
    """Return the information of the differences, shape (N, 4, 4)."""
    if poses.covariances is not None:
        jacobian = axis.pose_jacobian(poses.rotations)
        covariance = jacobian @ poses.covariances @ jacobian.swapaxes(1, 2)
        return np.asarray(np.linalg.inv(covariance), np.float64)
    squares = axis.differences(poses.of(used)) ** 2
    dof = 2 * len(squares) - UNKNOWNS / 2
    variance = np.maximum([squares[:, :2].sum(), squares[:, 2:].sum()], 1e-24) / dof
    return np.broadcast_to(np.diag(np.repeat(1.0 / variance, 2)), (len(poses), 4, 4))


def _least_squares(
    poses: CalibrationPoses, axis: SpinAxis, used: NDArray[np.bool_]
) -> tuple[SpinAxis, Array]:
    """Return the axis by weighted least squares of the used poses, and the weights of all.

    Raises:
        NoConvergence: the steps do not become small within ``_MAX_ITERATIONS``.
    """
    some = poses.of(used)
    for _ in range(_MAX_ITERATIONS):
        information = _weights(poses, axis, used)[used]
        weighted = np.einsum("nij,nj->ni", information, axis.differences(some))
        design = axis.design(some.adjusted_rotations(axis.pose_jacobian(some.rotations), weighted))
        normal = np.einsum("nia,nij,njb->ab", design, information, design, optimize=True)
        gradient = np.einsum("nia,ni->a", design, weighted)
        # Without rotation the point is undetermined; the check of the orientations reports it.
        scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        step = -np.linalg.lstsq(normal / np.outer(scale, scale), gradient / scale, rcond=1e-9)[0]
        step /= scale
        axis = axis.retract(step)
        if np.abs(step[:4]).max() < 1e-10 and np.abs(step[4:]).max() < 1e-7:
            return axis, _weights(poses, axis, used)
    raise NoConvergence(
        f"the spin calibration did not converge in {_MAX_ITERATIONS} steps; the last turned the "
        f"axis by {np.linalg.norm(step[:2]):.2g} rad"
    )


def _inliers(
    poses: CalibrationPoses, weight: Array, axis: SpinAxis, used: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    off = axis.differences(poses)
    normalised = np.sqrt(np.einsum("ni,nij,nj->n", off, weight, off))
    scale = float(np.median(normalised[used])) / _MEDIAN_SIGMAS
    if poses.covariances is not None:
        scale = max(scale, 1.0)
    fits: NDArray[np.bool_] = normalised <= _OUTLIER_THRESHOLD * scale
    return fits
