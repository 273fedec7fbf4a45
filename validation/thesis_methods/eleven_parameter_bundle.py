"""The thesis's stepwise optimisation of the eleven coefficients, section 5.6, for comparison."""

from dataclasses import astuple, dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import SensorGeometry
from compute.errors import InvalidParameter, NoConvergence
from validation.thesis_methods.dlt import (
    CollinearityParameters,
)

Array = NDArray[np.float64]

PARAMETER_ORDER: Final = ("c", "p0", "X0", "Y0", "Z0", "L1", "L2", "L3", "L4", "L5", "L6")
"""Order of the eleven coefficients, that of Tables 5.10 to 5.12."""
MIN_POINTS: Final = 12
"""Section 5.3: "12 or more data points"."""
THESIS_ITERATIONS: Final = 500
"""Values tried of each coefficient in one step ("each of these steps contained 500 iterations")."""
THESIS_SWEEPS: Final = 13
"""Steps over all eleven ("completing 13 error minimization steps")."""


@dataclass(frozen=True, eq=False)
class StepGrid:
    """Values that each coefficient may take: ``first + j step``, j = 0 .. iterations.

    Args:
        first: starting values, in the order of PARAMETER_ORDER, shape (11,); Table 5.11.
        step: iteration steps of [5.27], shape (11,).
        iterations: 500 in the thesis.
    """

    first: Array
    step: Array
    iterations: int = THESIS_ITERATIONS

    @classmethod
    def around(cls, estimate: CollinearityParameters, sensor: SensorGeometry) -> "StepGrid":
        """Return the thesis's grid about a first estimate, c and p0 in pixels.

        Table 5.11 starts at 0.06 c and p0 = 0, 25 mm before X0 and Y0, 175 mm before Z0 and 0.25
        before each L. The steps are not printed; the digits of Table 5.12 show them: c by 0.004
        of its estimate, p0 by a 500th of the sensor, X0 and Y0 by 0.1 mm, Z0 by 1 mm, L by 0.001.
        """
        values = to_array(estimate)
        before = np.array([0.94 * estimate.c, estimate.p0, 25.0, 25.0, 175.0, *[0.25] * 6])
        step = np.array(
            [0.004 * estimate.c, sensor.pixels / THESIS_ITERATIONS, 0.1, 0.1, 1.0, *[1e-3] * 6]
        )
        return cls(values - before, step)

    def values(self, index: int) -> Array:
        """Return the values of one coefficient, shape (iterations + 1,)."""
        return np.asarray(
            self.first[index] + self.step[index] * np.arange(self.iterations + 1), dtype=np.float64
        )


@dataclass(frozen=True, eq=False)
class StepwiseBundle:
    """Where the stepwise optimisation ended.

    Args:
        parameters: the eleven coefficients, in the unit of the readings and mm.
        error: E of [5.28] after each pass, shape (P + 1,), the start's first; the unit of the
            readings, squared.
        at_iteration: iteration at which each coefficient's minimum lay in the last pass, shape
            (11,); section 5.6 takes it for a global minimum if all are the same.
    """

    parameters: CollinearityParameters
    error: Array
    at_iteration: NDArray[np.intp]


def to_array(parameters: CollinearityParameters) -> Array:
    """Return the eleven coefficients as an array in the order of PARAMETER_ORDER."""
    c, p0, centre, along, axis = astuple(parameters)
    return np.array([c, p0, *centre, *along, *axis], dtype=np.float64)


def from_array(values: Array) -> CollinearityParameters:
    """Return eleven values, in the order of PARAMETER_ORDER, as coefficients."""
    c, p0, x, y, z, l1, l2, l3, l4, l5, l6 = values.tolist()
    return CollinearityParameters(c, p0, (x, y, z), (l1, l2, l3), (l4, l5, l6))


def project_eleven_parameters(values: Array, points_mm: Array) -> Array:
    """Return the readings [5.25] of eleven coefficients (..., 11) at points (N, 3): (..., N)."""
    relative = points_mm - values[..., None, 2:5]
    along = (relative * values[..., None, 5:8]).sum(axis=-1)
    depth = (relative * values[..., None, 8:11]).sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        readings: Array = values[..., 1:2] - values[..., 0:1] * along / depth
    return readings


def stepwise_bundle(
    points_mm: Array,
    readings: Array,
    sensor: str,
    grid: StepGrid,
    passes: int = THESIS_SWEEPS,
    start: CollinearityParameters | None = None,
) -> StepwiseBundle:
    """Minimise E of [5.28] coefficient by coefficient over their grids.

    In each pass each coefficient in turn is stepped through its range with the others held
    ([5.27]), and stays where E is least. As the text reads: which one goes first, and whether a
    new value counts at once, it does not say; here the order is that of its tables, and at once.

    Args:
        points_mm: control points, shape (N, 3).
        readings: of one sensor, shape (N,), in any unit (the thesis: mm); c and p0 are in it.
        sensor: the sensor's name, for an error.
        grid: the coefficients' values.
        passes: 13 in the thesis.
        start: first values; None: those of the grid, Table 5.11.

    Raises:
        InvalidParameter: a grid whose steps are not finite, or that has none.
        NoConvergence: no value gave a finite error.
    """
    if grid.iterations < 1 or not (np.isfinite(grid.first).all() and np.isfinite(grid.step).all()):
        raise InvalidParameter(
            f"sensor {sensor}: the grid of the stepwise optimisation has {grid.iterations} "
            "iterations, from and by finite values; it must have 1 at least",
            sensor=sensor,
        )
    values = grid.first.copy() if start is None else to_array(start)
    errors = [float(_error(values, points_mm, readings))]
    at = np.zeros(len(PARAMETER_ORDER), dtype=np.intp)
    for _ in range(passes):
        for index in range(len(PARAMETER_ORDER)):
            trial = np.repeat(values[None], grid.iterations + 1, axis=0)
            trial[:, index] = grid.values(index)
            error = _error(trial, points_mm, readings)
            at[index] = int(np.argmin(error))
            if error[at[index]] < _error(values, points_mm, readings):
                values = trial[at[index]]
        errors.append(float(_error(values, points_mm, readings)))
    if not np.isfinite(errors[-1]):
        raise NoConvergence(
            f"sensor {sensor}: no value of the stepwise optimisation gave a finite error; give a "
            "first estimate nearer to the sensor, or use the metric method",
            sensor=sensor,
        )
    return StepwiseBundle(from_array(values), np.array(errors), at)


def _error(values: Array, points_mm: Array, readings: Array) -> Array:
    """Return E of [5.28] for coefficients (..., 11), shape (...); infinite where undefined."""
    squares = ((project_eleven_parameters(values, points_mm) - readings) ** 2).sum(axis=-1)
    return np.asarray(np.where(np.isfinite(squares), squares, np.inf), dtype=np.float64)
