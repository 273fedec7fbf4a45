"""Least-squares fit of many cameras to readings of the same points (Levenberg-Marquardt)."""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.settings import depends_on_v
from compute.calibration.single_sensor.lens_prior import OFFSET_SIGMA_V, LensPrior, weak_parameters
from compute.camera.model import PARAMETER_COUNT
from compute.camera.stack import CameraStack

Array = NDArray[np.float64]

MAX_ITERATIONS: Final = 200
DECREASE_TOLERANCE: Final = 1e-9
"""Relative decrease of the mean square below which the search ends: the step is then shorter than
3e-5 standard deviations of the parameters."""
ROUNDING_TOLERANCE: Final = 2e-15
"""Rounding error of a residual, relative to the reading: smaller decreases are not resolved."""
RELATIVE_OFFSET_TOLERANCE: Final = 1e-6
"""Decrease that the undamped linear model predicts, over the mean square, below which a search has
converged though damping still shortens its steps: the minimum is less than 1e-3 standard deviations
away (relative offset criterion of Bates and Watts, doi:10.2307/1268140)."""
FINAL_OFFSET_TOLERANCE: Final = 1e-4
"""The same for each parameter when all iterations are spent: a hundredth of a standard deviation.
Where residuals times second derivatives outweigh what little the readings say of a combination of
parameters, steps shrink without end."""
FINAL_DECREASE: Final = 0.1
"""The same for all parameters together where the readings' noise is known: a third of a standard
deviation. As many readings as parameters leave valleys along which the principal distance changes
by a factor while the sum of squares falls by hundredths."""
MAX_DAMPING: Final = 1e12
START_FIELD_ANGLES_V: Final = (0.0, -0.1, 0.1)
"""Field angles v of the centroid from which the search starts."""


@dataclass(frozen=True, eq=False)
class MinimisationResult:
    """Results of B searches.

    Args:
        cameras: the B cameras at the end.
        squares: sum of squared residuals over sigma, with the prior's, shape (B,); infinite where
            the start had a point behind the lens.
        converged: whether the search converged, shape (B,).
        normal: matrices of the normal equations, with the prior's, shape (B, width, width).
    """

    cameras: CameraStack
    squares: Array
    converged: NDArray[np.bool_]
    normal: Array

    @cached_property
    def cofactors(self) -> Array:
        """Inverses of the normal equations, shape (B, width, width)."""
        diagonal = np.arange(self.normal.shape[1])
        length = np.sqrt(self.normal[:, diagonal, diagonal])
        scale = 1.0 / np.where(length > 0.0, length, 1.0)
        scale = scale[:, :, None] * scale[:, None, :]
        scaled = self.normal * scale
        # A parameter that a camera has not got.
        scaled[:, diagonal, diagonal] = 1.0
        return np.asarray(np.linalg.inv(scaled) * scale)


def minimise(
    cameras: CameraStack,
    points_mm: Array,
    readings_px: Array,
    weights: Array,
    prior: LensPrior | None = None,
    iterations: int = MAX_ITERATIONS,
    variance: float = 0.0,
) -> MinimisationResult:
    """Minimise the weighted sums of squares of B cameras by Levenberg-Marquardt.

    A step that moves an observed point behind the lens is rejected. Columns are scaled to length
    1 (More, doi:10.1007/BFb0067700); a parameter on which nothing depends keeps its value.

    Args:
        cameras: the B starting cameras.
        points_mm: control points, common to all cameras, shape (N, 3) [mm].
        readings_px: shape (N, B) [px]; any value where the weight is 0.
        weights: 1 / standard deviation, shape (N, B) [1/px]; 0: not seen.
        prior: of the lenses; None: no prior, or no distortion.
        iterations: largest number of trial steps.
        variance: of readings times weights: 1 for true weights, so that residuals that happen to
            be small do not ask for more than their noise means; 0: what the residuals tell.
    """
    count = len(cameras)
    used = weights > 0.0
    readings = np.where(used, readings_px, 0.0)
    rounding = ROUNDING_TOLERANCE * np.sqrt(((readings * weights) ** 2).sum(axis=0))
    state = cameras
    mean_and_information = None
    if prior is not None and cameras.has_distortion:
        mean_and_information = prior.gaussian(cameras)
    equations = _NormalEquations.of(state, points_mm, readings, weights, used, mean_and_information)
    damping = np.full(count, 1e-4)
    tolerance = DECREASE_TOLERANCE / np.maximum(used.sum(axis=0), 1)
    converged = np.zeros(count, dtype=np.bool_)
    index = np.flatnonzero(np.isfinite(equations.squares))
    for _ in range(iterations):
        if len(index) == 0:
            break
        every = len(index) == count  # No indexing needed.
        active = equations if every else equations.rows(index)
        active_prior = mean_and_information
        part = readings, weights, used
        if not every:
            part = readings[:, index], weights[:, index], used[:, index]
            if mean_and_information is not None:
                active_prior = mean_and_information[0][index], mean_and_information[1][index]
        step, predicted = active.steps(damping[index])
        old = active.squares.copy()
        unresolved = rounding[index] * (2.0 * np.sqrt(old) + rounding[index])
        # Converged: with little damping, the predicted decrease is negligible.
        settled = (predicted <= tolerance[index] * old + unresolved) & (damping[index] <= 1e-3)
        if settled.all():
            converged[index] = True
            break
        trial = (state if every else state.rows(index)).retract(step)
        new = _NormalEquations.of(trial, points_mm, *part, active_prior)
        better = new.squares <= old
        if every and better.all():
            equations, state = new, trial
        else:
            equations.replace_rows(index[better], new.rows(np.flatnonzero(better)))
            state = _replace_cameras(state, index[better], trial.rows(np.flatnonzero(better)))
        damping[index] = np.maximum(damping[index] * np.where(better, 0.1, 10.0), 1e-14)
        if cameras.has_distortion:
            # Curved valleys need damping to the end: what counts is the distance to the minimum.
            per_reading = np.maximum(old / np.maximum(part[2].sum(axis=0), 1), variance)
            tolerated = RELATIVE_OFFSET_TOLERANCE * per_reading
            settled |= active.undamped_decrease() <= tolerated + unresolved
        converged[index[settled]] = True
        index = index[~settled & (damping[index] < MAX_DAMPING)]
    if converged.all():
        return MinimisationResult(state, equations.squares, converged, equations.normal)
    rest = np.flatnonzero(~converged & np.isfinite(equations.squares))
    if len(rest):
        unconverged = equations.rows(rest)
        per_reading = np.maximum(
            unconverged.squares / np.maximum(used.sum(axis=0)[rest], 1), variance
        )
        tolerated = cameras.width * FINAL_OFFSET_TOLERANCE * per_reading
        tolerated = np.maximum(tolerated, FINAL_DECREASE * variance)
        tolerated += rounding[rest] * (2.0 * np.sqrt(unconverged.squares) + rounding[rest])
        converged[rest] = unconverged.undamped_decrease() <= tolerated
    return MinimisationResult(state, equations.squares, converged, equations.normal)


@dataclass(eq=False)
class _NormalEquations:
    """Normal equations of B cameras: J'J (B, W, W), J'r (B, W), r'r (B,), with the prior's."""

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
        prior: tuple[Array, Array] | None,
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
        if prior is not None:
            mean, information = prior
            difference = weak_parameters(cameras) - mean
            diagonal = np.arange(mean.shape[1])
            normal[:, diagonal, diagonal] += information
            gradient += information * difference
            squares = squares + (information * difference**2).sum(axis=1)
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

    def undamped_decrease(self) -> Array:
        """Return the decrease of r'r that the linear model predicts for full steps, (B,)."""
        return self.steps(np.full(len(self.squares), 1e-13))[1]


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


def minimise_with_distortion(
    cameras: CameraStack,
    points_mm: Array,
    readings_px: Array,
    weights: Array,
    prior: LensPrior,
    multi_start: bool = True,
) -> MinimisationResult:
    """Minimise from several offsets along the slit and keep each camera's lowest minimum.

    Args:
        cameras: B cameras at the prior's offsets.
        points_mm: shape (N, 3) [mm].
        readings_px: shape (N, B) [px].
        weights: 1 / standard deviation, shape (N, B) [1/px]; 0: not used.
        prior: of the lenses.
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
        deviation * prior.offset_sigma_mm[index] * stack.parameter_mask[:, PARAMETER_COUNT]
    )
    solution = minimise(
        stack.retract(step), points_mm, readings_px[:, index], weights[:, index], prior.rows(index)
    )
    best = np.argmin(solution.squares.reshape(starts, count), axis=0) * count + np.arange(count)
    return MinimisationResult(
        solution.cameras.rows(best),
        solution.squares[best],
        solution.converged[best],
        solution.normal[best],
    )
