"""PoseSet: one target shape at B unknown poses, with the readings of its markers."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from compute.calibration.bundle_adjustment.target_shape import TargetShape, point_shape
from compute.errors import InvalidParameter

Array = NDArray[np.float64]

_AXES = np.eye(3)


@dataclass(frozen=True, eq=False)
class PoseSet:
    """A target at B poses; a pose's unknowns are its rotations, then its translation.

    Rotations are about the body's own axes (``R <- R exp([w]x)``), those of
    ``shape.rotation_axes``: none for a point, two for markers on a line, three for a body.

    Args:
        shape: K markers.
        translation_mm: of the body's origin in the world, shape (B, 3) [mm].
        rotation: R_world_body, shape (B, 3, 3).
        readings_px: shape (B, K, S) [px]; NaN where a sensor did not see the marker.
        sigma_px: their standard deviations, shape (B, K, S) [px].
        known_mm: given positions of the body's origin, shape (B, 3) [mm]; None: unknown.
        known_covariance_mm2: their covariance, shape (B, 3, 3) [mm^2], positive definite.
    """

    shape: TargetShape
    translation_mm: Array
    rotation: Array
    readings_px: Array
    sigma_px: Array
    known_mm: Array | None = None
    known_covariance_mm2: Array | None = None
    _information: Array | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        poses, markers = len(self.translation_mm), len(self.shape)
        expected_shapes = {
            "translation_mm": (poses, 3),
            "rotation": (poses, 3, 3),
            "readings_px": (poses, markers, self.readings_px.shape[-1]),
            "sigma_px": self.readings_px.shape,
        }
        if (self.known_mm is None) != (self.known_covariance_mm2 is None):
            raise InvalidParameter("known_mm and known_covariance_mm2 go together; give both")
        if self.known_mm is not None:
            expected_shapes |= {"known_mm": (poses, 3), "known_covariance_mm2": (poses, 3, 3)}
        for name, shape in expected_shapes.items():
            if getattr(self, name).shape != shape:
                raise InvalidParameter(
                    f"{name} has shape {getattr(self, name).shape}; it must be {shape}"
                )
        measured = np.isfinite(self.readings_px)
        if (
            not (self.sigma_px[measured] > 0.0).all()
            or not np.isfinite(self.sigma_px[measured]).all()
        ):
            raise InvalidParameter("standard deviations of readings must be positive and finite")
        if self.known_covariance_mm2 is not None and self._information is None:
            try:
                np.linalg.cholesky(self.known_covariance_mm2)
            except np.linalg.LinAlgError:
                raise InvalidParameter(
                    "the covariance of a known position is not positive definite"
                ) from None
            object.__setattr__(self, "_information", np.linalg.inv(self.known_covariance_mm2))

    @classmethod
    def points(
        cls,
        position_mm: Array,
        readings_px: Array,
        sigma_px: Array,
        known_mm: Array | None = None,
        known_covariance_mm2: Array | None = None,
    ) -> "PoseSet":
        """Return B single points, free or, with ``known_mm``, control points with uncertainty.

        Args:
            position_mm: where to start, shape (B, 3) [mm].
            readings_px: shape (B, S) [px].
            sigma_px: shape (B, S) [px].
            known_mm: given positions, shape (B, 3) [mm].
            known_covariance_mm2: their covariance, shape (B, 3, 3) [mm^2].
        """
        position = np.asarray(position_mm, dtype=np.float64)
        return cls(
            point_shape(),
            position,
            np.broadcast_to(np.eye(3), (len(position), 3, 3)),
            readings_px[:, None],
            sigma_px[:, None],
            known_mm,
            known_covariance_mm2,
        )

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.translation_mm)

    @property
    def unknowns(self) -> int:
        """Number of unknowns of a pose: 3, 5 or 6."""
        return 3 + len(self.shape.rotation_axes)

    @property
    def observed_mask(self) -> NDArray[np.bool_]:
        """Mask of the readings that were measured, shape (B, K, S)."""
        return np.isfinite(self.readings_px)

    def marker_positions(self) -> Array:
        """Return the markers in the world, shape (B, K, 3) [mm]."""
        rotated: Array = np.einsum("bij,kj->bki", self.rotation, self.shape.marker_mm)
        return rotated + self.translation_mm[:, None]

    def marker_jacobian(self) -> Array:
        """Return d marker / d (rotations, translation), shape (B, K, 3, unknowns)."""
        rotation_axes = list(self.shape.rotation_axes)
        jacobian = np.zeros((len(self), len(self.shape), 3, self.unknowns))
        if rotation_axes:
            # R exp([w]x) q moves by R (w x q).
            swept = np.cross(_AXES[rotation_axes][:, None], self.shape.marker_mm)
            jacobian[..., : len(rotation_axes)] = np.einsum("bij,wkj->bkiw", self.rotation, swept)
        jacobian[..., len(rotation_axes) :] = _AXES
        return jacobian

    def select(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> "PoseSet":
        """Return some of the poses, by a mask (B,) or indices; without known positions."""
        return PoseSet(
            self.shape,
            self.translation_mm[which],
            self.rotation[which],
            self.readings_px[which],
            self.sigma_px[which],
        )

    def retract(self, step: Array) -> "PoseSet":
        """Return the poses after steps (B, unknowns)."""
        rotation_axes = list(self.shape.rotation_axes)
        rotation = self.rotation
        if rotation_axes:
            vector = np.zeros((len(self), 3))
            vector[:, rotation_axes] = step[:, : len(rotation_axes)]
            rotation = rotation @ Rotation.from_rotvec(vector).as_matrix()
        translation = self.translation_mm + step[:, len(rotation_axes) :]
        return replace(self, translation_mm=translation, rotation=rotation)

    def transformed(self, rotation: Array, translation_mm: Array) -> "PoseSet":
        """Return the poses after a motion of the world, ``X <- rotation X + translation_mm``.

        Args:
            rotation: shape (3, 3).
            translation_mm: shape (3,) [mm].

        Raises:
            InvalidParameter: known positions fix the world frame.
        """
        if self.known_mm is not None:
            raise InvalidParameter("poses with known positions cannot be moved to another frame")
        return replace(
            self,
            translation_mm=self.translation_mm @ rotation.T + translation_mm,
            rotation=rotation @ self.rotation,
        )

    def prior(self) -> tuple[Array, Array] | None:
        """Return differences to the known positions (B, 3) and their information (B, 3, 3)."""
        if self.known_mm is None or self._information is None:
            return None
        return self.translation_mm - self.known_mm, self._information
