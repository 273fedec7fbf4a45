"""Fit of all sensors to exact control points: metric, with distortion, least squares or robust."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.settings import Loss, free_parameters
from compute.calibration.single_sensor.camera_fit import (
    EquationGroup,
    LensPrior,
    MinimisationResult,
    check_determined,
    equation_groups,
    minimise,
    minimise_with_distortion,
    start_with_terms,
)
from compute.calibration.single_sensor.projective_camera import (
    ProjectiveCamera,
    metric_cameras,
    metric_models,
    normalisation,
    projective_matrices,
    search_starts,
)
from compute.calibration.single_sensor.trimmed_least_squares import robust_starts
from compute.camera.field_distortion import Term
from compute.camera.model import PARAMETER_COUNT, SensorGeometry, SensorModel
from compute.camera.observation_checks import MAX_RESIDUAL_SHARE, check_explained
from compute.camera.stack import CameraStack
from compute.errors import DegeneratePoints, NoConvergence, TooFewPoints
from compute.robust_statistics import biweight, mad_sigma

Array = NDArray[np.float64]

SIGMA_FLOOR_PX: Final = 1e-6
"""Smallest standard deviation estimated from residuals: exact data still leave rounding."""
INITIAL_SIGMA_PX: Final = 0.05
"""Standard deviation of readings that weighs the offsets' prior until residuals give one."""
CONTRADICTED_SIGMA_FACTOR: Final = 3.0
"""Residuals over the given standard deviations above which these do not explain them."""
MAX_MAJORITY_SHARE: Final = 0.05
"""Noise of the readings that a robust camera fits, relative to the standard deviation of all, below
which the others are wrong, and not all unrelated."""
MAX_WRONG_SHARE: Final = 0.25
WRONG_READING_SIGMA: Final = 10.0
MAX_REWEIGHTINGS: Final = 60
WEIGHT_TOLERANCE: Final = 1e-6
SETTLED_WEIGHTS: Final = 1e-3
MIN_REDUNDANCY: Final = 0.01
"""Smallest share of a reading's variance that is taken to be left in its residual."""
STEPS_PER_REWEIGHTING: Final = 4
MAX_BLOCKS: Final = 16
MIN_BLOCKS: Final = 5
POINTS_PER_BLOCK: Final = 3


@dataclass(frozen=True, eq=False)
class ControlObservations:
    """Checked control points and their readings.

    Args:
        points_mm: shape (N, 3).
        readings_px: shape (N, S); NaN where not seen.
        sigma_px: standard deviations of the readings, shape (N, S); ones where not known.
        sigma_known: whether they are known.
        sensors: the S sensors.
    """

    points_mm: Array
    readings_px: Array
    sigma_px: Array
    sigma_known: bool
    sensors: tuple[SensorGeometry, ...]

    @classmethod
    def of(
        cls,
        points_mm: Array,
        readings_px: Array,
        sensors: Sequence[SensorGeometry],
        sigma_px: Array | None,
    ) -> "ControlObservations":
        """Return observations whose standard deviations may be unknown.

        Args:
            points_mm: shape (N, 3) [mm].
            readings_px: shape (N, S) [px]; NaN where not seen.
            sensors: the S sensors.
            sigma_px: standard deviations of the readings, shape (N, S) [px]; None: not known.
        """
        sigma = 1.0 if sigma_px is None else np.where(np.isfinite(readings_px), sigma_px, 1.0)
        wide = np.broadcast_to(sigma, readings_px.shape)
        return cls(points_mm, readings_px, wide, sigma_px is not None, tuple(sensors))

    def with_point_sigma(
        self, models: Sequence[SensorModel], position_sigma_mm: float
    ) -> "ControlObservations":
        """Add the control points' uncertainty to the readings' standard deviations.

        Args:
            models: the S cameras.
            position_sigma_mm: standard deviation of each coordinate [mm].
        """
        point_sigma = projected_point_sigma(models, self.points_mm, position_sigma_mm)
        return replace(self, sigma_px=np.hypot(self.sigma_px, np.nan_to_num(point_sigma)))

    def residuals_px(self, models: Sequence[SensorModel] | CameraStack) -> Array:
        """Return readings of S cameras minus measured ones, shape (N, S) [px]."""
        stack = models if isinstance(models, CameraStack) else CameraStack.of(models)
        return stack.project(self.points_mm) - self.readings_px

    @property
    def observed_mask(self) -> NDArray[np.bool_]:
        """Mask of the readings that were measured, shape (N, S)."""
        return np.isfinite(self.readings_px)

    @property
    def weights(self) -> Array:
        """1 / standard deviation, 0 where not seen, shape (N, S)."""
        return np.where(self.observed_mask, 1.0 / self.sigma_px, 0.0)

    @property
    def pitch_um(self) -> list[float | None]:
        """The sensors' pixel pitches [um]."""
        return [sensor.pitch_um for sensor in self.sensors]


@dataclass(frozen=True, eq=False)
class SensorFits:
    """Fitted cameras.

    Args:
        models: the S cameras.
        weights: of the readings by a robust loss, shape (N, S); ones with a linear loss.
        prior: of the lenses; without effect on cameras without distortion.
        unit_px: the noise that a weight of 1 stands for, where the readings' standard deviations
            are not known, shape (S,) [px]; None: 1.
        groups: the equations of the readings that count, where they were made; None: not yet.
        stack: the cameras as a stack, likewise.
    """

    models: tuple[SensorModel, ...]
    weights: Array
    prior: LensPrior
    unit_px: Array | None = None
    groups: list[EquationGroup] | None = None
    stack: CameraStack | None = None

    @property
    def scaled_prior(self) -> LensPrior:
        """The prior in the units of the readings' weights."""
        return self.prior if self.unit_px is None else self.prior.scaled(self.unit_px)

    def used(self, observed: ControlObservations) -> NDArray[np.bool_]:
        """Return which readings count, shape (N, S)."""
        return observed.observed_mask & (self.weights > 0.0)

    def known_weights(self, observed: ControlObservations) -> Array:
        """Return 1 / standard deviation of the readings that count, 0 of others, (N, S) [1/px]."""
        return np.where(self.weights > 0.0, observed.weights, 0.0)

    def equation_groups(self, observed: ControlObservations) -> list[EquationGroup]:
        """Return the equations of the readings that count."""
        if self.groups is not None:
            return self.groups
        weights = self.known_weights(observed)
        return equation_groups(self.models, observed.points_mm, weights, self.scaled_prior)

    def fit_without(
        self, observed: ControlObservations, subsets: NDArray[np.bool_]
    ) -> MinimisationResult:
        """Refit all cameras to parts of the points, starting from these.

        Args:
            observed: control points and readings.
            subsets: points of each part, shape (G, N).

        Returns:
            G S cameras, the first part's first.
        """
        sensors = len(self.models)
        index = np.tile(np.arange(sensors), len(subsets))
        weights = (observed.weights * np.sqrt(self.weights))[:, index]
        return minimise_with_distortion(
            CameraStack.of(self.models).rows(index),
            observed.points_mm,
            observed.readings_px[:, index],
            weights * np.repeat(subsets, sensors, axis=0).T,
            self.scaled_prior.rows(index),
            multi_start=False,
        )


def fit_undistorted(
    observed: ControlObservations, loss: Loss, initial_models: Sequence[SensorModel] | None = None
) -> SensorFits:
    """Fit the seven metric parameters of each sensor.

    Args:
        observed: control points and readings.
        loss: "linear" or "robust".
        initial_models: cameras from which the search starts too; used with a linear loss only.

    Raises:
        ImplausibleReadings, DegeneratePoints, NoConvergence: see ``fit_metric_cameras``.
    """
    if loss == "linear":
        models, groups, stack = fit_metric_cameras(
            observed.points_mm,
            observed.readings_px,
            observed.sigma_px,
            observed.sensors,
            initial_models,
            observed.sigma_known,
        )
        weights = np.ones(observed.readings_px.shape)
    else:
        models, weights = _reweight(observed, _robust_start(observed))
        # What a robust loss leaves out does not count: the median of the residuals.
        squares = (
            mad_sigma(observed.residuals_px(models), observed.observed_mask, PARAMETER_COUNT) ** 2
        )
        squares *= np.maximum(observed.observed_mask.sum(axis=0) - PARAMETER_COUNT, 0)
        unit = observed.observed_mask.astype(np.float64)
        shares, _ = _residual_shares(squares, observed.points_mm, observed.readings_px, unit)
        check_explained(shares, observed.readings_px, observed.sensors)
        used = np.where(weights > 0.0, observed.weights, 0.0)
        stack = CameraStack.of(models)
        groups = check_determined(models, observed.points_mm, used, stack=stack)
    prior = LensPrior.of(
        models, observed.pitch_um, observed.points_mm, observed.observed_mask, stack=stack
    )
    return SensorFits(models, weights, prior, groups=groups, stack=stack)


def fit_metric_cameras(
    points_mm: Array,
    readings_px: Array,
    sigma_px: Array,
    sensors: Sequence[SensorGeometry],
    initial_models: Sequence[SensorModel] | None = None,
    sigma_known: bool = False,
) -> tuple[tuple[SensorModel, ...], list[EquationGroup], CameraStack]:
    """Minimise each sensor's squared normalised residuals from several starts; keep the lowest.

    All starts of all sensors are searched at once in the projective form, whose numerator is
    linear; the best of each is refined in the metric form.

    Args:
        points_mm: control points, shape (N, 3).
        readings_px: readings, shape (N, S) [px]; NaN where a sensor did not see the point.
        sigma_px: their standard deviations, shape (N, S) [px], or ones.
        sensors: their geometry.
        initial_models: cameras from which the search starts too, one a sensor; their distortion
            is ignored. None: no others.
        sigma_known: whether ``sigma_px`` holds standard deviations, and not ones.

    Returns:
        The S cameras, their equations, and the cameras as a stack.

    Raises:
        ImplausibleReadings: the readings have nothing to do with the points.
        DegeneratePoints: more than one camera fits.
        NoConvergence: a few readings do not fit the camera of the others, or no start led to a
            minimum with all points in front of the lens.
    """
    measured = np.isfinite(readings_px)
    weights = np.where(measured, 1.0 / np.where(measured, sigma_px, 1.0), 0.0)
    matrices, centre_mm = np.empty((len(sensors), 2, 4)), np.empty((len(sensors), 3))
    patterns: dict[bytes, list[int]] = {}
    for column in range(len(sensors)):
        patterns.setdefault(measured[:, column].tobytes(), []).append(column)
    for members in patterns.values():
        columns = np.array(members)
        rows = measured[:, columns[0]]
        points = points_mm[rows]
        matrices[columns] = search_starts(
            points,
            readings_px[np.ix_(rows, columns)],
            weights[np.ix_(rows, columns)],
            None if initial_models is None else [initial_models[column] for column in columns],
        )
        centre_mm[columns] = points.mean(axis=0)
    starts = metric_cameras(matrices, sensors, centre_mm)
    solution = minimise(starts, points_mm, readings_px, weights)
    fitted = metric_models(solution.cameras, sensors)
    shares, unbiased = _residual_shares(solution.squares, points_mm, readings_px, weights)
    if sigma_known:
        # Noise as large as that would have been stated.
        dof = np.maximum(measured.sum(axis=0) - PARAMETER_COUNT, 1)
        contradicted = solution.squares > CONTRADICTED_SIGMA_FACTOR**2 * dof
        shares = np.where(contradicted, unbiased, 0.0)
    _check_related(shares, points_mm, readings_px, sensors)
    # First whether there is one camera: a search for none does not come to rest.
    try:
        groups = check_determined(fitted, points_mm, weights, stack=solution.cameras)
    except DegeneratePoints:
        _check_related(unbiased, points_mm, readings_px, sensors)
        raise
    for column, model in enumerate(fitted):
        if not solution.converged[column]:
            _check_related(unbiased, points_mm, readings_px, sensors)
            raise NoConvergence(
                f"sensor {model.name}: no camera with all its {int(measured[:, column].sum())} "
                "control points in front of it fits the readings; look for exchanged or wrong "
                "labels",
                sensor=model.name,
            )
    return fitted, groups, solution.cameras


def _check_related(
    shares: Array, points_mm: Array, readings_px: Array, sensors: Sequence[SensorGeometry]
) -> None:
    """Check that readings are related to the points.

    Args:
        shares: of ``_residual_shares``, shape (S,).
        points_mm: shape (N, 3) [mm].
        readings_px: shape (N, S) [px]; NaN where not seen.
        sensors: the S sensors.

    Raises:
        NoConvergence: a camera fits all but a few readings of a sensor.
        ImplausibleReadings: none does.
    """
    for column in np.flatnonzero(shares > MAX_RESIDUAL_SHARE).tolist():
        rows = np.flatnonzero(np.isfinite(readings_px[:, column]))
        values = readings_px[rows, column]
        camera = ProjectiveCamera.of(points_mm[rows], values)
        theta = robust_starts(camera, values, np.ones(len(values)), 1)
        residuals = np.abs(camera.project(theta)[0] - values)
        all_rows = np.ones((len(values), 1), dtype=np.bool_)
        scale = float(mad_sigma(residuals[:, None], all_rows, PARAMETER_COUNT)[0])
        wrong = rows[residuals > max(WRONG_READING_SIGMA * scale, 1.0)] + 1
        is_majority = len(wrong) <= MAX_WRONG_SHARE * len(values)
        if scale < MAX_MAJORITY_SHARE * values.std() and is_majority:
            name = sensors[column].name
            raise NoConvergence(
                f"sensor {name}: no camera fits all its {len(values)} readings; one fits the "
                f"others to {scale:.2g} px, but not those of points "
                f"{', '.join(map(str, wrong.tolist()))}: look for exchanged or wrong labels there, "
                "or leave these readings out",
                sensor=name,
                points=tuple(wrong.tolist()),
            )
    check_explained(shares, readings_px, sensors)


def _residual_shares(
    squares: Array, points_mm: Array, readings_px: Array, weights: Array
) -> tuple[Array, Array]:
    """Return RMS residuals over the readings' standard deviation, and unbiased by dof, both (S,).

    Where no camera has all points in front of it, the residuals are those from an affine function.

    Args:
        squares: weighted sums of squared residuals, shape (S,); infinite: no camera.
        points_mm: shape (N, 3) [mm].
        readings_px: shape (N, S) [px]; any value where the weight is 0.
        weights: 1 / standard deviation, shape (N, S) [1/px]; 0: not seen.
    """
    square_weights = weights**2
    readings = np.where(weights > 0.0, readings_px, 0.0)
    count = (weights > 0.0).sum(axis=0)
    mean = (square_weights * readings).sum(axis=0) / square_weights.sum(axis=0)
    variance = (square_weights * (readings - mean) ** 2).sum(axis=0) / (count - 1)
    squares = squares.copy()
    dof = count - PARAMETER_COUNT
    for column in np.flatnonzero(~np.isfinite(squares)).tolist():
        weight = weights[:, column]
        design = np.column_stack([points_mm, np.ones(len(points_mm))]) * weight[:, None]
        basis = np.linalg.qr(design)[0]
        values = readings[:, column] * weight
        residuals = values - basis @ (basis.T @ values)
        squares[column], dof[column] = residuals @ residuals, count[column] - 4
    shares = np.sqrt(squares / (count - 1) / variance)
    unbiased = np.sqrt(np.where(dof > 0, squares, 0.0) / np.maximum(dof, 1) / variance)
    return shares, unbiased


def fit_distorted(
    observed: ControlObservations,
    undistorted: SensorFits,
    terms: Sequence[tuple[Term, ...]],
    loss: Loss,
) -> SensorFits:
    """Fit the cameras with distortion terms, one set for each sensor.

    Args:
        observed: control points and readings.
        undistorted: the seven-parameter cameras, from which the fit starts.
        terms: the distortion terms of each sensor; an empty tuple for none.
        loss: "linear" or "robust".

    Raises:
        TooFewPoints: a sensor has fewer readings than parameters.
        DegeneratePoints: a combination of parameters is undetermined.
        NoConvergence: a search did not converge.
    """
    if not any(terms):
        return undistorted
    for sensor, sensor_terms, rows in zip(
        observed.sensors, terms, observed.observed_mask.T, strict=True
    ):
        needed = free_parameters(sensor_terms)
        if rows.sum() < needed:
            raise TooFewPoints(
                f"sensor {sensor.name} saw {rows.sum()} control points; its {needed} parameters "
                f"with {len(sensor_terms)} distortion terms need at least {needed}; give more "
                "points, or take fewer terms",
                sensor=sensor.name,
                points=int(rows.sum()),
            )
    models, weights, prior = undistorted.models, undistorted.weights, undistorted.prior
    unit = None
    for first in (True, False):
        models = start_with_terms(models, terms, prior)
        if not observed.sigma_known:
            unknown = np.full(len(models), INITIAL_SIGMA_PX)
            unit = unknown if first else residual_sigma(observed, models, weights)
        scaled = prior if unit is None else prior.scaled(unit)
        if loss == "robust":
            models, weights = _reweight_distorted(observed, models, scaled, weights, first)
        else:
            models = _minimise(observed, models, scaled, observed.weights, multi_start=first)
        # The first fit gives the principal distance with distortion, and the noise.
        prior = prior.at(models, observed.pitch_um)
    fits = SensorFits(models, weights, prior, unit)
    check_determined(models, observed.points_mm, fits.known_weights(observed), fits.scaled_prior)
    return fits


def residual_sigma(
    observed: ControlObservations, models: Sequence[SensorModel], weights: Array
) -> Array:
    """Estimate each sensor's reading noise from its residuals.

    Args:
        observed: control points and readings.
        models: the S fitted cameras.
        weights: of the readings, shape (N, S); 0: left out.

    Returns:
        Standard deviations, shape (S,) [px].
    """
    sigma = []
    for model, column, weight in zip(
        models, observed.residuals_px(models).T, weights.T, strict=True
    ):
        rows = np.isfinite(column) & (weight > 0.0)
        dof = max(int(rows.sum()) - PARAMETER_COUNT - len(model.terms), 1)
        sigma.append(max(float(np.sqrt((column[rows] ** 2).sum() / dof)), SIGMA_FLOOR_PX))
    return np.array(sigma)


def projected_point_sigma(
    models: Sequence[SensorModel], points_mm: Array, sigma_mm: float
) -> Array:
    """Project the control points' uncertainty onto the readings.

    Args:
        models: S cameras.
        points_mm: control points, shape (N, 3) [mm].
        sigma_mm: standard deviation of each coordinate [mm].

    Returns:
        Standard deviations of the readings due to the points, shape (N, S) [px].
    """
    jacobian = CameraStack.of(models).linearise(points_mm)[1]
    return np.asarray(sigma_mm * np.linalg.norm(jacobian, axis=2))


def block_count(points: int) -> int:
    """Return the number of blocks for a number of points: three points each, 5 to 16 blocks."""
    return int(min(points, max(MIN_BLOCKS, min(MAX_BLOCKS, points // POINTS_PER_BLOCK))))


def spatial_block_index(points_mm: Array, count: int) -> NDArray[np.intp]:
    """Assign points to blocks of space, by repeated halving across the longest extent.

    Model errors of neighbouring points are correlated. Points that are left out one by one would
    be predicted from neighbours with the same error; a block is not.

    Args:
        points_mm: shape (N, 3) [mm].
        count: number of blocks, at most N.

    Returns:
        The block of each point, 0 .. count - 1, shape (N,).
    """
    blocks = np.zeros(len(points_mm), dtype=np.intp)
    parts = [(np.arange(len(points_mm)), 0, count)]
    while parts:
        rows, first, share = parts.pop()
        if share == 1:
            blocks[rows] = first
            continue
        extent = np.ptp(points_mm[rows], axis=0)
        order = rows[np.argsort(points_mm[rows, int(extent.argmax())], kind="stable")]
        low = share // 2
        cut = round(len(rows) * low / share)
        parts += [(order[:cut], first, low), (order[cut:], first + low, share - low)]
    return blocks


def _minimise(
    observed: ControlObservations,
    starts: Sequence[SensorModel],
    prior: LensPrior | None,
    weights: Array,
    multi_start: bool = True,
) -> tuple[SensorModel, ...]:
    stack = CameraStack.of(starts)
    problem = stack, observed.points_mm, observed.readings_px, weights
    if prior is None or not stack.has_distortion:
        solution = minimise(*problem)
    else:
        solution = minimise_with_distortion(*problem, prior, multi_start=multi_start)
    models = solution.cameras.models(starts)
    if not solution.converged.all():
        # Undetermined parameters explain the failure better than "did not converge".
        used = np.where(weights > 0.0, observed.weights, 0.0)
        check_determined(models, observed.points_mm, used, prior)
    check_converged(observed, starts, solution.converged)
    return models


def check_converged(
    observed: ControlObservations, starts: Sequence[SensorModel], converged: NDArray[np.bool_]
) -> None:
    """Check that the search for each camera with distortion converged.

    Args:
        observed: control points and readings.
        starts: the S starting cameras with their terms.
        converged: whether each search converged, shape (S,).

    Raises:
        NoConvergence: the first that did not.
    """
    for column in np.flatnonzero(~converged).tolist():
        name = observed.sensors[column].name
        raise NoConvergence(
            f"sensor {name}: the search for its {PARAMETER_COUNT} parameters and "
            f"{len(starts[column].terms)} distortion terms did not converge with its "
            f"{int(observed.observed_mask[:, column].sum())} readings; spread the points over the "
            "field and in depth, take fewer terms, or look for wrong labels",
            sensor=name,
        )


def _reweight(
    observed: ControlObservations, starts: Sequence[SensorModel]
) -> tuple[tuple[SensorModel, ...], Array]:
    """Iteratively reweighted least squares with Tukey's biweight, until the weights settle."""
    stack = CameraStack.of(starts)
    weights = np.zeros(observed.readings_px.shape)
    for _ in range(MAX_REWEIGHTINGS):
        residuals = stack.project(observed.points_mm) - observed.readings_px
        used = observed.observed_mask & np.isfinite(residuals)
        size = np.where(used, np.abs(residuals) * observed.weights, 0.0)
        scale = mad_sigma(size, used, PARAMETER_COUNT)
        # The known noise is the lower bound of its estimate; without it, rounding is.
        scale = np.maximum(scale, 1.0 if observed.sigma_known else SIGMA_FLOOR_PX)
        new = np.where(used, biweight(size / scale), 0.0)
        change = float(np.abs(new - weights).max())
        weights = new
        problem = observed.points_mm, observed.readings_px, observed.weights * np.sqrt(weights)
        stack = minimise(stack, *problem, None, STEPS_PER_REWEIGHTING).cameras
        if change < WEIGHT_TOLERANCE:
            break
    weighted = observed.weights * np.sqrt(weights)
    models = _minimise(observed, stack.models(starts), None, weighted)
    return models, np.where(observed.observed_mask, weights, 1.0)


def _reweight_distorted(
    observed: ControlObservations,
    starts: Sequence[SensorModel],
    prior: LensPrior,
    weights: Array,
    multi_start: bool,
) -> tuple[tuple[SensorModel, ...], Array]:
    """Fit cameras with distortion to reweighted readings, until the weights settle.

    Args:
        observed: control points and readings.
        starts: S cameras with their terms.
        prior: of the lenses, in units of the readings' weights.
        weights: those to begin with, shape (N, S).
        multi_start: see ``minimise_with_distortion``; the noise then counts as unknown, since
            cameras that are far from the solution leave more of it.
    """
    stack = CameraStack.of(starts)
    min_scale = 1.0 if observed.sigma_known and not multi_start else SIGMA_FLOOR_PX
    for iteration in range(MAX_REWEIGHTINGS):
        solution = minimise_with_distortion(
            stack,
            observed.points_mm,
            observed.readings_px,
            observed.weights * np.sqrt(weights),
            prior,
            multi_start=multi_start and iteration == 0,
        )
        stack = solution.cameras
        new = studentised_weights(observed, solution, weights, observed.sigma_px, min_scale)
        if np.abs(new - weights).max() < SETTLED_WEIGHTS:
            break
        weights = new
    weighted = observed.weights * np.sqrt(weights)
    models = _minimise(observed, stack.models(starts), prior, weighted, multi_start=False)
    return models, weights


def studentised_weights(
    observed: ControlObservations,
    solution: MinimisationResult,
    weights: Array,
    sigma_px: Array,
    min_scale: float | Array,
) -> Array:
    """Return Tukey's weights of the readings by their distance from fitted cameras, shape (N, S).

    The distance counts in its own standard deviation, that of a residual where the reading
    counts, of a prediction where it does not (Baarda's data snooping): few readings leave small
    residuals even of wrong ones, and cameras far from the others are unsure.

    Args:
        observed: control points and readings.
        solution: the search that fitted S cameras.
        weights: with which it did, shape (N, S).
        sigma_px: the readings' standard deviations, shape (N, S) [px].
        min_scale: smallest ratio of the residuals to these, one or shape (S,).
    """
    fitted, jacobian = solution.cameras.project_with_parameter_jacobian(observed.points_mm)
    seen = observed.observed_mask & np.isfinite(fitted)
    jacobian = np.nan_to_num(jacobian)
    leverage = np.einsum("nsp,spq,nsq->ns", jacobian, solution.cofactors, jacobian, optimize=True)
    variance = 1.0 + (1.0 - 2.0 * weights) * leverage / sigma_px**2
    distance = np.where(seen, np.abs(fitted - observed.readings_px), 0.0)
    distance /= sigma_px * np.sqrt(np.maximum(variance, MIN_REDUNDANCY))
    scale = np.maximum(mad_sigma(distance, seen, 0), min_scale)
    return np.where(observed.observed_mask, np.where(seen, biweight(distance / scale), 0.0), 1.0)


def _robust_start(observed: ControlObservations) -> tuple[SensorModel, ...]:
    """Return each sensor's camera of least trimmed squares."""
    matrices, centres = [], []
    for column, rows in enumerate(observed.observed_mask.T):
        points, readings = observed.points_mm[rows], observed.readings_px[rows, column]
        camera = ProjectiveCamera.of(points, readings)
        theta = robust_starts(camera, readings, observed.sigma_px[rows, column], 1)
        centre, scale = np.array([camera.centre_px]), np.array([camera.scale_px])
        matrices.append(projective_matrices(theta, normalisation(points), centre, scale)[0])
        centres.append(points.mean(axis=0))
    cameras = metric_cameras(np.array(matrices), observed.sensors, np.array(centres))
    return metric_models(cameras, observed.sensors)
