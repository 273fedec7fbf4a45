"""SensorPrior: Gaussian prior of the sensors' parameters."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from compute.calibration.bundle_adjustment.gauge import shift_origins
from compute.camera.model import PARAMETER_COUNT, SensorModel

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SensorPrior:
    """Prior means of all sensors' parameters with their information.

    Args:
        models: the means; the sensors that are adjusted, with the same terms.
        information: inverse covariance, shape (P, P), sensor by sensor in the order of
            ``SensorModel.parameter_names``; 0 for parameters without a prior. It may be singular.
        origins_mm: points of the world about which the sensors' rotations and offsets count in the
            prior, shape (S, 3) [mm]; None: the world's origin.
    """

    models: tuple[SensorModel, ...]
    information: Array
    origins_mm: Array | None = None

    @classmethod
    def of_lens_offsets(
        cls, models: Sequence[SensorModel], sigma_mm: Sequence[float] | Array
    ) -> "SensorPrior | None":
        """Return the prior of the lens offsets along the slits; None where no sensor has any.

        Args:
            models: S cameras at the prior's means.
            sigma_mm: standard deviations, shape (S,) [mm].
        """
        if all(model.distortion is None for model in models):
            return None
        information = []
        for model, sigma in zip(models, sigma_mm, strict=True):
            diagonal = np.zeros(model.parameter_count)
            if model.distortion is not None:
                diagonal[PARAMETER_COUNT] = float(sigma) ** -2.0
            information.append(diagonal)
        return cls(tuple(models), np.diag(np.concatenate(information)))

    def difference(self, models: Sequence[SensorModel]) -> tuple[Array, Array]:
        """Return models minus means (P,), and its Jacobian by the parameters (P, P)."""
        origins = np.zeros((len(models), 3)) if self.origins_mm is None else self.origins_mm
        steps = []
        jacobian = shift_origins(
            models, [model.rotation @ origin for model, origin in zip(models, origins, strict=True)]
        )
        first = 0
        for old, new, origin in zip(self.models, models, origins, strict=True):
            step = step_between(old, new)
            shift = (new.rotation - old.rotation) @ origin
            step[5:7] += shift[[0, 2]]
            if new.distortion is not None:
                step[PARAMETER_COUNT] += shift[1]
            rotation_rows = slice(first + 2, first + 5)
            jacobian[rotation_rows, rotation_rows] = inverse_left_jacobian(step[2:5])
            steps.append(step)
            first += len(step)
        return np.concatenate(steps), jacobian


def step_between(start: SensorModel, end: SensorModel) -> Array:
    """Return the parameter step with ``start.retract(step) == end``.

    Args:
        start: a camera.
        end: the same camera with other values.

    Returns:
        Shape (``parameter_count``,), in the order of ``SensorModel.parameter_names``.
    """
    rotation = (
        Rotation.from_rotvec(end.rotation_vector_rad)
        * Rotation.from_rotvec(start.rotation_vector_rad).inv()
    )
    step = np.empty(start.parameter_count)
    step[0] = end.principal_distance_px - start.principal_distance_px
    step[1] = end.principal_point_px - start.principal_point_px
    step[2:5] = rotation.as_rotvec()
    step[5] = end.offset_x_mm - start.offset_x_mm
    step[6] = end.offset_z_mm - start.offset_z_mm
    if start.distortion is not None and end.distortion is not None:
        step[PARAMETER_COUNT] = end.distortion.offset_y_mm - start.distortion.offset_y_mm
        step[PARAMETER_COUNT + 1 :] = np.subtract(
            end.distortion.coefficients, start.distortion.coefficients
        )
    return step


def inverse_left_jacobian(vector: Array) -> Array:
    """Return d log(exp([w]x) exp([v]x)) / d w at w = 0 for a rotation vector v, shape (3, 3)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector.tolist()
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    second = 1.0 / 12.0
    if angle > 1e-4:
        second = 1.0 / angle**2 - (1.0 + np.cos(angle)) / (2.0 * angle * np.sin(angle))
    return np.asarray(np.eye(3) - 0.5 * cross + second * (cross @ cross))
