"""Design matrices of fitted cameras: weighted Jacobian, condition, cofactor."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.single_sensor.distortion_terms import depends_on_v
from compute.camera.model import PARAMETER_COUNT, SensorModel
from compute.camera.stack import CameraStack
from compute.errors import DegeneratePoints

Array = NDArray[np.float64]

MIN_SINGULAR_RATIO: Final = 1e-5
"""Smallest ratio of singular values of the Jacobian with columns of length 1. The measured and
simulated frames of the thesis have 1e-4 and more; the corners of a box that a sensor sees along
its edges, 1e-5 and less even with noise."""
MIN_SINGULAR_RATIO_DISTORTED: Final = 1e-7
"""The same with distortion, whose terms are alike where the field is small; below it, normal
equations hold nothing but rounding of the least combination."""


def fitted_columns(model: SensorModel) -> NDArray[np.intp]:
    """Return which parameters of a model are fitted: all but a lens offset without effect."""
    columns = np.arange(model.parameter_count)
    if model.distortion is not None and not depends_on_v(model.distortion.terms):
        columns = np.delete(columns, PARAMETER_COUNT)
    return columns


def design_matrix(
    model: SensorModel, points_mm: Array, weights: Array, offset_sigma_mm: float | None = None
) -> Array:
    """Return the weighted Jacobian of the fitted parameters, shape (N, F) or (N + 1, F).

    Args:
        model: the camera.
        points_mm: points that it read, shape (N, 3) [mm].
        weights: 1 / standard deviation, shape (N,) [1/px].
        offset_sigma_mm: standard deviation of the prior of the lens offset along the slit [mm], an
            extra row where that is fitted; None: no prior.
    """
    columns = fitted_columns(model)
    rows = CameraStack.of([model]).parameter_jacobian(points_mm)[:, 0, columns]
    rows = rows * weights[:, None]
    if offset_sigma_mm is None or PARAMETER_COUNT not in columns or model.distortion is None:
        return rows
    prior = np.zeros((1, len(columns)))
    prior[0, PARAMETER_COUNT] = 1.0 / offset_sigma_mm
    return np.concatenate([rows, prior])


def recentred_camera(model: SensorModel, centre_mm: Array) -> SensorModel:
    """Return the camera in a world with another origin.

    Far from the origin, a rotation and a translation have nearly the same effect.

    Args:
        model: the camera.
        centre_mm: the new origin, shape (3,) [mm].
    """
    shift = model.rotation @ centre_mm
    distortion = model.distortion
    if distortion is not None:
        distortion = replace(distortion, offset_y_mm=distortion.offset_y_mm + float(shift[1]))
    return replace(
        model,
        offset_x_mm=model.offset_x_mm + float(shift[0]),
        offset_z_mm=model.offset_z_mm + float(shift[2]),
        distortion=distortion,
    )


@dataclass(frozen=True, eq=False)
class EquationGroup:
    """Equations of sensors with the same fitted parameters, as QR factors.

    Args:
        sensors: their indices, shape (G,).
        columns: their fitted parameters, shape (F,).
        scale: lengths of the columns, shape (G, F).
        triangles: R of the columns scaled to length 1, shape (G, F, F).
    """

    sensors: NDArray[np.intp]
    columns: NDArray[np.intp]
    scale: Array
    triangles: Array

    @property
    def ratios(self) -> Array:
        """Smallest over largest singular value, shape (G,); 0 with an empty column."""
        singular = np.linalg.svd(self.triangles, compute_uv=False)
        ratios: Array = singular[:, -1] / np.maximum(singular[:, 0], 1e-300)
        return ratios

    @property
    def cofactors(self) -> Array:
        """(A'A)^-1 of the design matrices A, shape (G, F, F)."""
        inverse = np.linalg.inv(self.triangles) / self.scale[:, :, None]
        product: Array = inverse @ inverse.swapaxes(1, 2)
        return product


def equation_groups(
    models: Sequence[SensorModel],
    points_mm: Array,
    weights: Array,
    offset_sigma_mm: Array | None = None,
    centre_mm: Array | None = None,
    stack: CameraStack | None = None,
) -> list[EquationGroup]:
    """Factorise the design matrices of S cameras, grouped by their fitted parameters.

    Args:
        models: the S cameras.
        points_mm: control points, shape (N, 3) [mm].
        weights: 1 / standard deviation, shape (N, S) [1/px]; 0: not read.
        offset_sigma_mm: standard deviations of the priors of the lens offsets, shape (S,) [mm].
        centre_mm: origin, shape (3,) [mm]; None: the world's.
        stack: the same cameras as a stack; None: made here.
    """
    if stack is None:
        stack = CameraStack.of(models)
    if centre_mm is not None:
        moved = stack.offset_mm + stack.rotation @ centre_mm
        stack, points_mm = replace(stack, offset_mm=moved), points_mm - centre_mm
    jacobian = stack.parameter_jacobian(points_mm).swapaxes(0, 1)
    used = weights.T[..., None]
    rows = np.where(used > 0.0, jacobian, 0.0) * used
    groups: dict[tuple[int, ...], list[int]] = {}
    for sensor, model in enumerate(models):
        columns = fitted_columns(model)
        # By the stack's columns, which hold the terms of all sensors.
        stack_columns = np.flatnonzero(stack.parameter_mask[sensor])[columns]
        groups.setdefault((*stack_columns.tolist(), -1, *columns.tolist()), []).append(sensor)
    found = []
    for key, members in groups.items():
        split = key.index(-1)
        stack_columns, columns = np.array(key[:split]), np.array(key[split + 1 :])
        sensors = np.array(members)
        matrix = rows[sensors][:, :, stack_columns]
        if offset_sigma_mm is not None and PARAMETER_COUNT in key[:split]:
            prior = np.zeros((len(sensors), 1, len(stack_columns)))
            prior[:, 0, key.index(PARAMETER_COUNT)] = 1.0 / offset_sigma_mm[sensors]
            matrix = np.concatenate([matrix, prior], axis=1)
        scale = np.sqrt((matrix**2).sum(axis=1))
        scale = np.where(scale > 0.0, scale, 1.0)
        scaled = matrix / scale[:, None, :]
        triangles = np.asarray(np.linalg.qr(scaled, mode="r"), dtype=np.float64)
        found.append(EquationGroup(sensors, columns, scale, triangles))
    return found


def check_determined(
    models: Sequence[SensorModel],
    points_mm: Array,
    weights: Array,
    offset_sigma_mm: Array | None = None,
    stack: CameraStack | None = None,
) -> None:
    """Check that the readings determine all parameters of each sensor.

    Args:
        models: the S cameras.
        points_mm: control points, shape (N, 3) [mm].
        weights: 1 / standard deviation, shape (N, S) [1/px]; 0: not read.
        offset_sigma_mm: standard deviations of the priors of the lens offsets, shape (S,) [mm].
        stack: the same cameras as a stack; None: made here.

    Raises:
        DegeneratePoints: the first sensor with an undetermined combination of parameters.
    """
    middle = points_mm.mean(axis=0)
    for group in equation_groups(models, points_mm, weights, offset_sigma_mm, middle, stack):
        for sensor, ratio in zip(group.sensors, group.ratios.tolist(), strict=True):
            model = models[sensor]
            plain = model.distortion is None
            least = MIN_SINGULAR_RATIO if plain else MIN_SINGULAR_RATIO_DISTORTED
            if ratio >= least:
                continue
            terms = "" if plain else " or take fewer distortion terms"
            raise DegeneratePoints(
                f"sensor {model.name} cannot be calibrated with these "
                f"{int((weights[:, sensor] > 0.0).sum())} control points: seen along its slit "
                "they coincide or line up so that many cameras fit as well "
                f"(ratio of singular values {ratio:.1e}, at least {least:g} is needed); "
                f"add points off their grid{terms}",
                sensor=model.name,
            )


def cofactor(matrix: Array) -> Array:
    """Return (A'A)^-1 of a design matrix (N, F), shape (F, F), by QR with scaled columns."""
    scale = np.linalg.norm(matrix, axis=0)
    triangle = np.linalg.qr(matrix / scale, mode="r")
    inverse = np.linalg.inv(triangle) / scale[:, None]
    product: Array = inverse @ inverse.T
    return product
