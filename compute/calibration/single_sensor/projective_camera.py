"""The 1D camera in projective form: starts, batched least squares, conversion to metric form."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import PARAMETER_COUNT, SensorGeometry, SensorModel
from compute.camera.stack import CameraStack
from compute.errors import DegeneratePoints

Array = NDArray[np.float64]

SEARCH_STEPS: Final = 60
MIN_RELATIVE_DEPTH: Final = 0.05
"""Smallest depth of a point in a trial camera, the centroid's being 1."""
DAMPING_FLOOR, DAMPING_CEILING = 1e-12, 1e8
LOWEST_STARTS: Final = 6
"""Nodes of the grid from which a sensor is searched where its linear solution leaves doubt."""
MIN_PERSPECTIVE_F: Final = 1e3
"""F-value of the perspective (a camera's residuals against those of an affine one) from which the
denominator is known to 3 % and other minima, its mirror image first, are far worse."""
MAX_MISFIT_SHARE: Final = 1e-4
"""Largest share of the readings' variance left in the residuals: 1 % of their spread. Wrong labels
leave more."""
DUPLICATE_TOLERANCE: Final = 1e-12
"""Relative weights of sensors that differ by less are the same: one matrix serves all."""


def normalisation(points_mm: Array) -> Array:
    """Return Hartley's normalisation of points (N, 3): a 4x4 similarity, doi:10.1109/34.601246.

    It moves the points to their centroid and scales their RMS distance to sqrt 3.
    """
    centre = points_mm.mean(axis=0)
    scale = np.sqrt(3.0) / np.sqrt(((points_mm - centre) ** 2).sum(axis=1).mean())
    transform: Array = np.eye(4) * scale
    transform[:3, 3] = -scale * centre
    transform[3, 3] = 1.0
    return transform


@dataclass(frozen=True, eq=False)
class ProjectiveCamera:
    """Control points for cameras ``p = (a.X + b) / (1 + g.X)`` with theta = (a, b, g).

    All points lie in front of a camera, and so does their centroid, the origin here: a depth of 1
    there excludes no valid camera, as setting it to 1 at the world's origin may, [5.1].

    Args:
        points: control points in the frame of ``normalisation``, shape (N, 3).
        centre_px: subtracted from readings [px].
        scale_px: readings are divided by it [px].
        extra: further linear columns (lens distortion) in units of ``scale_px``, shape (N, K);
            None: none. theta has their K coefficients at its end.
        offset_px: constant added to the reading of each point, shape (N,) [px]; None: 0.
    """

    points: Array
    centre_px: float
    scale_px: float
    extra: Array | None = None
    offset_px: Array | None = None

    @property
    def width(self) -> int:
        """Number of parameters: 7 + K."""
        return PARAMETER_COUNT + (0 if self.extra is None else self.extra.shape[1])

    @classmethod
    def of(cls, points_mm: Array, readings_px: Array) -> "ProjectiveCamera":
        """Normalise the points and readings of one sensor.

        Args:
            points_mm: shape (N, 3) [mm].
            readings_px: shape (N,) [px]; NaN where not seen.
        """
        measured = np.isfinite(readings_px)
        transform = normalisation(points_mm[measured])
        points = points_mm @ transform[:3, :3].T + transform[:3, 3]
        return cls(
            points, float(readings_px[measured].mean()), float(readings_px[measured].std()) or 1.0
        )

    @property
    def zero_px(self) -> Array | float:
        """Zero of the normalised readings: ``centre_px`` plus offset, (N,) or one number [px]."""
        return self.centre_px if self.offset_px is None else self.centre_px + self.offset_px

    def project(self, theta: Array) -> Array:
        """Return the readings of cameras (K, width), shape (K, N) [px]."""
        numerator = theta[:, :3] @ self.points.T + theta[:, 3:4]
        readings: Array = numerator / (1.0 + theta[:, 4:PARAMETER_COUNT] @ self.points.T)
        if self.extra is not None:
            readings += theta[:, PARAMETER_COUNT:] @ self.extra.T
        return np.asarray(readings * self.scale_px + self.zero_px)

    def linearise(self, theta: Array) -> tuple[Array, Array]:
        """Return readings (K, N) [px] and their Jacobian by theta, shape (K, N, width)."""
        depth = 1.0 + theta[:, 4:PARAMETER_COUNT] @ self.points.T
        readings = (theta[:, :3] @ self.points.T + theta[:, 3:4]) / depth
        jacobian = np.empty((*readings.shape, self.width))
        jacobian[..., :3] = self.points / depth[..., None]
        jacobian[..., 3] = 1.0 / depth
        jacobian[..., 4:PARAMETER_COUNT] = -readings[..., None] * jacobian[..., :3]
        if self.extra is not None:
            jacobian[..., PARAMETER_COUNT:] = self.extra
            readings = readings + theta[:, PARAMETER_COUNT:] @ self.extra.T
        jacobian *= self.scale_px
        return readings * self.scale_px + self.zero_px, jacobian

    def algebraic(self, readings_px: Array, weights: Array) -> Array:
        """Return the linear solution of [5.5], theta (K, width).

        Args:
            readings_px: shape (K, N) [px].
            weights: shape (K, N); 0: left out.
        """
        zero = self.zero_px
        q = (np.where(weights > 0.0, readings_px, zero) - zero) / self.scale_px
        design = np.empty((*q.shape, PARAMETER_COUNT))
        design[..., :3] = self.points
        design[..., 3] = 1.0
        design[..., 4:] = -q[..., None] * self.points
        design *= weights[..., None]
        solution = self._in_front(_solve(design, q * weights, 1e-12))
        return np.pad(solution, ((0, 0), (0, self.width - PARAMETER_COUNT)))

    def fit(self, readings_px: Array, weights: Array, theta: Array, steps: int) -> Array:
        """Minimise the weighted squares by Levenberg-Marquardt.

        Args:
            readings_px: shape (K, N) [px]; any finite value where the weight is 0.
            weights: 1 / standard deviation, shape (K, N) [1/px]; 0: left out.
            theta: starting cameras with all points in front, shape (K, width).
            steps: largest number of trial steps.

        Returns:
            theta at the minima, shape (K, width).
        """
        minimum = theta.copy()
        active = np.arange(len(theta))
        damping = np.full(len(theta), 1e-4)
        cost = self._cost(theta, readings_px, weights)
        for _ in range(steps):
            fitted, jacobian = self.linearise(theta)
            jacobian *= weights[..., None]
            step = _solve(jacobian, (readings_px - fitted) * weights, damping)
            trial = self._in_front(theta + step)
            new = self._cost(trial, readings_px, weights)
            better, gain = new < cost, cost - new
            theta = np.where(better[:, None], trial, theta)
            damping *= np.where(better, 0.1, 10.0)
            damping = np.minimum(np.maximum(damping, DAMPING_FLOOR), DAMPING_CEILING)
            least = 1e-9 * cost
            settled = np.where(
                better, gain <= least, (gain >= -least) | (damping >= DAMPING_CEILING)
            )
            cost = np.where(better, new, cost)
            if settled.any():
                minimum[active] = theta
                going = ~settled
                active, theta = active[going], theta[going]
                cost, damping = cost[going], damping[going]
                readings_px, weights = readings_px[going], weights[going]
                if len(active) == 0:
                    break
        minimum[active] = theta
        return minimum

    def _cost(self, theta: Array, readings_px: Array, weights: Array) -> Array:
        misfit = self.project(theta)
        misfit -= readings_px
        misfit *= weights
        return np.asarray(np.einsum("kn,kn->k", misfit, misfit))

    def _in_front(self, theta: Array) -> Array:
        """Reduce the depth's gradient where a point would come too near or behind."""
        lowest = (theta[:, 4:PARAMETER_COUNT] @ self.points.T).min(axis=1)
        if lowest.min() >= MIN_RELATIVE_DEPTH - 1.0:
            return theta
        shrink = np.minimum(1.0, (1.0 - MIN_RELATIVE_DEPTH) / np.maximum(-lowest, 1e-12))
        theta = theta.copy()
        theta[:, 4:PARAMETER_COUNT] *= shrink[:, None]
        return theta


def _solve(design: Array, right: Array, damping: Array | float) -> Array:
    """Solve damped least squares for each design (K, N, 7) and right side (K, N)."""
    transposed = design.swapaxes(1, 2)
    normal = transposed @ design
    diagonal = np.arange(design.shape[2])
    # Columns of length 1, by the diagonal: their products are fewer than their values.
    scale = 1.0 / (np.sqrt(normal[:, diagonal, diagonal]) + 1e-150)
    normal *= scale[:, :, None] * scale[:, None, :]
    normal[:, diagonal, diagonal] += (
        damping if isinstance(damping, float) else damping[:, None]
    ) + 1e-13
    gradient = (transposed @ right[..., None])[..., 0] * scale
    return np.asarray(np.linalg.solve(normal, gradient[..., None])[..., 0] * scale)


def starting_cameras(camera: ProjectiveCamera, readings: Array, weights: Array) -> Array:
    """Return starting cameras for the search, shape (S, LOWEST_STARTS, 7).

    With the denominator ``w = 1 + g.X`` fixed, the numerator is linear; all cameras with every
    point in front have g in a bounded set. A grid over that set, with the numerator solved at each
    node (variable projection), finds where the sum of squares is small, so that the search does not
    depend on the linear solution [5.5] alone.

    Args:
        camera: control points, all seen by all sensors.
        readings: of S sensors, shape (S, N), in the camera's unit.
        weights: 1 / standard deviation of the readings, shape (S, N).
    """
    points = camera.points
    gradients = _grid()
    # Scale each direction so that the nearest point keeps a positive depth.
    reach = (gradients @ points.T).min(axis=1)
    gradients = gradients / np.maximum(-reach, 1.0)[:, None] * 0.999
    inverse = 1.0 / (1.0 + gradients @ points.T)
    relative = weights / weights.max(axis=1, keepdims=True)
    if np.ptp(relative, axis=0).max() <= DUPLICATE_TOLERANCE:
        numerators, costs = _numerators(points, inverse, relative[0], readings)
    else:
        each = [
            _numerators(points, inverse, weight, reading[None])
            for weight, reading in zip(relative, readings, strict=True)
        ]
        numerators, costs = (np.concatenate(parts) for parts in zip(*each, strict=True))
    best = np.argpartition(costs, LOWEST_STARTS, axis=1)[:, :LOWEST_STARTS]
    chosen = numerators[np.arange(len(readings))[:, None], best]
    return np.concatenate([chosen, gradients[best]], axis=2)


def _numerators(
    points: Array, inverse: Array, weight: Array, readings: Array
) -> tuple[Array, Array]:
    """Return the least-squares numerators (S, G, 4) of S sensors and their sums of squares (S, G).

    Args:
        points: shape (N, 3).
        inverse: 1 / denominator at the points, of each of G nodes, shape (G, N).
        weight: of the readings of all these sensors, shape (N,).
        readings: shape (S, N).
    """
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    weighted = homogeneous * weight[:, None] ** 2
    products = (homogeneous[:, :, None] * weighted[:, None, :]).reshape(len(points), 16)
    normal = (inverse**2 @ products).reshape(-1, 4, 4)
    # A thousandth of a millionth more of the diagonal: flat frames are refused elsewhere.
    normal *= 1.0 + 1e-9 * np.eye(4)
    right = (weighted[:, :, None] * readings.T[:, None, :]).reshape(len(points), -1)
    moment = (inverse @ right).reshape(len(inverse), 4, -1)
    numerator = np.asarray(np.linalg.solve(normal, moment), dtype=np.float64)
    squares = (readings**2) @ weight**2
    cost: Array = squares[:, None] - (numerator * moment).sum(axis=1).T
    return numerator.transpose(2, 0, 1), cost


@cache
def _grid() -> Array:
    """Return gradients of the denominator: directions on the sphere times slopes, shape (G, 3).

    A slope of s changes the depth by the fraction s over the points' RMS extent.
    """
    count = 48
    angle = np.pi * (1.0 + np.sqrt(5.0)) * (np.arange(count) + 0.5)
    height = 1.0 - 2.0 * (np.arange(count) + 0.5) / count
    ring = np.sqrt(1.0 - height**2)
    directions = np.column_stack([np.cos(angle) * ring, np.sin(angle) * ring, height])
    gradients = np.array([0.02, 0.06, 0.13, 0.27, 0.5])
    return np.asarray((gradients[:, None, None] * directions).reshape(-1, 3))


@dataclass(frozen=True, eq=False)
class _NormalisedReadings:
    """Readings of S sensors that all read all points, in units of their spread.

    Args:
        camera: the normalised points.
        transform: their ``normalisation``, shape (4, 4).
        centre_px: subtracted from the readings, shape (S,) [px].
        scale_px: their unit, shape (S,) [px].
        readings: shape (S, N).
        weights: 1 / standard deviation, shape (S, N).
    """

    camera: ProjectiveCamera
    transform: Array
    centre_px: Array
    scale_px: Array
    readings: Array
    weights: Array

    @classmethod
    def of(cls, points_mm: Array, readings_px: Array, weights: Array) -> "_NormalisedReadings":
        transform = normalisation(points_mm)
        points = points_mm @ transform[:3, :3].T + transform[:3, 3]
        centre, scale = readings_px.mean(axis=0), readings_px.std(axis=0)
        scale = np.where(scale > 0.0, scale, 1.0)
        return cls(
            ProjectiveCamera(points, 0.0, 1.0),
            transform,
            centre,
            scale,
            ((readings_px - centre) / scale).T,
            (weights * scale).T,
        )

    def parameters(self, models: Sequence[SensorModel]) -> Array:
        """Return (a, b, g) of S models without their distortion, shape (S, 7)."""
        matrices = CameraStack.of(models).matrices @ np.linalg.inv(self.transform)
        matrices = matrices / matrices[:, 1:, 3:]  # With the points in front.
        first, second = matrices[:, 0], matrices[:, 1]
        scaled = (first - self.centre_px[:, None] * second) / self.scale_px[:, None]
        return np.asarray(np.concatenate([scaled, second[:, :3]], axis=1))

    def search(self, starts: Array) -> tuple[Array, Array]:
        """Return each sensor's best camera (S, 7) from starts (S, K, 7), and its squares (S,)."""
        count, readings, weights = starts.shape[1], self.readings, self.weights
        if count > 1:
            readings, weights = (np.repeat(one, count, axis=0) for one in (readings, weights))
        theta = self.camera.fit(readings, weights, starts.reshape(-1, 7), SEARCH_STEPS)
        misfit = (self.camera.project(theta) - readings) * weights
        squares = (misfit**2).sum(axis=1).reshape(-1, count)
        best = np.arange(len(squares)), np.argmin(squares, axis=1)
        return theta.reshape(-1, count, 7)[best], squares[best]

    def rows(self, index: NDArray[np.intp]) -> "_NormalisedReadings":
        """Return the readings of some sensors."""
        return replace(self, readings=self.readings[index], weights=self.weights[index])

    def matrices(self, theta: Array) -> Array:
        """Return the 2x4 matrices of cameras (S, 7)."""
        return projective_matrices(theta, self.transform, self.centre_px, self.scale_px)


def search_starts(
    points_mm: Array,
    readings_px: Array,
    weights: Array,
    initial_models: Sequence[SensorModel] | None,
) -> Array:
    """Search the projective cameras of sensors that all read all points.

    From the linear solution and the initial cameras; then, where these do not settle it, from a
    grid of others.

    Args:
        points_mm: shape (N, 3) [mm].
        readings_px: shape (N, S) [px].
        weights: 1 / standard deviation, shape (N, S) [1/px].
        initial_models: S cameras from which the search starts too, without their distortion.

    Returns:
        The best 2x4 matrix of each sensor, shape (S, 2, 4).
    """
    problem = _NormalisedReadings.of(points_mm, readings_px, weights)
    starts = problem.camera.algebraic(problem.readings, problem.weights)[:, None]
    if initial_models is not None:
        others = problem.parameters(initial_models)[:, None]
        starts = np.concatenate([starts, others], axis=1)
    solutions, squares = problem.search(starts)
    unsettled = np.flatnonzero(~_is_settled(problem, squares))
    if len(unsettled):
        part = problem.rows(unsettled)
        nodes = starting_cameras(part.camera, part.readings, part.weights)
        solutions[unsettled] = part.search(
            np.concatenate([solutions[unsettled, None], nodes], axis=1)
        )[0]
    return problem.matrices(solutions)


def search_from(
    points_mm: Array, readings_px: Array, weights: Array, models: Sequence[SensorModel]
) -> Array:
    """Search the projective cameras of sensors from given ones only.

    A bad start of the metric form creeps along a curved valley of principal distance, depth and
    rotation; in the projective form, whose numerator is linear, it does not.

    Args:
        points_mm: shape (N, 3) [mm].
        readings_px: shape (N, S) [px].
        weights: 1 / standard deviation, shape (N, S) [1/px].
        models: the S cameras, with the points in front; their distortion is left out.

    Returns:
        The 2x4 matrix of each sensor, shape (S, 2, 4).
    """
    problem = _NormalisedReadings.of(points_mm, readings_px, weights)
    return problem.matrices(problem.search(problem.parameters(models)[:, None])[0])


def _is_settled(problem: _NormalisedReadings, squares: Array) -> NDArray[np.bool_]:
    """Return which sensors' cameras fit so well that no other minimum competes, shape (S,)."""
    weights = problem.weights
    design = np.empty((*weights.shape, 4))
    design[..., :3] = problem.camera.points
    design[..., 3] = 1.0
    design *= weights[..., None]
    target = problem.readings * weights
    affine = (design @ _solve(design, target, 1e-12)[..., None])[..., 0] - target
    gain = (affine**2).sum(axis=1) - squares
    dof = weights.shape[1] - PARAMETER_COUNT
    return np.asarray(
        (dof * gain >= MIN_PERSPECTIVE_F * squares)
        & (squares <= MAX_MISFIT_SHARE * (target**2).sum(axis=1))
    )


def projective_matrices(theta: Array, transform: Array, centre_px: Array, scale_px: Array) -> Array:
    """Return the 2x4 matrices of cameras in a normalised frame, shape (S, 2, 4).

    Args:
        theta: (a, b, g), shape (S, 7).
        transform: the frame's ``normalisation``, shape (4, 4).
        centre_px: centres of the normalised readings, shape (S,) [px].
        scale_px: their scales, shape (S,) [px].
    """
    second = np.ones((len(theta), 4))
    second[:, :3] = theta[:, 4:]
    first = scale_px[:, None] * theta[:, :4] + centre_px[:, None] * second
    return np.asarray(np.stack([first, second], axis=1) @ transform)


def metric_cameras(
    matrices: Array, sensors: Sequence[SensorGeometry], visible_mm: Array
) -> CameraStack:
    """Return the metric cameras of 2x4 matrices, whatever their scale and sign.

    Args:
        matrices: shape (S, 2, 4).
        sensors: the S sensors.
        visible_mm: a point in front of each lens, shape (S, 3) [mm].

    Raises:
        DegeneratePoints: a camera reads the same of all points.
    """
    first, second = matrices[:, 0], matrices[:, 1]
    norm = np.sqrt((second[:, :3] ** 2).sum(axis=1))
    facing = (second[:, :3] * visible_mm).sum(axis=1) + second[:, 3]
    norm = np.where(facing < 0.0, -norm, norm)[:, None]
    first, second = first / norm, second / norm
    point = (first[:, :3] * second[:, :3]).sum(axis=1)
    along = first - point[:, None] * second
    distance = np.sqrt((along[:, :3] ** 2).sum(axis=1))
    for column in np.flatnonzero(~(distance > 1e-12 * np.maximum(1.0, np.abs(point)))).tolist():
        raise DegeneratePoints(
            f"sensor {sensors[column].name} reads the same of all its control points, as far as a "
            "camera can tell; spread them across the sensor",
            sensor=sensors[column].name,
        )
    along /= distance[:, None]
    x, z = along[:, :3], second[:, :3]
    y = z[:, [1, 2, 0]] * x[:, [2, 0, 1]] - z[:, [2, 0, 1]] * x[:, [1, 2, 0]]
    count, none = len(matrices), np.zeros(len(matrices))
    return CameraStack(
        principal_distance_px=distance,
        principal_point_px=point,
        rotation=np.stack([x, y, z], axis=1),
        offset_mm=np.stack([along[:, 3], none, second[:, 3]], axis=1),
        cubic_per_px2=none,
        terms=(),
        coefficients=np.zeros((count, 0)),
        row_behind_mm=none,
        parameter_index=np.arange(count * PARAMETER_COUNT).reshape(count, PARAMETER_COUNT),
    )


def metric_models(
    cameras: CameraStack, sensors: Sequence[SensorGeometry]
) -> tuple[SensorModel, ...]:
    """Return cameras without distortion as models.

    Args:
        cameras: S cameras.
        sensors: the S sensors, for their names and pixels.
    """
    return cameras.models(
        [SensorModel(one.name, one.pixels, 1.0, 0.0, (0.0, 0.0, 0.0), 0.0, 0.0) for one in sensors]
    )
