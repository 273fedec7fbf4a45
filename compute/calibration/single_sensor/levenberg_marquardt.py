"""Levenberg-Marquardt for many cameras at once, each fitted to readings of the same points."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack

Array = NDArray[np.float64]

OFFSET_Y_INDEX: Final = 7
"""Column of the offset along the slit."""
MAX_ITERATIONS: Final = 200
DECREASE_TOLERANCE: Final = 1e-9
"""Decrease, of the mean square, that is not worth a step: its length is less than 3e-5 standard
deviations, as the residuals show them."""
ROUNDING_TOLERANCE: Final = 2e-15
"""Rounding of a residual, of the readings: what the sum of squares hides by it is no decrease."""
MAX_DAMPING: Final = 1e12


@dataclass(frozen=True, eq=False)
class OffsetPrior:
    """What is known of the offsets along the slits beforehand.

    Args:
        mean_mm: shape (B,) [mm].
        sigma_mm: standard deviation, shape (B,) [mm]; infinite where nothing is known.
    """

    mean_mm: Array
    sigma_mm: Array

    def rows(self, index: NDArray[np.intp]) -> "OffsetPrior":
        """Return it for some of the cameras."""
        return OffsetPrior(self.mean_mm[index], self.sigma_mm[index])


@dataclass(frozen=True, eq=False)
class MinimisationResult:
    """Where B searches ended.

    Args:
        cameras: B cameras.
        squares: sum of squared residuals over sigma, with the prior's, shape (B,); infinite where
            the start had a point behind the lens.
        converged: whether the search came to rest, shape (B,).
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
    """Minimise the weighted squares of B cameras from where they are.

    A step that takes a point that was read behind the lens is no step. Columns are scaled to
    length 1 (More, doi:10.1007/BFb0067700); a parameter on which nothing depends stays.

    Args:
        cameras: B starts.
        points_mm: control points, shape (N, 3), of all of them.
        readings_px: shape (N, B) [px]; anything where the weight is 0.
        weights: 1 / standard deviation, shape (N, B) [1/px]; 0: not seen.
        prior: of the offsets along the slits; None: none, or no distortion.
        iterations: steps that are tried at most.
    """
    count = len(cameras)
    used = weights > 0.0
    readings = np.where(used, readings_px, 0.0)
    rounding = ROUNDING_TOLERANCE * np.sqrt(((readings * weights) ** 2).sum(axis=0))
    state = cameras
    equations = _NormalEquations.of(state, points_mm, readings, weights, used, prior)
    damping = np.full(count, 1e-4)
    worth = DECREASE_TOLERANCE / np.maximum(used.sum(axis=0), 1)
    converged = np.zeros(count, dtype=np.bool_)
    index = np.flatnonzero(np.isfinite(equations.squares))
    for _ in range(iterations):
        if len(index) == 0:
            break
        every = len(index) == count  # Then there is nothing to pick.
        going = equations if every else equations.rows(index)
        step, promised = going.steps(damping[index])
        trial = (state if every else state.rows(index)).retract(step)
        if every:
            new = _NormalEquations.of(trial, points_mm, readings, weights, used, prior)
        else:
            here = prior.rows(index) if prior is not None else None
            part = readings[:, index], weights[:, index], used[:, index]
            new = _NormalEquations.of(trial, points_mm, *part, here)
        old = going.squares.copy()
        better = new.squares <= old
        if every and better.all():
            equations, state = new, trial
        else:
            equations.replace_rows(index[better], new.rows(np.flatnonzero(better)))
            state = _replace_cameras(state, index[better], trial.rows(np.flatnonzero(better)))
        # Under little damping a step that promises nothing has arrived, better or not.
        hidden = rounding[index] * (2.0 * np.sqrt(old) + rounding[index])
        done = (promised <= worth[index] * old + hidden) & (damping[index] <= 1e-3)
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
            known = cameras.parameter_mask[:, OFFSET_Y_INDEX] / prior.sigma_mm
            away = (cameras.offset_mm[:, 1] - prior.mean_mm) * known
            normal[:, OFFSET_Y_INDEX, OFFSET_Y_INDEX] += known**2
            gradient[:, OFFSET_Y_INDEX] += away * known
            squares = squares + away**2
        squares[behind] = np.inf
        return cls(normal, gradient, squares)

    def rows(self, index: NDArray[np.intp]) -> "_NormalEquations":
        return _NormalEquations(self.normal[index], self.gradient[index], self.squares[index])

    def replace_rows(self, index: NDArray[np.intp], other: "_NormalEquations") -> None:
        self.normal[index] = other.normal
        self.gradient[index] = other.gradient
        self.squares[index] = other.squares

    def steps(self, damping: Array) -> tuple[Array, Array]:
        """Return damped steps (B, W) and the decrease that the linear model promises (B,)."""
        width = self.normal.shape[1]
        diagonal = np.arange(width)
        length = np.sqrt(self.normal[:, diagonal, diagonal])
        scale = 1.0 / np.where(length > 0.0, length, 1.0)
        scaled = self.normal * scale[:, :, None] * scale[:, None, :]
        scaled[:, diagonal, diagonal] = 1.0 + damping[:, None] + 1e-15
        right = -self.gradient * scale
        step = np.linalg.solve(scaled, right[..., None])[..., 0]
        # r'r - |r + J s|^2 = s'(A + D) s + s' D s - ... with (A + D) s = b: s'b + d s's.
        promised = (step * right).sum(axis=1) + damping * (step**2).sum(axis=1)
        return step * scale, promised


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
