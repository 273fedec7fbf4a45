"""Peers of the calibration benchmark: SciPy and pyceres on the eleven coefficients."""

from dataclasses import dataclass
from importlib import import_module
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from compute.calibration.single_sensor.projective_camera import normalisation
from compute.errors import DegeneratePoints
from validation.thesis_methods.eleven_parameter_bundle import project_eleven_parameters

Array = NDArray[np.float64]

RANK: Final = 7
"""Of the eleven coefficients; the other four are gauge."""
MAX_EVALUATIONS: Final = 2000


RANK_LIMIT: Final = 1e-9
"""Smallest seventh singular value of the design, relative to the first."""


def dlt_matrix(points_mm: Array, readings_px: Array, sensor: str) -> Array:
    """Solve ``p (m2.X~) = m1.X~`` for the 2x4 matrix in the algebraic least-squares sense.

    Equation [5.5] of the thesis without fixing the constant of the denominator to 1, with
    normalised points and readings, by singular values.

    Args:
        points_mm: control points that the sensor saw, shape (N, 3), N >= 7.
        readings_px: its readings, shape (N,) [px].
        sensor: the sensor's name, for the error.

    Raises:
        DegeneratePoints: the design's rank is below 7: more than one camera fits.
    """
    transform = normalisation(points_mm)
    homogeneous = np.column_stack([points_mm, np.ones(len(points_mm))]) @ transform.T
    centre = float(readings_px.mean())
    scale = float(readings_px.std()) or 1.0
    q = (readings_px - centre) / scale
    design = np.hstack([homogeneous, -q[:, None] * homogeneous])
    _, singular, right = np.linalg.svd(design, full_matrices=True)
    if singular[6] < RANK_LIMIT * singular[0]:
        raise DegeneratePoints(
            f"the control points and readings of sensor {sensor} determine only "
            f"{int((singular > RANK_LIMIT * singular[0]).sum())} of 7 parameters; spread the "
            "points in all three directions and across the sensor",
            sensor=sensor,
        )
    first, second = right[-1, :4], right[-1, 4:]
    matrix: Array = np.array([scale * first + centre * second, second]) @ transform
    return matrix


@dataclass(frozen=True, eq=False)
class Bundle:
    """Residuals of one sensor over the eleven coefficients, in the order of ``NAMES``."""

    points_mm: Array
    readings_px: Array

    def values(self, x: Array) -> Array:
        """Return generated minus measured readings, shape (19,) [px]."""
        return np.asarray(project_eleven_parameters(x, self.points_mm) - self.readings_px)

    def slopes(self, x: Array) -> Array:
        """Return d values / d coefficients, shape (19, 11)."""
        relative = self.points_mm - x[2:5]
        along, depth = relative @ x[5:8], relative @ x[8:11]
        q = along / depth
        gain = (-x[0] / depth)[:, None]
        jacobian = np.empty((len(relative), 11))
        jacobian[:, 0] = -q
        jacobian[:, 1] = 1.0
        jacobian[:, 2:5] = -gain * (x[5:8] - q[:, None] * x[8:11])
        jacobian[:, 5:8] = gain * relative
        jacobian[:, 8:11] = -gain * q[:, None] * relative
        return jacobian

    def linear_start(self, sensor: str) -> Array:
        """Return the coefficients of the normalised linear solution, [5.5]."""
        first, second = dlt_matrix(self.points_mm, self.readings_px, sensor)
        length = np.sqrt(second[:3] @ second[:3])
        first, second = first / length, second / length
        p0 = first[:3] @ second[:3]
        along = first - p0 * second
        c = np.sqrt(along[:3] @ along[:3])
        along = along / c
        # Rows of a rotation: the point of the lens's axis nearest the origin.
        centre = -along[3] * along[:3] - second[3] * second[:3]
        return np.concatenate([[-c, p0], centre, along[:3], second[:3]])

    def squares(self, x: Array) -> float:
        """Return the sum of squares [px^2]."""
        values = self.values(x)
        return float(values @ values)


class Solver(Protocol):
    """Minimises one sensor's sum of squares."""

    def __call__(self, bundle: Bundle, start: Array, covariance: bool = False) -> "Minimum":
        """Minimise from ``start`` (11,), optionally with the coefficients' covariance."""
        ...


@dataclass(frozen=True, eq=False)
class Minimum:
    """Coefficients (11,), and their covariance (11, 11) without the gauge, if it was asked for."""

    x: Array
    covariance: Array | None


def variance(bundle: Bundle, squares: float) -> float:
    """Return the readings' variance as ours estimates it [px^2]: n - 7 - 2 in the denominator."""
    return squares / (len(bundle.readings_px) - RANK - 2)


def _of_slopes(bundle: Bundle, x: Array) -> Array:
    """Return the covariance from the Jacobian (19, 11) at the minimum, of rank 7."""
    _, singular, right = np.linalg.svd(bundle.slopes(x), full_matrices=False)
    known = right[:RANK] / singular[:RANK, None]
    return np.asarray(known.T @ known * variance(bundle, bundle.squares(x)))


def by_scipy(bundle: Bundle, start: Array, covariance: bool = False) -> Minimum:
    """Minimise by MINPACK's Levenberg-Marquardt."""
    found = least_squares(
        bundle.values, start, jac=bundle.slopes, method="lm", x_scale="jac",
        max_nfev=MAX_EVALUATIONS,
    )  # fmt: skip
    return Minimum(found.x, _of_slopes(bundle, found.x) if covariance else None)


def by_scipy_numerical(bundle: Bundle, start: Array, covariance: bool = False) -> Minimum:
    """Minimise likewise with a finite-difference Jacobian."""
    found = least_squares(
        bundle.values, start, method="lm", x_scale="jac", max_nfev=12 * MAX_EVALUATIONS
    )
    return Minimum(found.x, _of_slopes(bundle, found.x) if covariance else None)


def pyceres_solver() -> Solver:
    """Return a solver by pyceres.

    Raises:
        ImportError: it is not installed.
    """
    # Its annotations are not complete: to the type checker it is anything.
    pyceres: Any = import_module("pyceres")

    class Cost(pyceres.CostFunction):  # type: ignore[misc]
        """The residuals of one sensor."""

        def __init__(self, bundle: Bundle) -> None:
            pyceres.CostFunction.__init__(self)
            self.bundle = bundle
            self.set_num_residuals(len(bundle.readings_px))
            self.set_parameter_block_sizes([11])

        def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:  # noqa: N802
            x = np.asarray(parameters[0])
            values = self.bundle.values(x)
            if not np.isfinite(values).all():
                return False
            residuals[:] = values
            if jacobians is not None and jacobians[0] is not None:
                jacobians[0][:] = self.bundle.slopes(x).ravel()
            return True

    options = pyceres.SolverOptions()
    options.linear_solver_type = pyceres.LinearSolverType.DENSE_QR
    options.max_num_iterations = MAX_EVALUATIONS
    options.function_tolerance = 1e-12
    options.gradient_tolerance = 1e-12
    options.parameter_tolerance = 1e-12
    options.minimizer_progress_to_stdout = False
    options.logging_type = pyceres.LoggingType.SILENT
    options.num_threads = 1
    spread = pyceres.CovarianceOptions()
    spread.algorithm_type = pyceres.CovarianceAlgorithmType.DENSE_SVD
    spread.null_space_rank = 11 - RANK
    # Coefficients that ran along the gauge leave slopes of very unlike lengths.
    spread.min_reciprocal_condition_number = 1e-30
    spread.num_threads = 1

    def solve(bundle: Bundle, start: Array, covariance: bool = False) -> Minimum:
        x = start.copy()
        problem = pyceres.Problem()
        cost = Cost(bundle)
        problem.add_residual_block(cost, None, [x])
        summary = pyceres.SolverSummary()
        pyceres.solve(options, problem, summary)
        if not covariance:
            return Minimum(x, None)
        estimate = pyceres.Covariance(spread)
        if not estimate.compute([(x, x)], problem):
            return Minimum(x, None)
        block = np.asarray(estimate.get_covariance_block(x, x), dtype=np.float64)
        return Minimum(x, block * variance(bundle, 2.0 * summary.final_cost))

    return solve
