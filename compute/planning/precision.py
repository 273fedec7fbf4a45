"""Precision: predicted covariance of points from the readings' standard deviations."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.reconstruction.point_batch import PointFlag
from compute.reconstruction.triangulation import DEGENERATE_RATIO, UNINFORMATIVE_SIGMA_RATIO

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Precision:
    """Predicted precision of N points; NaN where they cannot be reconstructed.

    Args:
        covariance_mm2: shape (N, 3, 3) [mm^2].
        sd_mm: standard deviations of X, Y and Z, shape (N, 3) [mm].
        sensors: how many sensors' readings count, int32, shape (N,).
        flags: PointFlag values, TOO_FEW_SENSORS or DEGENERATE, int32, shape (N,).
    """

    covariance_mm2: Array
    sd_mm: Array
    sensors: NDArray[np.int32]
    flags: NDArray[np.int32]


def point_precision(cameras: CameraStack, points_mm: Array, sigma_px: Array) -> Precision:
    """Return the precision of points that cameras see; see ``precision_from_jacobian``.

    Args:
        cameras: S cameras.
        points_mm: shape (N, 3) [mm].
        sigma_px: standard deviations of the corrected readings, shape (N, S) or (S,) [px]; NaN
            or infinite where a sensor does not see the point.

    Raises:
        InvalidParameter: a shape that does not fit, or a standard deviation that is not positive.
    """
    points = np.asarray(points_mm, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InvalidParameter(
            f"points_mm has the shape {points.shape}; it must be (N, 3)", points_mm=points.shape
        )
    return precision_from_jacobian(cameras.linearise(points)[1], sigma_px)


def precision_from_jacobian(gradient_px_per_mm: Array, sigma_px: Array) -> Precision:
    """Return the precision from the readings' gradients: ``(sum_s g g' / sigma_s^2)^-1``.

    This is the covariance of the weighted least-squares solution of [5.22]-[5.24] for exactly
    known sensors, and what ``compute.reconstruction`` gives for the same readings. It is of the
    noise alone: the calibration's own uncertainty, and what the camera model leaves of the
    distortion, come on top.

    Args:
        gradient_px_per_mm: d reading / d point, shape (N, S, 3) [px/mm]; NaN where a sensor does
            not see the point.
        sigma_px: standard deviations of the readings, shape (N, S) or (S,) [px]; NaN or infinite
            where a sensor does not see the point.

    Raises:
        InvalidParameter: a shape that does not fit, or a standard deviation that is not positive.
    """
    rows, used = _weighted(gradient_px_per_mm, sigma_px)
    normal = rows.transpose(0, 2, 1) @ rows

    sensors = used.sum(axis=1)
    flags = np.zeros(len(normal), dtype=np.int32)
    flags[sensors < 3] = PointFlag.TOO_FEW_SENSORS
    spectrum = np.linalg.eigvalsh(normal)
    flat = spectrum[:, 0] <= DEGENERATE_RATIO * spectrum[:, 2]
    flags[(sensors >= 3) & flat] = PointFlag.DEGENERATE
    missing = flags != 0
    normal[missing] = np.eye(3)
    covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    covariance[missing] = np.nan
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return Precision(covariance, sd, sensors.astype(np.int32), flags)


def reading_gain(gradient_px_per_mm: Array, sigma_px: Array) -> Array:
    """Return d point / d reading of the weighted least-squares solution, ``C g / sigma^2``.

    Args:
        gradient_px_per_mm: d reading / d point, shape (N, S, 3) [px/mm].
        sigma_px: standard deviations of the readings, which make the weights, shape (N, S) or
            (S,) [px].

    Returns:
        Shape (N, 3, S) [mm/px]; 0 for readings that are not used, NaN where there is no position.

    Raises:
        InvalidParameter: a shape that does not fit, or a standard deviation that is not positive.
    """
    precision = precision_from_jacobian(gradient_px_per_mm, sigma_px)
    rows, used = _weighted(gradient_px_per_mm, sigma_px)
    # One factor 1 / sigma is in the rows already.
    sigma = np.where(used, np.broadcast_to(sigma_px, used.shape), 1.0)
    gain: Array = np.einsum("nij,nsj,ns->nis", precision.covariance_mm2, rows, 1.0 / sigma)
    return gain


def propagated_sigma(gain_mm_per_px: Array, error_px: Array) -> Array:
    """Return the points' standard deviations due to reading errors that the weights ignore.

    Errors that differ from sensor to sensor independently, such as the pixels' fixed pattern:
    with the gain K, ``var = sum_s (K_s error_s)^2``.

    Args:
        gain_mm_per_px: by ``reading_gain``, shape (N, 3, S) [mm/px].
        error_px: standard deviations of the readings' errors, shape (N, S) or (S,) [px].

    Returns:
        Shape (N, 3) [mm]; NaN where there is no position, or the error of a reading that is used
        is not known.

    Raises:
        InvalidParameter: a shape that does not fit.
    """
    count, _, sensors = gain_mm_per_px.shape
    if np.shape(error_px) not in ((count, sensors), (sensors,)):
        raise InvalidParameter(
            f"error_px has the shape {np.shape(error_px)}; it must be {(count, sensors)} or "
            f"{(sensors,)}",
            error_px=np.shape(error_px),
        )
    error = np.broadcast_to(error_px, (count, sensors))[:, None, :]
    moved = np.where(gain_mm_per_px == 0.0, 0.0, gain_mm_per_px * error)
    sigma_mm: Array = np.sqrt(np.square(moved).sum(axis=2))
    return sigma_mm


def _weighted(gradient_px_per_mm: Array, sigma_px: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return gradients over standard deviations, 0 for unusable readings, and the usable ones.

    Raises:
        InvalidParameter: standard deviations of another shape, or not positive.
    """
    shape = gradient_px_per_mm.shape[:2]
    given_sigma = np.asarray(sigma_px, dtype=np.float64)
    if given_sigma.shape not in (shape, shape[1:]):
        raise InvalidParameter(
            f"sigma_px has the shape {given_sigma.shape}; it must be {shape} or {shape[1:]}",
            sigma_px=given_sigma.shape,
        )
    if (given_sigma <= 0.0).any():
        bad = float(given_sigma[given_sigma <= 0.0][0])
        raise InvalidParameter(
            f"sigma_px has {bad}; it must be positive, or NaN where a sensor sees nothing",
            sigma_px=bad,
        )
    visible = np.isfinite(gradient_px_per_mm).all(axis=2)
    sigma = np.where(visible, np.broadcast_to(given_sigma, shape), np.nan)
    used = _informative(sigma)
    rows = np.where(
        used[..., None], gradient_px_per_mm / np.where(used, sigma, 1.0)[..., None], 0.0
    )
    return rows, used


def _informative(sigma: Array) -> NDArray[np.bool_]:
    """Return which readings the reconstruction uses, shape (N, S)."""
    visible = np.isfinite(sigma)
    if sigma.shape[1] < 4:
        return visible
    third = np.partition(np.where(visible, sigma, np.inf), 2, axis=1)[:, 2:3]
    return visible & (sigma <= UNINFORMATIVE_SIGMA_RATIO * third)
