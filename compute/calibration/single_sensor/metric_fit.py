"""Seven-parameter metric cameras of all sensors from control points, by a multi-start search."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.single_sensor.camera_fit import minimise
from compute.calibration.single_sensor.design_matrix import check_determined
from compute.calibration.single_sensor.projective_camera import (
    ProjectiveCamera,
    normalisation,
    starting_cameras,
)
from compute.camera.model import PARAMETER_COUNT, SensorGeometry, SensorModel
from compute.camera.stack import CameraStack
from compute.errors import DegeneratePoints, NoConvergence

Array = NDArray[np.float64]

SEARCH_STEPS: Final = 60


def fit_metric_cameras(
    points_mm: Array,
    readings_px: Array,
    sigma_px: Array,
    sensors: Sequence[SensorGeometry],
    initial_models: Sequence[SensorModel] | None = None,
) -> tuple[SensorModel, ...]:
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

    Raises:
        DegeneratePoints: more than one camera fits.
        NoConvergence: no start led to a minimum with all points in front of the lens.
    """
    seen = np.isfinite(readings_px)
    weights = np.where(seen, 1.0 / np.where(seen, sigma_px, 1.0), 0.0)
    matrices, centre_mm = np.empty((len(sensors), 2, 4)), np.empty((len(sensors), 3))
    patterns: dict[bytes, list[int]] = {}
    for column in range(len(sensors)):
        patterns.setdefault(seen[:, column].tobytes(), []).append(column)
    for members in patterns.values():
        columns = np.array(members)
        rows = seen[:, columns[0]]
        points = points_mm[rows]
        matrices[columns] = _search_starts(
            points,
            readings_px[np.ix_(rows, columns)],
            weights[np.ix_(rows, columns)],
            None if initial_models is None else [initial_models[column] for column in columns],
        )
        centre_mm[columns] = points.mean(axis=0)
    starts = _cameras(matrices, sensors, centre_mm)
    ended = minimise(starts, points_mm, readings_px, weights)
    fitted = ended.cameras.models([_blank(sensor) for sensor in sensors])
    # First whether there is one camera: a search for none does not come to rest.
    check_determined(fitted, points_mm, weights, stack=ended.cameras)
    for column, model in enumerate(fitted):
        if not ended.converged[column]:
            raise NoConvergence(
                f"sensor {model.name}: no camera with all its {int(seen[:, column].sum())} control "
                "points in front of it fits the readings; look for exchanged or wrong labels",
                sensor=model.name,
            )
    return fitted


def _search_starts(
    points_mm: Array,
    readings_px: Array,
    weights: Array,
    initial_models: Sequence[SensorModel] | None,
) -> Array:
    """Return the best matrix of each sensor, shape (S, 2, 4); all see all points (N, 3)."""
    transform = normalisation(points_mm)
    points = points_mm @ transform[:3, :3].T + transform[:3, 3]
    camera = ProjectiveCamera(points, 0.0, 1.0)
    centre, scale = readings_px.mean(axis=0), readings_px.std(axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    readings = ((readings_px - centre) / scale).T
    weight = (weights * scale).T
    starts = starting_cameras(camera, readings, weight)
    if initial_models is not None:
        inverse = np.linalg.inv(transform)
        # The matrices leave the distortion out.
        matrices = CameraStack.of(initial_models).matrices
        others = [
            _projective_parameters(matrix @ inverse, m, s)
            for matrix, m, s in zip(matrices, centre, scale, strict=True)
        ]
        starts = np.concatenate([starts, np.array(others)[:, None]], axis=1)
    count = starts.shape[1]
    rows = np.repeat(readings, count, axis=0)
    row_weights = np.repeat(weight, count, axis=0)
    theta = camera.fit(rows, row_weights, starts.reshape(-1, 7), SEARCH_STEPS)
    squares = (((camera.project(theta) - rows) * row_weights) ** 2).sum(axis=1)
    best = np.argmin(squares.reshape(-1, count), axis=1)
    chosen = theta.reshape(-1, count, 7)[np.arange(len(best)), best]
    return _matrices(chosen, transform, centre, scale)


def metric_from_projective(
    theta: Array,
    transform: Array,
    centre_px: float,
    scale_px: float,
    sensor: SensorGeometry,
    seen_mm: Array,
) -> SensorModel:
    """Return the metric camera of a projective one in a normalised frame.

    Args:
        theta: (a, b, g), shape (7,).
        transform: the frame's ``normalisation``, shape (4, 4).
        centre_px: centre of the normalised readings [px].
        scale_px: scale of the normalised readings [px].
        sensor: the sensor.
        seen_mm: a point in front of the lens, shape (3,) [mm].

    Raises:
        DegeneratePoints: the camera reads the same for all points.
    """
    matrix = _matrices(theta[None], transform, np.array([centre_px]), np.array([scale_px]))
    return _cameras(matrix, [sensor], seen_mm[None]).models([_blank(sensor)])[0]


def _matrices(theta: Array, transform: Array, centre_px: Array, scale_px: Array) -> Array:
    """Return the 2x4 matrices of (a, b, g) in a normalised frame (S, 7), shape (S, 2, 4)."""
    second = np.ones((len(theta), 4))
    second[:, :3] = theta[:, 4:]
    first = scale_px[:, None] * theta[:, :4] + centre_px[:, None] * second
    matrices: Array = np.stack([first, second], axis=1) @ transform
    return matrices


def _cameras(matrices: Array, sensors: Sequence[SensorGeometry], seen_mm: Array) -> CameraStack:
    """Return the metric cameras of 2x4 matrices (S, 2, 4), as ``model_from_matrix`` does.

    Args:
        matrices: whatever their scale and sign.
        sensors: for the error.
        seen_mm: a point in front of each lens, shape (S, 3).

    Raises:
        DegeneratePoints: one reads the same of all points.
    """
    first, second = matrices[:, 0], matrices[:, 1]
    norm = np.sqrt((second[:, :3] ** 2).sum(axis=1))
    facing = (second[:, :3] * seen_mm).sum(axis=1) + second[:, 3]
    norm = np.where(facing < 0.0, -norm, norm)[:, None]
    first, second = first / norm, second / norm
    point = (first[:, :3] * second[:, :3]).sum(axis=1)
    along = first - point[:, None] * second
    distance = np.sqrt((along[:, :3] ** 2).sum(axis=1))
    for sensor, blind in zip(
        sensors, ~(distance > 1e-12 * np.maximum(1.0, np.abs(point))), strict=True
    ):
        if blind:
            raise DegeneratePoints(
                f"sensor {sensor.name} reads the same of all its control points, as far as a "
                "camera can tell; spread them across the sensor",
                sensor=sensor.name,
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


def _blank(sensor: SensorGeometry) -> SensorModel:
    """Return a camera with a sensor's name and pixels and values to be replaced."""
    return SensorModel(sensor.name, sensor.pixels, 1.0, 0.0, (0.0, 0.0, 0.0), 0.0, 0.0)


def _projective_parameters(matrix: Array, centre_px: float, scale_px: float) -> Array:
    """Return (a, b, g) of a 2x4 matrix in the normalised frame, with its points in front."""
    first, second = matrix / matrix[1, 3]
    theta: Array = np.concatenate([(first - centre_px * second) / scale_px, second[:3]])
    return theta
