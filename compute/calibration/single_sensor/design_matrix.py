"""Design matrices of fitted cameras, and whether readings determine all parameters."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.settings import depends_on_v
from compute.calibration.single_sensor.lens_prior import LensPrior
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


def effective_parameters(cofactors: Array, information: Array) -> Array:
    """Return the number of parameters that the readings determine and not the prior, (B,).

    The trace of N^-1 (N - P), with P the prior's (MacKay, doi:10.1162/neco.1992.4.3.415).

    Args:
        cofactors: N^-1, shape (B, F, F).
        information: diagonals of P, shape (B, F).
    """
    by_prior = np.diagonal(cofactors, axis1=1, axis2=2) * information
    return np.asarray(cofactors.shape[1] - by_prior.sum(axis=1))


def fitted_columns(model: SensorModel) -> NDArray[np.intp]:
    """Return which parameters of a model are fitted: all but a lens offset without effect."""
    columns = np.arange(model.parameter_count)
    if model.distortion is not None and not depends_on_v(model.distortion.terms):
        columns = np.delete(columns, PARAMETER_COUNT)
    return columns


@dataclass(frozen=True, eq=False)
class EquationGroup:
    """Equations of sensors with the same fitted parameters, as QR factors.

    Args:
        sensors: their indices, shape (G,).
        columns: their fitted parameters, shape (F,).
        scale: lengths of the columns, shape (G, F).
        triangles: R of the columns scaled to length 1, shape (G, F, F).
        information: diagonals of the priors' inverse covariances, shape (G, F).
        origin_mm: origin of the equations in the sensors' directions, shape (G, 3) [mm]: the
            centroid of the points is better conditioned than the world's origin.
    """

    sensors: NDArray[np.intp]
    columns: NDArray[np.intp]
    scale: Array
    triangles: Array
    information: Array
    origin_mm: Array

    @property
    def ratios(self) -> Array:
        """Smallest over largest singular value, shape (G,); 0 with an empty column."""
        singular = np.linalg.svd(self.triangles, compute_uv=False)
        return np.asarray(singular[:, -1] / np.maximum(singular[:, 0], 1e-300))

    @cached_property
    def cofactors(self) -> Array:
        """(A'A)^-1 of the design matrices A about the world's origin, shape (G, F, F)."""
        inverse = np.linalg.inv(self.triangles) / self.scale[:, :, None]
        if self.origin_mm.any():
            # A rotation about the centroid moves the world's origin, and so the offsets x, z, y.
            x, y, z = self.origin_mm.T[:, :, None]
            rotation = inverse[:, 2:5].copy()
            inverse[:, 5] += y * rotation[:, 2] - z * rotation[:, 1]
            inverse[:, 6] += x * rotation[:, 1] - y * rotation[:, 0]
            if PARAMETER_COUNT in self.columns:
                inverse[:, 7] += z * rotation[:, 0] - x * rotation[:, 2]
        return np.asarray(inverse @ inverse.swapaxes(1, 2))


def equation_groups(
    models: Sequence[SensorModel],
    points_mm: Array,
    weights: Array,
    prior: LensPrior | None = None,
    centre_mm: Array | None = None,
    stack: CameraStack | None = None,
) -> list[EquationGroup]:
    """Factorise the design matrices of S cameras, grouped by their fitted parameters.

    Args:
        models: the S cameras.
        points_mm: control points, shape (N, 3) [mm].
        weights: 1 / standard deviation, shape (N, S) [1/px]; 0: not read.
        prior: of the lenses; None: none.
        centre_mm: origin, shape (3,) [mm]; None: the world's.
        stack: the same cameras as a stack; None: made here.
    """
    if stack is None:
        stack = CameraStack.of(models)
    origin = np.zeros((len(stack), 3))
    if centre_mm is not None:
        origin = stack.rotation @ centre_mm
        stack = replace(stack, offset_mm=stack.offset_mm + origin)
        points_mm = points_mm - centre_mm
    jacobian = stack.parameter_jacobian(points_mm).swapaxes(0, 1)
    used = weights.T[..., None]
    rows = np.where(used > 0.0, jacobian, 0.0) * used
    information = None
    if prior is not None and stack.has_distortion:
        information = prior.gaussian(stack)[1]
    groups: dict[tuple[int, ...], list[int]] = {}
    for sensor, model in enumerate(models):
        columns = fitted_columns(model)
        # By the stack's columns, which hold the terms of all sensors.
        stack_columns = np.flatnonzero(stack.parameter_mask[sensor])[columns]
        groups.setdefault((*stack_columns.tolist(), -1, *columns.tolist()), []).append(sensor)
    equations = []
    for key, members in groups.items():
        split = key.index(-1)
        stack_columns, columns = np.array(key[:split]), np.array(key[split + 1 :])
        sensors = np.array(members)
        matrix = rows[sensors][:, :, stack_columns]
        prior_information = np.zeros((len(sensors), len(stack_columns)))
        if information is not None:
            prior_information = information[np.ix_(sensors, stack_columns)]
            of_prior = np.sqrt(prior_information)[:, :, None] * np.eye(len(stack_columns))
            matrix = np.concatenate([matrix, of_prior], axis=1)
        scale = np.sqrt((matrix**2).sum(axis=1))
        scale = np.where(scale > 0.0, scale, 1.0)
        scaled = matrix / scale[:, None, :]
        triangles = np.asarray(np.linalg.qr(scaled, mode="r"), dtype=np.float64)
        equations.append(
            EquationGroup(sensors, columns, scale, triangles, prior_information, origin[sensors])
        )
    return equations


def check_determined(
    models: Sequence[SensorModel],
    points_mm: Array,
    weights: Array,
    prior: LensPrior | None = None,
    stack: CameraStack | None = None,
) -> list[EquationGroup]:
    """Check that the readings determine all parameters of each sensor.

    Args:
        models: the S cameras.
        points_mm: control points, shape (N, 3) [mm].
        weights: 1 / standard deviation, shape (N, S) [1/px]; 0: not read.
        prior: of the lenses; None: none.
        stack: the same cameras as a stack; None: made here.

    Returns:
        The equations about the points' centroid.

    Raises:
        DegeneratePoints: the first sensor with an undetermined combination of parameters.
    """
    groups = equation_groups(models, points_mm, weights, prior, points_mm.mean(axis=0), stack)
    for sensor, ratio in _undetermined(groups, models):
        model = models[sensor]
        terms = "" if model.distortion is None else " or take fewer distortion terms"
        raise DegeneratePoints(
            f"sensor {model.name} cannot be calibrated with these "
            f"{int((weights[:, sensor] > 0.0).sum())} control points: seen along its slit "
            "they coincide or line up so that many cameras fit as well "
            f"(ratio of singular values {ratio:.1e}, at least {_min_ratio(model):g} is needed); "
            f"add points off their grid{terms}",
            sensor=model.name,
        )
    return groups


def undetermined_sensors(
    models: Sequence[SensorModel],
    points_mm: Array,
    weights: Array,
    prior: LensPrior | None = None,
) -> list[tuple[int, float]]:
    """Return the sensors with an undetermined combination of parameters.

    Args:
        models: the S cameras.
        points_mm: control points, shape (N, 3) [mm].
        weights: 1 / standard deviation, shape (N, S) [1/px]; 0: not read.
        prior: of the lenses; None: none.

    Returns:
        Their indices, each with the ratio of singular values of its Jacobian.
    """
    centre = points_mm.mean(axis=0)
    return _undetermined(equation_groups(models, points_mm, weights, prior, centre), models)


def _undetermined(
    groups: Sequence[EquationGroup], models: Sequence[SensorModel]
) -> list[tuple[int, float]]:
    return [
        (sensor, ratio)
        for group in groups
        for sensor, ratio in zip(group.sensors.tolist(), group.ratios.tolist(), strict=True)
        if not ratio >= _min_ratio(models[sensor])
    ]


def _min_ratio(model: SensorModel) -> float:
    return MIN_SINGULAR_RATIO if model.distortion is None else MIN_SINGULAR_RATIO_DISTORTED
