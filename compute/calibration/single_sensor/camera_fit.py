"""Least-squares fit of many cameras to readings of the same points, and what determines them.

Readings determine a lens's distortion weakly: in a narrow field the principal distance and the
depth, the principal point and a rotation, and the terms of high order act nearly alike. So does the
offset along the slit, on which the field angle v depends. ``LensPrior`` holds what they leave open;
cameras without distortion have no prior.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.settings import WEAK_STRENGTH, depends_on_v
from compute.camera.field_distortion import FieldDistortion, Term
from compute.camera.model import PARAMETER_COUNT, SensorModel
from compute.camera.stack import CameraStack
from compute.errors import DegeneratePoints

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
OFFSET_SIGMA_V: Final = 0.1
"""Standard deviation of the field angle v (tangent) of the centroid: six degrees. Operators aim a
lens at the centre of its volume at least as well; its field is three times as wide."""
PRINCIPAL_POINT_SIGMA: Final = 0.25
"""Standard deviation of a distorting lens's principal point about the sensor's middle, relative to
its length."""
HIGHER_TERM_SCALE: Final = 0.3
"""Expected size of terms of the next two orders, and of terms that a centred lens has not got,
relative to those of the order below and to those that it has."""
START_FIELD_ANGLES_V: Final = (0.0, -0.1, 0.1)
"""Field angles v of the centroid from which the search starts."""
MIN_SINGULAR_RATIO: Final = 1e-5
"""Smallest ratio of singular values of the Jacobian with columns of length 1. The measured and
simulated frames of the thesis have 1e-4 and more; the corners of a box that a sensor sees along
its edges, 1e-5 and less even with noise."""
MIN_SINGULAR_RATIO_DISTORTED: Final = 1e-7
"""The same with distortion, whose terms are alike where the field is small; below it, normal
equations hold nothing but rounding of the least combination."""


@dataclass(frozen=True, eq=False)
class LensPrior:
    """Gaussian prior of what readings determine weakly where a lens distorts.

    Independent normal distributions: the offset along the slit, the principal point, and each
    coefficient about 0. The standard deviation of a coefficient is what makes its term
    ``strength * relative_term_scale`` of half the field at the field's edge.

    Args:
        row_behind_mm: see ``FieldDistortion``, shape (S,) [mm]; known.
        offset_mm: mean offset along the slit, shape (S,) [mm].
        offset_sigma_mm: its standard deviation, shape (S,) [mm]; infinite: no prior.
        principal_point_px: mean principal point, shape (S,) [px].
        principal_point_sigma_px: its standard deviation, shape (S,) [px].
        half_field_u: tangent of half the field of view, shape (S,).
        strength: share of half the field, shape (S,); infinite: no prior.
    """

    row_behind_mm: Array
    offset_mm: Array
    offset_sigma_mm: Array
    principal_point_px: Array
    principal_point_sigma_px: Array
    half_field_u: Array
    strength: Array

    @classmethod
    def of(
        cls,
        models: Sequence[SensorModel],
        pitch_um: Sequence[float | None],
        points_mm: Array,
        measured: NDArray[np.bool_],
        strength: float = WEAK_STRENGTH,
        stack: CameraStack | None = None,
    ) -> "LensPrior":
        """Derive the prior from cameras and the control points that they saw.

        Args:
            models: S cameras, without distortion or with that of an earlier fit.
            pitch_um: the sensors' pixel pitches [um]; None: not known.
            points_mm: control points, shape (N, 3) [mm].
            measured: which of them each sensor saw, shape (N, S).
            strength: see the class.
            stack: the same cameras as a stack; None: made here.
        """
        centre_mm = (measured.T @ points_mm) / measured.sum(axis=0)[:, None]
        if stack is None:
            stack = CameraStack.of(models)
        centre = (stack.rotation @ centre_mm[:, :, None])[..., 0]
        behind = np.array(
            [
                (0.0 if pitch is None else 1e-3 * pitch * model.principal_distance_px)
                if model.distortion is None
                else model.distortion.row_behind_mm
                for model, pitch in zip(models, pitch_um, strict=True)
            ]
        )
        pixels = np.array([model.pixels for model in models], dtype=np.float64)
        return cls(
            behind,
            -centre[:, 1],
            OFFSET_SIGMA_V * (centre[:, 2] + stack.offset_mm[:, 2] + behind),
            0.5 * (pixels - 1.0),
            PRINCIPAL_POINT_SIGMA * pixels,
            0.5 * pixels / stack.principal_distance_px,
            np.full(len(models), strength),
        )

    def rows(self, index: NDArray[np.intp]) -> "LensPrior":
        """Return the prior of the cameras with these indices."""
        return LensPrior(*(getattr(self, field.name)[index] for field in fields(self)))

    def at(self, models: Sequence[SensorModel], pitch_um: Sequence[float | None]) -> "LensPrior":
        """Return the prior with the pixel rows at the fitted principal distances.

        Args:
            models: the S fitted cameras.
            pitch_um: the sensors' pixel pitches [um]; None: not known, the row stays.
        """
        behind = self.row_behind_mm.copy()
        for row, (model, pitch) in enumerate(zip(models, pitch_um, strict=True)):
            if pitch is not None:
                behind[row] = 1e-3 * pitch * model.principal_distance_px
        return replace(self, row_behind_mm=behind)

    def scaled(self, sigma_px: Array) -> "LensPrior":
        """Return the prior in units for weights of 1, where noise is ``sigma_px`` (S,) [px]."""
        return replace(
            self,
            offset_sigma_mm=self.offset_sigma_mm / sigma_px,
            principal_point_sigma_px=self.principal_point_sigma_px / sigma_px,
            strength=self.strength / sigma_px,
        )

    def with_strength(self, strength: float | Array) -> "LensPrior":
        """Return the prior with another strength, one for all or shape (S,)."""
        return replace(self, strength=np.broadcast_to(strength, self.strength.shape).copy())

    def gaussian(self, cameras: CameraStack) -> tuple[Array, Array]:
        """Return means and information (1 / variance) by the stack's columns, both (S, width).

        Args:
            cameras: the S cameras; those without distortion have no prior, nor do parameters that
                a camera has not got.
        """
        mean = np.zeros((len(cameras), cameras.width))
        information = np.zeros_like(mean)
        if not cameras.has_distortion:
            return mean, information
        mean[:, 1], mean[:, PARAMETER_COUNT] = self.principal_point_px, self.offset_mm
        information[:, 1] = self.principal_point_sigma_px**-2.0
        information[:, PARAMETER_COUNT] = self.offset_sigma_mm**-2.0
        for column, (i, j) in enumerate(cameras.terms, start=PARAMETER_COUNT + 1):
            edge = self.half_field_u ** (i + j - 1)
            information[:, column] = (edge / (self.strength * relative_term_scale((i, j)))) ** 2
        information *= cameras.parameter_mask
        information[~cameras.parameter_mask[:, PARAMETER_COUNT]] = 0.0
        return mean, information


def relative_term_scale(term: Term) -> float:
    """Return a term's expected size at the field's edge, relative to the symmetric cubic ones.

    Args:
        term: powers (i, j).
    """
    i, j = term
    symmetric = i % 2 == 1 and j % 2 == 0
    return HIGHER_TERM_SCALE ** ((i + j - 2) // 2) * (1.0 if symmetric else HIGHER_TERM_SCALE)


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
            difference = np.zeros_like(mean)
            difference[:, 1] = cameras.principal_point_px
            difference[:, PARAMETER_COUNT] = cameras.offset_mm[:, 1]
            difference[:, PARAMETER_COUNT + 1 :] = cameras.coefficients
            difference -= mean
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


def start_with_terms(
    models: Sequence[SensorModel], terms: Sequence[tuple[Term, ...]], prior: LensPrior
) -> tuple[SensorModel, ...]:
    """Return starting cameras with distortion terms; coefficients that they have are kept.

    Args:
        models: S cameras.
        terms: the terms of each; an empty tuple: no distortion.
        prior: its mean offsets, at which cameras without distortion start.
    """
    starts = []
    for row, (model, model_terms) in enumerate(zip(models, terms, strict=True)):
        old = model.distortion
        coefficients = {} if old is None else dict(zip(old.terms, old.coefficients, strict=True))
        distortion = None
        if model_terms:
            distortion = FieldDistortion(
                model_terms,
                tuple(coefficients.get(term, 0.0) for term in model_terms),
                float(prior.offset_mm[row]) if old is None else old.offset_y_mm,
                float(prior.row_behind_mm[row]),
            )
        starts.append(replace(model, distortion=distortion))
    return tuple(starts)


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
