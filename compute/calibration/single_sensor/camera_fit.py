"""Least-squares fit of many cameras to readings of the same points, by Levenberg-Marquardt.

The lens offset along the slit, on which the field angle v depends, is fitted where a distortion
term contains v. The readings determine it weakly: it shifts v in proportion to depth, and nearly
all of that acts like tilt and the lower terms. A prior therefore holds it: the lens sees the
control points' centroid at v = 0 +- OFFSET_SIGMA_V. Without terms in v, the offset and its variance
are those of the prior.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.single_sensor.distortion_terms import depends_on_v
from compute.camera.field_distortion import FieldDistortion, Term
from compute.camera.model import PARAMETER_COUNT, SensorModel
from compute.camera.stack import CameraStack

Array = NDArray[np.float64]

OFFSET_Y_INDEX: Final = 7
"""Parameter index of the lens offset along the slit."""
MAX_ITERATIONS: Final = 200
DECREASE_TOLERANCE: Final = 1e-9
"""Relative decrease of the mean square below which the search ends: the step is then shorter than
3e-5 standard deviations of the parameters."""
ROUNDING_TOLERANCE: Final = 2e-15
"""Rounding error of a residual, relative to the reading: smaller decreases are not resolved."""
MAX_DAMPING: Final = 1e12
OFFSET_SIGMA_V: Final = 0.1
"""Standard deviation of the field angle v (tangent) of the centroid: six degrees. Operators aim a
lens at the centre of its volume at least as well; its field is three times as wide."""
START_FIELD_ANGLES_V: Final = (0.0, -0.1, 0.1)
"""Field angles v of the centroid from which the search starts."""


@dataclass(frozen=True, eq=False)
class OffsetPrior:
    """Gaussian prior of the lens offsets along the slits.

    Args:
        mean_mm: means, shape (B,) [mm].
        sigma_mm: standard deviations, shape (B,) [mm]; infinite: no prior.
    """

    mean_mm: Array
    sigma_mm: Array

    def rows(self, index: NDArray[np.intp]) -> "OffsetPrior":
        """Return the prior of the cameras with these indices."""
        return OffsetPrior(self.mean_mm[index], self.sigma_mm[index])


@dataclass(frozen=True, eq=False)
class MinimisationResult:
    """Results of B searches.

    Args:
        cameras: the B cameras at the end.
        squares: sum of squared residuals over sigma, with the prior's, shape (B,); infinite where
            the start had a point behind the lens.
        converged: whether the search converged, shape (B,).
    """

    cameras: CameraStack
    squares: Array
    converged: NDArray[np.bool_]


def minimise(
    cameras: CameraStack,
    points_mm: Array,
    readings_px: Array,
    weights: Array,
    prior: OffsetPrior | None = None,
    iterations: int = MAX_ITERATIONS,
) -> MinimisationResult:
    """Minimise the weighted sums of squares of B cameras by Levenberg-Marquardt.

    A step that moves an observed point behind the lens is rejected. Columns are scaled to length
    1 (More, doi:10.1007/BFb0067700); a parameter on which nothing depends keeps its value.

    Args:
        cameras: the B starting cameras.
        points_mm: control points, common to all cameras, shape (N, 3) [mm].
        readings_px: shape (N, B) [px]; any value where the weight is 0.
        weights: 1 / standard deviation, shape (N, B) [1/px]; 0: not seen.
        prior: of the lens offsets; None: no prior, or no distortion.
        iterations: largest number of trial steps.
    """
    count = len(cameras)
    used = weights > 0.0
    readings = np.where(used, readings_px, 0.0)
    rounding = ROUNDING_TOLERANCE * np.sqrt(((readings * weights) ** 2).sum(axis=0))
    state = cameras
    equations = _NormalEquations.of(state, points_mm, readings, weights, used, prior)
    damping = np.full(count, 1e-4)
    tolerance = DECREASE_TOLERANCE / np.maximum(used.sum(axis=0), 1)
    converged = np.zeros(count, dtype=np.bool_)
    index = np.flatnonzero(np.isfinite(equations.squares))
    for _ in range(iterations):
        if len(index) == 0:
            break
        every = len(index) == count  # No indexing needed.
        active = equations if every else equations.rows(index)
        step, predicted = active.steps(damping[index])
        trial = (state if every else state.rows(index)).retract(step)
        if every:
            new = _NormalEquations.of(trial, points_mm, readings, weights, used, prior)
        else:
            active_prior = prior.rows(index) if prior is not None else None
            part = readings[:, index], weights[:, index], used[:, index]
            new = _NormalEquations.of(trial, points_mm, *part, active_prior)
        old = active.squares.copy()
        better = new.squares <= old
        if every and better.all():
            equations, state = new, trial
        else:
            equations.replace_rows(index[better], new.rows(np.flatnonzero(better)))
            state = _replace_cameras(state, index[better], trial.rows(np.flatnonzero(better)))
        # Converged: with little damping, the predicted decrease is negligible.
        unresolved = rounding[index] * (2.0 * np.sqrt(old) + rounding[index])
        done = (predicted <= tolerance[index] * old + unresolved) & (damping[index] <= 1e-3)
        damping[index] = np.maximum(damping[index] * np.where(better, 0.1, 10.0), 1e-14)
        converged[index[done]] = True
        index = index[~done & (damping[index] < MAX_DAMPING)]
    return MinimisationResult(state, equations.squares, converged)


@dataclass(eq=False)
class _NormalEquations:
    """Normal equations of B cameras: J'J (B, W, W), J'r (B, W), r'r (B,)."""

    normal: Array
    gradient: Array
    squares: Array

    @classmethod
    def of(
        cls,
        cameras: CameraStack,
        points_mm: Array,
        readings_px: Array,
        weights: Array,
        used: NDArray[np.bool_],
        prior: OffsetPrior | None,
    ) -> "_NormalEquations":
        fitted, jacobian = cameras.project_with_parameter_jacobian(points_mm)
        missing = np.isnan(fitted)
        behind = (missing & used).any(axis=0) | (cameras.principal_distance_px <= 0.0)
        if missing.any():
            fitted = np.where(missing, 0.0, fitted)
            jacobian = np.where(missing[..., None], 0.0, jacobian)
        design = (jacobian * weights[..., None]).swapaxes(0, 1)
        residuals = ((fitted - readings_px) * weights).T
        transposed = design.swapaxes(1, 2)
        normal = transposed @ design
        gradient = (transposed @ residuals[..., None])[..., 0]
        squares = (residuals**2).sum(axis=1)
        if prior is not None and cameras.has_distortion:
            prior_weight = cameras.parameter_mask[:, OFFSET_Y_INDEX] / prior.sigma_mm
            prior_residual = (cameras.offset_mm[:, 1] - prior.mean_mm) * prior_weight
            normal[:, OFFSET_Y_INDEX, OFFSET_Y_INDEX] += prior_weight**2
            gradient[:, OFFSET_Y_INDEX] += prior_residual * prior_weight
            squares = squares + prior_residual**2
        squares[behind] = np.inf
        return cls(normal, gradient, squares)

    def rows(self, index: NDArray[np.intp]) -> "_NormalEquations":
        return _NormalEquations(self.normal[index], self.gradient[index], self.squares[index])

    def replace_rows(self, index: NDArray[np.intp], other: "_NormalEquations") -> None:
        self.normal[index] = other.normal
        self.gradient[index] = other.gradient
        self.squares[index] = other.squares

    def steps(self, damping: Array) -> tuple[Array, Array]:
        """Return damped steps (B, W) and the decrease that the linear model predicts (B,)."""
        width = self.normal.shape[1]
        diagonal = np.arange(width)
        length = np.sqrt(self.normal[:, diagonal, diagonal])
        scale = 1.0 / np.where(length > 0.0, length, 1.0)
        scaled = self.normal * scale[:, :, None] * scale[:, None, :]
        scaled[:, diagonal, diagonal] = 1.0 + damping[:, None] + 1e-15
        right = -self.gradient * scale
        step = np.linalg.solve(scaled, right[..., None])[..., 0]
        # r'r - |r + J s|^2 = s'(A + D) s + s' D s - ... with (A + D) s = b: s'b + d s's.
        predicted = (step * right).sum(axis=1) + damping * (step**2).sum(axis=1)
        return step * scale, predicted


def _replace_cameras(
    state: CameraStack, index: NDArray[np.intp], other: CameraStack
) -> CameraStack:
    """Return the cameras with some replaced."""
    if len(index) == len(state):
        return other
    result = state.rows(np.arange(len(state)))
    for values, new in (
        (result.principal_distance_px, other.principal_distance_px),
        (result.principal_point_px, other.principal_point_px),
        (result.rotation, other.rotation),
        (result.offset_mm, other.offset_mm),
        (result.coefficients, other.coefficients),
    ):
        values[index] = new
    return result


@dataclass(frozen=True, eq=False)
class LensOffsets:
    """Positions of the lenses along their slits, which the readings determine weakly.

    Args:
        row_behind_mm: see ``FieldDistortion``, shape (S,) [mm].
        prior: of the offsets along the slits.
    """

    row_behind_mm: Array
    prior: OffsetPrior

    @classmethod
    def of(
        cls,
        models: Sequence[SensorModel],
        pitch_um: Sequence[float | None],
        points_mm: Array,
        seen: NDArray[np.bool_],
    ) -> "LensOffsets":
        """Derive the prior from cameras and the control points that they saw.

        Args:
            models: S cameras, without distortion or with that of an earlier fit.
            pitch_um: the sensors' pixel pitches [um]; None: not known.
            points_mm: control points, shape (N, 3) [mm].
            seen: which of them each sensor saw, shape (N, S).
        """
        centre_mm = (seen.T @ points_mm) / seen.sum(axis=0)[:, None]
        behind, mean, sigma = [], [], []
        for model, pitch, centre in zip(models, pitch_um, centre_mm, strict=True):
            _, y, z = (model.rotation @ centre).tolist()
            distortion = model.distortion
            if distortion is not None:
                behind.append(distortion.row_behind_mm)
            else:
                behind.append(0.0 if pitch is None else 1e-3 * pitch * model.principal_distance_px)
            mean.append(-y)
            sigma.append(OFFSET_SIGMA_V * (z + model.offset_z_mm + behind[-1]))
        return cls(np.array(behind), OffsetPrior(np.array(mean), np.array(sigma)))

    def at(self, models: Sequence[SensorModel], pitch_um: Sequence[float | None]) -> "LensOffsets":
        """Return the offsets with the pixel rows at the fitted principal distances.

        Args:
            models: the S fitted cameras.
            pitch_um: the sensors' pixel pitches [um]; None: not known, the row stays.
        """
        behind = self.row_behind_mm.copy()
        for row, (model, pitch) in enumerate(zip(models, pitch_um, strict=True)):
            if pitch is not None:
                behind[row] = 1e-3 * pitch * model.principal_distance_px
        return replace(self, row_behind_mm=behind)

    def scaled(self, sigma_px: Array) -> "LensOffsets":
        """Return the prior in units for weights of 1, where noise is ``sigma_px`` (S,) [px]."""
        return replace(self, prior=replace(self.prior, sigma_mm=self.prior.sigma_mm / sigma_px))


def start_with_terms(
    models: Sequence[SensorModel], terms: Sequence[tuple[Term, ...]], lens_offsets: LensOffsets
) -> tuple[SensorModel, ...]:
    """Return starting cameras with distortion terms; coefficients that they have are kept.

    Args:
        models: S cameras.
        terms: the terms of each; an empty tuple: no distortion.
        lens_offsets: the offsets at which cameras without distortion start.
    """
    starts = []
    for row, (model, own_terms) in enumerate(zip(models, terms, strict=True)):
        old = model.distortion
        known = {} if old is None else dict(zip(old.terms, old.coefficients, strict=True))
        distortion = None
        if own_terms:
            distortion = FieldDistortion(
                own_terms,
                tuple(known.get(term, 0.0) for term in own_terms),
                float(lens_offsets.prior.mean_mm[row]) if old is None else old.offset_y_mm,
                float(lens_offsets.row_behind_mm[row]),
            )
        starts.append(replace(model, distortion=distortion))
    return tuple(starts)


def minimise_with_distortion(
    cameras: CameraStack,
    points_mm: Array,
    readings_px: Array,
    weights: Array,
    prior: OffsetPrior,
    multi_start: bool = True,
) -> MinimisationResult:
    """Minimise from several offsets along the slit and keep each camera's lowest minimum.

    Args:
        cameras: B cameras at the prior's offsets.
        points_mm: shape (N, 3) [mm].
        readings_px: shape (N, B) [px].
        weights: 1 / standard deviation, shape (N, B) [1/px]; 0: not used.
        prior: of the lens offsets.
        multi_start: False: start from the cameras only, which are close to their minima.
    """
    if not multi_start or not depends_on_v(cameras.terms):
        return minimise(cameras, points_mm, readings_px, weights, prior)
    count, starts = len(cameras), len(START_FIELD_ANGLES_V)
    index = np.tile(np.arange(count), starts)
    stack = cameras.rows(index)
    step = np.zeros((len(index), cameras.width))
    deviation = np.repeat(np.array(START_FIELD_ANGLES_V) / OFFSET_SIGMA_V, count)
    step[:, PARAMETER_COUNT] = (
        deviation * prior.sigma_mm[index] * stack.parameter_mask[:, PARAMETER_COUNT]
    )
    ended = minimise(
        stack.retract(step), points_mm, readings_px[:, index], weights[:, index], prior.rows(index)
    )
    best = np.argmin(ended.squares.reshape(starts, count), axis=0) * count + np.arange(count)
    return MinimisationResult(ended.cameras.rows(best), ended.squares[best], ended.converged[best])
