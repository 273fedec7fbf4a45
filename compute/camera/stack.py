"""Several 1D cameras as arrays: projection of points and its Jacobians, batched."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from compute.camera.field_distortion import Term, term_derivatives, term_values
from compute.camera.model import PARAMETER_COUNT, SensorModel, vector3
from compute.transform import rotation_matrix, rotation_vector

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CameraStack:
    """S cameras, parameter by parameter; made once for a calibration, then used for batches.

    Args:
        principal_distance_px: c, shape (S,) [px].
        principal_point_px: p0, shape (S,) [px].
        rotation: R_sensor_world, shape (S, 3, 3).
        offset_mm: the world's origin in the sensors' frames, x, y, z, shape (S, 3) [mm]; y is 0
            and of no meaning where a sensor has no distortion.
        cubic_per_px2: D of thesis [5.2], shape (S,) [1/px^2].
        terms: all terms of the sensors' distortions, K of them; empty without distortion.
        coefficients: of the terms, shape (S, K); 0 where a sensor has not got one.
        row_behind_mm: shape (S,) [mm], see ``FieldDistortion``.
        parameter_index: where each sensor's columns are in the list of all its own parameters,
            sensor by sensor, shape (S, width); -1 for a parameter that it has not got.
    """

    principal_distance_px: Array
    principal_point_px: Array
    rotation: Array
    offset_mm: Array
    cubic_per_px2: Array
    terms: tuple[Term, ...]
    coefficients: Array
    row_behind_mm: Array
    parameter_index: NDArray[np.intp]

    @classmethod
    def of(cls, models: Sequence[SensorModel]) -> "CameraStack":
        """Gather the models' parameters in order."""
        distortions = [model.distortion for model in models]
        # A dict keeps the order in which terms first come up.
        terms = tuple(dict.fromkeys(t for d in distortions if d is not None for t in d.terms))
        distorted = any(d is not None for d in distortions)
        width = PARAMETER_COUNT + (1 + len(terms) if distorted else 0)
        coefficients = np.zeros((len(models), len(terms)))
        parameter_index = np.full((len(models), width), -1, dtype=np.intp)
        first = 0
        for row, (model, distortion) in enumerate(zip(models, distortions, strict=True)):
            columns = list(range(PARAMETER_COUNT))
            if distortion is not None:
                columns_of_terms = [terms.index(term) for term in distortion.terms]
                coefficients[row, columns_of_terms] = distortion.coefficients
                columns += [
                    PARAMETER_COUNT,
                    *(PARAMETER_COUNT + 1 + column for column in columns_of_terms),
                ]
            parameter_index[row, columns] = np.arange(first, first + len(columns))
            first += model.parameter_count
        return cls(
            np.array([model.principal_distance_px for model in models], dtype=np.float64),
            np.array([model.principal_point_px for model in models], dtype=np.float64),
            np.array([model.rotation for model in models]).reshape(-1, 3, 3),
            np.array(
                [
                    (model.offset_x_mm, 0.0 if d is None else d.offset_y_mm, model.offset_z_mm)
                    for model, d in zip(models, distortions, strict=True)
                ]
            ).reshape(-1, 3),
            np.array([model.cubic_per_px2 for model in models], dtype=np.float64),
            terms,
            coefficients,
            np.array([0.0 if d is None else d.row_behind_mm for d in distortions]),
            parameter_index,
        )

    def models(self, like: Sequence[SensorModel]) -> tuple[SensorModel, ...]:
        """Return the cameras one by one; names, pixels and terms are those of ``like`` (S)."""
        vectors = rotation_vector(self.rotation)
        models = []
        for row, model in enumerate(like):
            distortion = model.distortion
            if distortion is not None:
                columns_of_terms = [self.terms.index(term) for term in distortion.terms]
                distortion = replace(
                    distortion,
                    coefficients=tuple(self.coefficients[row, columns_of_terms].tolist()),
                    offset_y_mm=float(self.offset_mm[row, 1]),
                )
            models.append(
                replace(
                    model,
                    principal_distance_px=float(self.principal_distance_px[row]),
                    principal_point_px=float(self.principal_point_px[row]),
                    rotation_vector_rad=vector3(vectors[row]),
                    offset_x_mm=float(self.offset_mm[row, 0]),
                    offset_z_mm=float(self.offset_mm[row, 2]),
                    distortion=distortion,
                )
            )
        return tuple(models)

    def retract(self, steps: Array) -> "CameraStack":
        """Return the cameras after steps of their parameters, shape (S, width).

        Steps of what a camera has not got must be 0.
        """
        offset = self.offset_mm.copy()
        offset[:, ::2] += steps[:, 5:7]
        coefficients = self.coefficients
        if self.has_distortion:
            offset[:, 1] += steps[:, 7]
            coefficients = coefficients + steps[:, 8:]
        return replace(
            self,
            principal_distance_px=self.principal_distance_px + steps[:, 0],
            principal_point_px=self.principal_point_px + steps[:, 1],
            rotation=rotation_matrix(steps[:, 2:5]) @ self.rotation,
            offset_mm=offset,
            coefficients=coefficients,
        )

    def rows(self, index: NDArray[np.intp]) -> "CameraStack":
        """Return some of the cameras, with the same columns."""
        arrays = {field.name: getattr(self, field.name) for field in fields(self)}
        return CameraStack(
            **{name: a if name == "terms" else a[index] for name, a in arrays.items()}
        )

    def __len__(self) -> int:
        """Return the number of cameras."""
        return len(self.principal_distance_px)

    @property
    def has_distortion(self) -> bool:
        """Whether any camera has distortion by its field angles."""
        return self.width > PARAMETER_COUNT

    @property
    def width(self) -> int:
        """Parameters of a sensor in the Jacobians: 7, or 8 + K with distortion."""
        return int(self.parameter_index.shape[1])

    @cached_property
    def parameter_mask(self) -> NDArray[np.bool_]:
        """Mask of the ``width`` parameters that each sensor has, shape (S, width)."""
        return self.parameter_index >= 0

    def covariance_blocks(self, covariance: Array) -> Array:
        """Return a joint covariance (P, P) by sensor and column, shape (S, width, S, width).

        P counts the parameters that the sensors have, sensor by sensor in the order of
        ``SensorModel.parameter_names``; what a sensor has not got is certain, 0.
        """
        here = np.flatnonzero(self.parameter_mask)
        order = self.parameter_index.ravel()[here]
        full = np.zeros((self.parameter_index.size, self.parameter_index.size))
        full[np.ix_(here, here)] = covariance[np.ix_(order, order)]
        return full.reshape(len(self), self.width, len(self), self.width)

    @cached_property
    def matrices(self) -> Array:
        """The 2x4 matrices (m1; m2) with ``p = m1.X~ / m2.X~``, shape (S, 2, 4), undistorted.

        In this gauge m2 is the viewing axis, so that m2.X~ is the depth in mm.
        """
        along = np.concatenate([self.rotation[:, 0], self.offset_mm[:, :1]], axis=1)
        depth = np.concatenate([self.rotation[:, 2], self.offset_mm[:, 2:]], axis=1)
        first = (
            self.principal_distance_px[:, None] * along + self.principal_point_px[:, None] * depth
        )
        return np.stack([first, depth], axis=1)

    def add_cubic_term(self, readings_px: Array) -> Array:
        """Return readings (..., S) with the cubic distortion term added, thesis [5.12]."""
        return readings_px + self.cubic_per_px2 * (readings_px - self.principal_point_px) ** 3

    def correction_derivative(self, readings_px: Array) -> Array:
        """Return d corrected / d reading, shape (..., S): scales a reading's sigma."""
        return 1.0 + 3.0 * self.cubic_per_px2 * (readings_px - self.principal_point_px) ** 2

    def project(self, points_mm: Array) -> Array:
        """Project points (N, 3) [mm] to corrected readings (N, S) [px].

        NaN where the point does not lie in front of the lens. A reading may lie outside the
        sensor: the line of pixels has an end, the projection has none.
        """
        if self.has_distortion:
            return self._distorted(points_mm)[0]
        u, _ = self._field_and_depth(points_mm)
        return self.principal_point_px + self.principal_distance_px * u

    def _field_and_depth(self, points_mm: Array) -> tuple[Array, Array]:
        """Return u = x/z and the depth z [mm], both (N, S); NaN at and behind the lens."""
        sensor: Array = np.einsum("sij,nj->nsi", self.rotation[:, ::2], points_mm)
        sensor += self.offset_mm[:, ::2]
        depth = np.where(sensor[..., 1] > 0.0, sensor[..., 1], np.nan)
        return sensor[..., 0] / depth, depth

    def field_angles(self, points_mm: Array) -> tuple[Array, Array]:
        """Return u = x/z and v = y/(z + row_behind), both (N, S); NaN at and behind the lens.

        v is the field angle along the slit only where the sensor has distortion: see offset_mm.
        """
        sensor: Array = np.einsum("sij,nj->nsi", self.rotation, points_mm) + self.offset_mm
        depth = np.where(sensor[..., 2] > 0.0, sensor[..., 2], np.nan)
        return sensor[..., 0] / depth, sensor[..., 1] / (depth + self.row_behind_mm)

    def linearise(self, points_mm: Array) -> tuple[Array, Array]:
        """Project points (N, 3) and return readings (N, S) and d reading / d point (N, S, 3)."""
        if self.has_distortion:
            reading, by_frame, _, _ = self._distorted(points_mm)
            slope: Array = np.einsum("nsi,sij->nsj", by_frame, self.rotation)
            return reading, slope
        u, depth = self._field_and_depth(points_mm)
        gain = self.principal_distance_px / depth
        slope = gain[..., None] * (self.rotation[:, 0] - u[..., None] * self.rotation[:, 2])
        return self.principal_point_px + self.principal_distance_px * u, slope

    def parameter_jacobian(self, points_mm: Array) -> Array:
        """Return d reading / d parameters, shape (N, S, width).

        The order is that of PARAMETERS, then offset_y_mm and the terms' coefficients where any
        sensor has distortion; 0 for what a sensor has not got.
        """
        return self.project_with_parameter_jacobian(points_mm)[1]

    def project_with_parameter_jacobian(self, points_mm: Array) -> tuple[Array, Array]:
        """Project points (N, 3); readings (N, S) [px] and ``parameter_jacobian``."""
        # One product of matrices: einsum takes several times as long for few points.
        rotated = (points_mm @ self.rotation.reshape(-1, 3).T).reshape(len(points_mm), len(self), 3)
        if not self.has_distortion:
            depth = rotated[..., 2] + self.offset_mm[:, 2]
            depth = np.where(depth > 0.0, depth, np.nan)
            u = (rotated[..., 0] + self.offset_mm[:, 0]) / depth
            jacobian = _undistorted_jacobian(rotated, u, self.principal_distance_px / depth)
            return self.principal_point_px + self.principal_distance_px * u, jacobian
        reading, by_frame, angle, values = self._distorted(points_mm)
        jacobian = np.empty((*angle.shape, self.width))
        jacobian[..., 0] = angle
        jacobian[..., 1] = 1.0
        # A left rotation w moves R X by w x R X.
        a, b, d = rotated[..., 0], rotated[..., 1], rotated[..., 2]
        x, y, z = by_frame[..., 0], by_frame[..., 1], by_frame[..., 2]
        jacobian[..., 2] = b * z - d * y
        jacobian[..., 3] = d * x - a * z
        jacobian[..., 4] = a * y - b * x
        jacobian[..., 5] = x
        jacobian[..., 6] = z
        jacobian[..., 7] = y
        jacobian[..., 8:] = self.principal_distance_px[:, None] * values
        if not self.parameter_mask.all():
            jacobian *= self.parameter_mask
        return reading, jacobian

    def _distorted(self, points_mm: Array) -> tuple[Array, Array, Array, Array]:
        """Return readings, their slopes by a shift in the sensor's frame, u + d, and the terms.

        Shapes (N, S), (N, S, 3), (N, S) and (N, S, K).
        """
        sensor: Array = np.einsum("sij,nj->nsi", self.rotation, points_mm) + self.offset_mm
        depth = np.where(sensor[..., 2] > 0.0, sensor[..., 2], np.nan)
        to_row = depth + self.row_behind_mm
        u, v = sensor[..., 0] / depth, sensor[..., 1] / to_row
        values = term_values(u, v, self.terms)
        slope_u, slope_v = term_derivatives(u, v, self.terms)
        angle = u + np.einsum("nsk,sk->ns", values, self.coefficients)
        c = self.principal_distance_px
        by_frame = np.empty((*u.shape, 3))
        by_frame[..., 0] = c / depth * (1.0 + np.einsum("nsk,sk->ns", slope_u, self.coefficients))
        by_frame[..., 1] = c / to_row * np.einsum("nsk,sk->ns", slope_v, self.coefficients)
        by_frame[..., 2] = -(u * by_frame[..., 0] + v * by_frame[..., 1])
        return self.principal_point_px + c * angle, by_frame, angle, values


def _undistorted_jacobian(rotated_mm: Array, u: Array, gain: Array) -> Array:
    """Return d reading / d parameters without distortion, shape (..., 7), as in PARAMETERS.

    Args:
        rotated_mm: R X, the points turned but not shifted, shape (..., 3) [mm].
        u: tangent of the field angle along the sensor, x/z, shape (...).
        gain: c / depth, shape (...) [px/mm].
    """
    a, b, d = rotated_mm[..., 0], rotated_mm[..., 1], rotated_mm[..., 2]
    jacobian = np.empty((*u.shape, PARAMETER_COUNT))
    jacobian[..., 0] = u
    jacobian[..., 1] = 1.0
    # A left rotation w moves R X by w x R X; only its x and z components are read.
    jacobian[..., 2] = -gain * u * b
    jacobian[..., 3] = gain * (d + u * a)
    jacobian[..., 4] = -gain * b
    jacobian[..., 5] = gain
    jacobian[..., 6] = -gain * u
    return jacobian
