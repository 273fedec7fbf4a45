"""Least-squares fit of a camera with distortion over both field angles."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from compute.camera.field_distortion import (
    Term,
    check_terms,
    distortion,
    term_derivatives,
    term_values,
)
from compute.camera.model import Vector3, vector3
from compute.errors import DegeneratePoints, NoConvergence, TooFewPoints

Array = NDArray[np.float64]

_CAMERA: Final = 7
_PENALTY_PX: Final = 1e6  # a point behind a trial camera: the search turns back
_DETERMINED: Final = 1e-11  # ratio of singular values below which a fit has no single solution
_MAX_ITERATIONS: Final = 1000
# Marquardt's damping, of unit columns: terms that all but do the same must not send the step off.
_DAMPINGS: Final = 30
_DAMPED: Final = 10.0  # by how much it grows and falls
_MIN_DAMPING: Final = 1e-8
_STEP_THRESHOLD: Final = 1e-12  # step, of the readings, at which the fit ends


@dataclass(frozen=True)
class FieldModel:
    """Camera of seven parameters with distortion, ``p = p0 + c (u + d(u, v))``.

    As ``SensorModel``, but for the offset along the slit: without distortion no reading depends
    on it; with distortion v does, so it must be known. It is not fitted.

    Args:
        principal_distance_px: c [px].
        principal_point_px: p0 [px].
        rotation_vector_rad: from the points' frame to the sensor's [rad].
        offset_mm: the origin of the points' frame in the sensor's, x, y, z [mm].
        terms: powers of the distortion's terms.
        coefficients: theirs, as many.
        row_behind_mm: how far behind the lens the row of pixels is, its glass taken as air: about
            the principal distance. It makes ``v = y / (z + row_behind)``: the light that is read
            goes to the row, not to the lens's middle.
    """

    principal_distance_px: float
    principal_point_px: float
    rotation_vector_rad: Vector3 = (0.0, 0.0, 0.0)
    offset_mm: Vector3 = (0.0, 0.0, 0.0)
    terms: tuple[Term, ...] = ()
    coefficients: tuple[float, ...] = ()
    row_behind_mm: float = 0.0

    def readings_px(self, points_mm: Array) -> Array:
        """Return the readings of points (N, 3) [mm], shape (N,) [px]; NaN behind the lens."""
        return self.linearised(points_mm)[0]

    def linearised(self, points_mm: Array) -> tuple[Array, Array]:
        """Return the readings (N,) and their derivatives by the parameters, shape (N, 7 + K).

        The order is that of ``compute.camera.model.PARAMETERS``, then the coefficients.
        """
        turned = points_mm @ Rotation.from_rotvec(self.rotation_vector_rad).as_matrix().T
        x, y, z = (turned + np.asarray(self.offset_mm)).T
        z = np.where(z > 0.0, z, np.nan)
        to_row = z + self.row_behind_mm
        u, v = x / z, y / to_row
        a = np.asarray(self.coefficients, dtype=np.float64)
        values = term_values(u, v, self.terms)
        by_u, by_v = (slopes @ a for slopes in term_derivatives(u, v, self.terms))
        distorted = u + values @ a
        c = self.principal_distance_px
        # Slopes by a shift of the point in the sensor's frame.
        by_x, by_y = c / z * (1.0 + by_u), c / to_row * by_v
        by_z = -(u * by_x + v * by_y)
        slopes = np.empty((len(points_mm), _CAMERA + len(a)))
        slopes[:, 0] = distorted
        slopes[:, 1] = 1.0
        # A left rotation w moves R X by w x R X.
        slopes[:, 2] = by_z * turned[:, 1] - by_y * turned[:, 2]
        slopes[:, 3] = by_x * turned[:, 2] - by_z * turned[:, 0]
        slopes[:, 4] = by_y * turned[:, 0] - by_x * turned[:, 1]
        slopes[:, 5], slopes[:, 6] = by_x, by_z
        slopes[:, _CAMERA:] = c * values
        return self.principal_point_px + c * distorted, slopes

    def distortion_px(self, u: Array, v: Array) -> Array:
        """Return the contribution of the distortion to readings, same shape [px].

        Args:
            u: tangents of the field angles along the pixels, any shape.
            v: tangents across the pixels, same shape.
        """
        a = np.asarray(self.coefficients, dtype=np.float64)
        return self.principal_distance_px * distortion(u, v, self.terms, a)


@dataclass(frozen=True, eq=False)
class FieldFit:
    """Fitted model and its residuals, measured minus fitted, shape (N,) [px]."""

    model: FieldModel
    residuals_px: Array

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals [px]."""
        return float(np.sqrt(np.mean(self.residuals_px**2)))

    @property
    def max_px(self) -> float:
        """Largest absolute residual [px]."""
        return float(np.abs(self.residuals_px).max())


def fit_field_model(
    points_mm: Array, readings_px: Array, start: FieldModel, terms: Sequence[Term]
) -> FieldFit:
    """Fit seven camera parameters and the coefficients of distortion terms to readings.

    By least squares, after Levenberg and Marquardt (J. J. More, Lecture Notes in Mathematics 630,
    1978, doi:10.1007/BFb0067700).

    Args:
        points_mm: control points, shape (N, 3) [mm].
        readings_px: their readings, shape (N,) [px].
        start: a camera nearby; its terms are ignored.
        terms: terms of the distortion; none for a pure camera.

    Raises:
        InvalidParameter: terms that are degenerate with the camera.
        TooFewPoints: fewer points than parameters.
        DegeneratePoints: points that leave a combination of parameters open.
        NoConvergence: the search does not end.
    """
    check_terms(terms)
    count = _CAMERA + len(terms)
    if len(points_mm) < count:
        raise TooFewPoints(
            f"{len(points_mm)} points for {count} parameters; give at least {count}",
            points=len(points_mm),
        )

    model = replace(start, terms=tuple(terms), coefficients=(0.0,) * len(terms))
    fitted, slopes = model.linearised(points_mm)
    rest = _residuals(readings_px, fitted)
    damping = 0.0
    for _ in range(_MAX_ITERATIONS):
        scale = np.linalg.norm(slopes, axis=0)
        left, singular, right = np.linalg.svd(slopes / scale, full_matrices=False)
        rank = int((singular > _DETERMINED * singular[0]).sum())
        if rank < count:
            raise DegeneratePoints(
                f"{len(points_mm)} points leave {count - rank} of {count} parameters open (ratio "
                f"of singular values {singular[-1] / singular[0]:.1e}); add points, at other "
                "distances too, or take fewer terms",
                points=len(points_mm),
            )
        explained = left.T @ rest
        if float(np.linalg.norm(explained)) <= _STEP_THRESHOLD * float(np.linalg.norm(readings_px)):
            return FieldFit(model, rest)
        for _ in range(_DAMPINGS):
            step = right.T @ (singular / (singular**2 + damping) * explained)
            trial = _apply_step(model, step / scale)
            fitted, trial_slopes = trial.linearised(points_mm)
            trial_rest = _residuals(readings_px, fitted)
            if (trial_rest**2).sum() < (rest**2).sum():
                break
            damping = max(_DAMPED * damping, _MIN_DAMPING)
        else:
            return FieldFit(model, rest)  # only rounding is left to gain
        damping = damping / _DAMPED if damping > _MIN_DAMPING else 0.0
        model, slopes, rest = trial, trial_slopes, trial_rest
    raise NoConvergence(
        f"the fit of {count} parameters did not settle in {_MAX_ITERATIONS} turns; start it nearer"
    )


def _residuals(readings_px: Array, fitted_px: Array) -> Array:
    return np.where(np.isnan(fitted_px), _PENALTY_PX, readings_px - fitted_px)


def _apply_step(model: FieldModel, step: Array) -> FieldModel:
    """Return the model after a step of its parameters, in the order of ``linearised``."""
    turn = Rotation.from_rotvec(step[2:5]) * Rotation.from_rotvec(model.rotation_vector_rad)
    x, y, z = model.offset_mm
    coefficients = np.asarray(model.coefficients, dtype=np.float64) + step[_CAMERA:]
    return replace(
        model,
        principal_distance_px=model.principal_distance_px + float(step[0]),
        principal_point_px=model.principal_point_px + float(step[1]),
        rotation_vector_rad=vector3(turn.as_rotvec()),
        offset_mm=(x + float(step[5]), y, z + float(step[6])),
        coefficients=tuple(coefficients.tolist()),
    )
