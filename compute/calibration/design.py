"""A fitted camera's equations: its weighted Jacobian, how well they determine it, their inverse."""

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.terms import has_slit_angle
from compute.camera.model import PARAMETER_COUNT, SensorModel
from compute.camera.stack import CameraStack
from compute.errors import DegeneratePoints

Array = NDArray[np.float64]

DETERMINED_RATIO: Final = 1e-5
"""Smallest ratio of singular values of the Jacobian with columns of length 1. The measured and
simulated frames of the thesis have 1e-4 and more; the corners of a box that a sensor sees along
its edges, 1e-5 and less even with noise."""
DISTORTED_RATIO: Final = 1e-7
"""The same with distortion, whose terms are alike where the field is small; below it, normal
equations hold nothing but rounding of the least combination."""


def fitted_columns(model: SensorModel) -> NDArray[np.intp]:
    """Return which of a model's parameters are fitted: all, less an offset that nothing reads."""
    columns = np.arange(model.parameter_count)
    if model.distortion is not None and not has_slit_angle(model.distortion.terms):
        columns = np.delete(columns, PARAMETER_COUNT)
    return columns


def design(
    model: SensorModel, points_mm: Array, weights: Array, offset_sigma_mm: float | None = None
) -> Array:
    """Return the weighted Jacobian of the fitted parameters, shape (N, F) or (N + 1, F).

    Args:
        model: the camera.
        points_mm: points that it read, shape (N, 3).
        weights: 1 / standard deviation, shape (N,).
        offset_sigma_mm: of the prior of the offset along the slit, a row of its own where that
            is fitted.
    """
    columns = fitted_columns(model)
    rows = CameraStack.of([model]).parameter_jacobian(points_mm)[:, 0, columns]
    rows = rows * weights[:, None]
    if offset_sigma_mm is None or PARAMETER_COUNT not in columns or model.distortion is None:
        return rows
    prior = np.zeros((1, len(columns)))
    prior[0, PARAMETER_COUNT] = 1.0 / offset_sigma_mm
    return np.concatenate([rows, prior])


def centred(model: SensorModel, middle_mm: Array) -> SensorModel:
    """Return the camera in a world whose origin is at ``middle_mm`` (3,).

    From far away, a turn and a shift look alike.
    """
    shift = model.rotation @ middle_mm
    distortion = model.distortion
    if distortion is not None:
        distortion = replace(distortion, offset_y_mm=distortion.offset_y_mm + float(shift[1]))
    return replace(
        model,
        offset_x_mm=model.offset_x_mm + float(shift[0]),
        offset_z_mm=model.offset_z_mm + float(shift[2]),
        distortion=distortion,
    )


def check_determined(
    model: SensorModel, points_mm: Array, weights: Array, offset_sigma_mm: float | None = None
) -> None:
    """Raise DegeneratePoints when the readings leave a combination of parameters open."""
    middle = points_mm.mean(axis=0)
    matrix = design(centred(model, middle), points_mm - middle, weights, offset_sigma_mm)
    ratio = determined_ratio(matrix)
    plain = model.distortion is None
    least = DETERMINED_RATIO if plain else DISTORTED_RATIO
    if not ratio >= least:
        terms = "" if plain else " or take fewer distortion terms"
        raise DegeneratePoints(
            f"sensor {model.name} cannot be calibrated with these {len(points_mm)} control points: "
            "seen along its slit they coincide or line up so that many cameras fit as well "
            f"(ratio of singular values {ratio:.1e}, at least {least:g} is needed); "
            f"add points off their grid{terms}",
            sensor=model.name,
        )


def determined_ratio(matrix: Array) -> float:
    """Return the smallest over the largest singular value with columns scaled to length 1."""
    scale = np.linalg.norm(matrix, axis=0)
    if not (scale > 0.0).all() or not np.isfinite(matrix).all():
        return 0.0
    singular = np.linalg.svd(matrix / scale, compute_uv=False)
    return float(singular[-1] / singular[0])


def cofactor(matrix: Array) -> Array:
    """Return (A'A)^-1 of a design (N, F), shape (F, F), through QR with scaled columns."""
    scale = np.linalg.norm(matrix, axis=0)
    triangle = np.linalg.qr(matrix / scale, mode="r")
    inverse = np.linalg.inv(triangle) / scale[:, None]
    product: Array = inverse @ inverse.T
    return product
