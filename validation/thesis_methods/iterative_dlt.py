"""The thesis's iterative DLT with its cubic distortion term, [5.1]-[5.12], for comparison."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.calibration.single_sensor.projective_camera import normalisation
from compute.errors import NoConvergence

Array = NDArray[np.float64]

THESIS_ITERATIONS = 30
"""Section 5.2: "30 iterations were completed to update the distortion term"."""


@dataclass(frozen=True, eq=False)
class IterativeDlt:
    """What the iteration ends with.

    Args:
        matrix: 2x4 matrix of the corrected readings.
        principal_point_px: p0 of [5.3] after each iteration, shape (I,) (Figure 5.4).
        cubic_per_px2: D of [5.2].
        change_px: largest change of a corrected reading in the last iteration [px].
    """

    matrix: Array
    principal_point_px: Array
    cubic_per_px2: float
    change_px: float


def iterative_dlt(
    points_mm: Array,
    readings_px: Array,
    sensor: str,
    iterations: int = THESIS_ITERATIONS,
    normalised: bool = False,
) -> IterativeDlt:
    """Alternate between L1..L7 ([5.7]) and D ([5.11]) for a fixed number of iterations.

    Args:
        points_mm: control points, shape (N, 3).
        readings_px: readings of one sensor, shape (N,) [px].
        sensor: the sensor's name, for the error.
        iterations: 30 in the thesis.
        normalised: False: as published, normal equations in the given coordinates. True: the
            same equations, with the points moved to their centroid and scaled, and solved
            by QR. The published form sets the constant of the denominator to 1, which no
            camera has whose lens plane holds the world's origin, as in Test 5.2.

    Raises:
        NoConvergence: the iteration left the finite numbers, or the equations are singular.
    """
    if not normalised:
        return _iterate(points_mm, readings_px, sensor, iterations, normal_equations=True)
    transform = normalisation(points_mm)
    centre, scale = float(readings_px.mean()), float(readings_px.std()) or 1.0
    moved = points_mm @ transform[:3, :3].T + transform[:3, 3]
    inner = _iterate(
        moved, (readings_px - centre) / scale, sensor, iterations, normal_equations=False
    )
    first, second = inner.matrix
    return IterativeDlt(
        np.array([scale * first + centre * second, second]) @ transform,
        inner.principal_point_px * scale + centre,
        inner.cubic_per_px2 / scale**2,
        inner.change_px * scale,
    )


def _iterate(
    points: Array, readings: Array, sensor: str, iterations: int, normal_equations: bool
) -> IterativeDlt:
    homogeneous = np.column_stack([points, np.ones(len(points))])
    corrected = readings
    principal_points = []
    cubic, change = 0.0, np.inf
    parameters = np.zeros(7)
    with np.errstate(all="ignore"):
        for _ in range(iterations):
            design = np.hstack([homogeneous, -corrected[:, None] * points])
            parameters = _solve(design, corrected, sensor, normal_equations)
            axis = parameters[4:]
            principal_point = float(parameters[:3] @ axis / (axis @ axis))
            ideal = homogeneous @ parameters[:4] / (points @ axis + 1.0)
            cube = (readings - principal_point) ** 3
            cubic = float(cube @ (ideal - readings) / (cube @ cube))
            updated = readings + cubic * cube
            change = float(np.abs(updated - corrected).max())
            corrected = updated
            principal_points.append(principal_point)
            if not np.isfinite(change):
                raise NoConvergence(
                    f"sensor {sensor}: the iterative DLT diverged after "
                    f"{len(principal_points)} iterations (principal points "
                    f"{', '.join(f'{value:.4g}' for value in principal_points[-3:])}); "
                    "use the metric method",
                    sensor=sensor,
                )
    matrix = np.array([parameters[:4], [*parameters[4:], 1.0]])
    return IterativeDlt(matrix, np.array(principal_points), cubic, change)


def _solve(design: Array, right: Array, sensor: str, normal_equations: bool) -> Array:
    if not normal_equations:
        return np.asarray(np.linalg.lstsq(design, right, rcond=None)[0], dtype=np.float64)
    try:
        solved = np.linalg.solve(design.T @ design, design.T @ right)
        return np.asarray(solved, dtype=np.float64)
    except np.linalg.LinAlgError:
        raise NoConvergence(
            f"sensor {sensor}: the normal equations [5.7] of the iterative DLT are singular; "
            "use the metric method",
            sensor=sensor,
        ) from None
