"""Rotations (vectors, matrices, quaternions) and rigid transforms between frames, with covariance.

Functions of arrays, and faster ones (exp_so3, hat_so3) of one vector.
"""

from dataclasses import dataclass
from math import sin, sqrt
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from compute.errors import InvalidParameter, NonFiniteValue

Array = NDArray[np.float64]

_SMALL_RAD = 1e-4
_ORTHONORMALITY_TOLERANCE = 1e-6
"""Largest deviation of R R' from the identity: float32 and printed digits are accepted."""


def rotation_matrix(vector_rad: Array) -> Array:
    """Return exp([w]x) of rotation vectors (..., 3) [rad], shape (..., 3, 3) (Rodrigues)."""
    w = np.asarray(vector_rad, dtype=np.float64)
    square = (w**2).sum(axis=-1)
    angle = np.sqrt(square)
    small = angle < _SMALL_RAD
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 1.0 - square / 6.0, np.sin(safe) / safe)
    half = np.sin(0.5 * safe) / safe
    second = np.where(small, 0.5 - square / 24.0, 2.0 * half**2)
    x, y, z = w[..., 0], w[..., 1], w[..., 2]
    # I + a [w]x + b [w]x^2 with [w]x^2 = w w' - |w|^2 I.
    matrix = second[..., None, None] * (w[..., :, None] * w[..., None, :])
    diagonal = 1.0 - second * square
    for axis in range(3):
        matrix[..., axis, axis] += diagonal
    matrix[..., 0, 1] -= first * z
    matrix[..., 1, 0] += first * z
    matrix[..., 0, 2] += first * y
    matrix[..., 2, 0] -= first * y
    matrix[..., 1, 2] -= first * x
    matrix[..., 2, 1] += first * x
    return matrix


def rotation_vector(matrix: Array) -> Array:
    """Return the axis times angle [rad] of rotation matrices (..., 3, 3), shape (..., 3).

    It loses no digits at any angle.
    """
    quaternion = rotation_quaternion(matrix)
    sine = np.linalg.norm(quaternion[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, quaternion[..., :1])
    small = sine < 1e-12
    vector: Array = quaternion[..., 1:] * np.where(small, 2.0, angle / np.where(small, 1.0, sine))
    return vector


def rotation_quaternion(matrix: Array) -> Array:
    """Return the unit quaternions of rotation matrices (..., 3, 3), shape (..., 4).

    Scalar first, and not negative. By the largest component (S. W. Shepperd,
    doi:10.2514/3.55767b), which loses no digits at any angle.
    """
    m = np.asarray(matrix, dtype=np.float64)
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    # 4 q q', from the sums and differences of the elements.
    outer = np.empty((*m.shape[:-2], 4, 4))
    outer[..., 0, 0] = 1.0 + trace
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        outer[..., axis + 1, axis + 1] = 1.0 + 2.0 * m[..., axis, axis] - trace
        turned = m[..., second, first] - m[..., first, second]
        outer[..., 0, axis + 1] = outer[..., axis + 1, 0] = turned
        swept = m[..., first, second] + m[..., second, first]
        outer[..., first + 1, second + 1] = outer[..., second + 1, first + 1] = swept
    largest = np.argmax(np.einsum("...ii->...i", outer), axis=-1)
    quaternion = np.take_along_axis(outer, largest[..., None, None], axis=-2)[..., 0, :]
    quaternion /= np.linalg.norm(quaternion, axis=-1, keepdims=True)
    upper: Array = quaternion * np.where(quaternion[..., :1] < 0.0, -1.0, 1.0)
    return upper


def exp_so3(vector_rad: Array) -> Array:
    """Return exp([w]x) of one rotation vector (3,) [rad], shape (3, 3), as rotation_matrix does."""
    x, y, z = vector_rad.tolist()
    square = x * x + y * y + z * z
    angle = sqrt(square)
    if angle < _SMALL_RAD:
        first, second = 1.0 - square / 6.0, 0.5 - square / 24.0
    else:
        half = sin(0.5 * angle) / angle
        first, second = sin(angle) / angle, 2.0 * half * half
    diagonal = 1.0 - second * square
    sx, sy, sz = second * x, second * y, second * z
    xy, xz, yz = sx * y, sx * z, sy * z
    fx, fy, fz = first * x, first * y, first * z
    return np.array(
        [
            [diagonal + sx * x, xy - fz, xz + fy],
            [xy + fz, diagonal + sy * y, yz - fx],
            [xz - fy, yz + fx, diagonal + sz * z],
        ]
    )


def hat_so3(vector: Array) -> Array:
    """Return [v]x of one vector (3,), shape (3, 3)."""
    x, y, z = vector.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


@dataclass(frozen=True, eq=False)
class Transform:
    """Rigid transform of coordinates: ``x_to = rotation @ x_from + translation_mm``.

    Args:
        rotation: R_to_from, shape (3, 3).
        translation_mm: the origin of "from" in "to", shape (3,) [mm].
        covariance: covariance of a small rotation [rad] about the axes of "to", on the left, and
            of the translation [mm], in this order as in ToolPose, shape (6, 6); None: exact.

    Raises:
        InvalidParameter: a shape is wrong, or the matrix is no rotation.
        NonFiniteValue: a value is NaN or infinite.
    """

    rotation: Array
    translation_mm: Array
    covariance: Array | None = None

    def __post_init__(self) -> None:
        expected_shapes: dict[str, tuple[int, ...]] = {"rotation": (3, 3), "translation_mm": (3,)}
        if self.covariance is not None:
            expected_shapes["covariance"] = (6, 6)
        for name, shape in expected_shapes.items():
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != shape:
                raise InvalidParameter(f"{name} has shape {value.shape}; it must be {shape}")
            if not np.isfinite(value).all():
                raise NonFiniteValue(f"{name} is {value.tolist()}; it must be finite")
            object.__setattr__(self, name, value)
        off = float(np.abs(self.rotation @ self.rotation.T - np.eye(3)).max())
        if off > _ORTHONORMALITY_TOLERANCE or np.linalg.det(self.rotation) < 0.0:
            raise InvalidParameter(
                f"the matrix is no rotation: R R' is off the identity by {off:.2g} and its "
                f"determinant is {np.linalg.det(self.rotation):.6g}; it must be 1"
            )

    @classmethod
    def identity(cls) -> Self:
        """Return the identity transform."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_rotation_vector(
        cls, vector_rad: Array, translation_mm: Array, covariance: Array | None = None
    ) -> Self:
        """Return the transform of a rotation vector and a translation.

        Args:
            vector_rad: rotation vector, shape (3,) [rad].
            translation_mm: shape (3,) [mm].
            covariance: covariance of rotation and translation, shape (6, 6); None: exact.

        Raises:
            InvalidParameter: a shape is wrong.
            NonFiniteValue: a value is NaN or infinite.
        """
        return cls(rotation_matrix(np.asarray(vector_rad)), translation_mm, covariance)

    @property
    def matrix(self) -> Array:
        """The homogeneous matrix, shape (4, 4)."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.rotation, self.translation_mm
        return matrix

    def apply(self, points_mm: Array) -> Array:
        """Return points (..., 3) of "from" in "to" [mm]."""
        moved: Array = np.asarray(points_mm) @ self.rotation.T + self.translation_mm
        return moved

    def point_covariance(self, points_mm: Array, covariance_mm2: Array | None = None) -> Array:
        """Return the covariance of ``apply``, shape (..., 3, 3) [mm^2].

        Args:
            points_mm: in "from", shape (..., 3) [mm].
            covariance_mm2: of the points themselves, shape (..., 3, 3) [mm^2]; None: exact.
        """
        points = np.asarray(points_mm, dtype=np.float64)
        covariance = np.zeros((*points.shape, 3))
        if self.covariance is not None:
            jacobian = point_jacobian(points @ self.rotation.T)
            covariance += jacobian @ self.covariance @ jacobian.swapaxes(-1, -2)
        if covariance_mm2 is not None:
            covariance += self.rotation @ covariance_mm2 @ self.rotation.T
        return covariance

    def inverse(self) -> Self:
        """Return the transform from "to" to "from", with propagated covariance."""
        back = self.rotation.T
        covariance = None
        if self.covariance is not None:
            # (exp([w]x) R)' = exp(-[R'w]x) R', and its translation is -R' exp(-[w]x) (t + d).
            jacobian = np.zeros((6, 6))
            jacobian[:3, :3] = jacobian[3:, 3:] = -back
            jacobian[3:, :3] = -back @ cross_matrix(self.translation_mm)
            covariance = jacobian @ self.covariance @ jacobian.T
        return type(self)(back, -back @ self.translation_mm, covariance)

    def __matmul__(self, other: "Transform") -> "Transform":
        """Return T_a_c = T_a_b @ T_b_c; their errors are treated as independent."""
        shift = self.rotation @ other.translation_mm
        covariance = None
        if self.covariance is not None:
            # The rotation error moves the second translation: exp([w]x) R1 t2.
            jacobian = np.eye(6)
            jacobian[3:, :3] = -cross_matrix(shift)
            covariance = jacobian @ self.covariance @ jacobian.T
        if other.covariance is not None:
            rotation = block_diag(self.rotation, self.rotation)
            second = rotation @ other.covariance @ rotation.T
            covariance = second if covariance is None else covariance + second
        rotation = nearest_rotation(self.rotation @ other.rotation)
        return Transform(rotation, shift + self.translation_mm, covariance)

    def difference(self, other: "Transform") -> Array:
        """Return rotation vector (left) [rad] and shift [mm] from ``other`` to this, shape (6,)."""
        angles = rotation_vector(self.rotation @ other.rotation.T)
        return np.concatenate([angles, self.translation_mm - other.translation_mm])


def finite_points(points_mm: Array, name: str) -> Array:
    """Return points as float64 of shape (N, 3).

    Args:
        points_mm: the points, shape (N, 3) [mm].
        name: what they are, for messages.

    Raises:
        InvalidParameter: the shape is another one.
        NonFiniteValue: a value is NaN or infinite.
    """
    points = np.asarray(points_mm, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InvalidParameter(f"{name} has shape {points.shape}; it must be (N, 3)")
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        bad = int(np.argmin(finite))
        raise NonFiniteValue(
            f"point {bad + 1} of {name} is {points[bad].tolist()}; it must be finite"
        )
    return points


def cross_matrix(vector: Array) -> Array:
    """Return [v]x with [v]x u = v x u, of vectors (..., 3), shape (..., 3, 3)."""
    v = np.asarray(vector, dtype=np.float64)
    matrix = np.zeros((*v.shape, 3))
    matrix[..., 2, 1], matrix[..., 1, 2] = v[..., 0], -v[..., 0]
    matrix[..., 0, 2], matrix[..., 2, 0] = v[..., 1], -v[..., 1]
    matrix[..., 1, 0], matrix[..., 0, 1] = v[..., 2], -v[..., 2]
    return matrix


def point_jacobian(turned_mm: Array) -> Array:
    """Return d x_to / d (rotation, translation) at R x_from (..., 3), shape (..., 3, 6)."""
    turned = np.asarray(turned_mm, dtype=np.float64)
    jacobian = np.empty((*turned.shape, 6))
    jacobian[..., :3] = -cross_matrix(turned)
    jacobian[..., 3:] = np.eye(3)
    return jacobian


def nearest_rotation(matrix: Array) -> Array:
    """Return the rotations nearest to matrices (..., 3, 3) (Kabsch, doi:10.1107/S0567739478001680).

    The determinant is held at +1: the best proper rotation, never a reflection.
    """
    left, _, right = np.linalg.svd(np.asarray(matrix, dtype=np.float64))
    left[..., 2] *= np.linalg.det(left @ right)[..., None]
    rotation: Array = left @ right
    return rotation
