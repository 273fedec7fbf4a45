"""Penalised least-squares fit of one sensor, with leave-one-block-out errors."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, cholesky, solve_triangular

from compute.robust_statistics import MAD_TO_SIGMA

Array = NDArray[np.float64]


_MIN_PRECISION = 1e-12
GROSS_ERROR_THRESHOLD = 5.0
_BLOCK_RIDGE = 1e-9  # keeps a block that alone determines a function from an infinite error


@dataclass(frozen=True, eq=False)
class PenalisedProblem:
    """Normal equations of weighted samples in R penalised and Q other functions.

    Args:
        gram: B'B of the whitened functions at all samples, shape (R + Q, R + Q).
        product: B'y, y the whitened samples, shape (R + Q,).
        square: y'y.
        count: number of samples.
        others_precision: prior precisions of the Q functions without a penalty, shape (Q,); small
            without prior knowledge.
        functions: whitened functions at the samples of left-out blocks, block after block,
            shape (T, R + Q).
        samples: the whitened samples there, shape (T,).
        sizes: sizes of these blocks; they add up to T.
        known_variance: False: the variances that whitened the samples have an unknown factor.
    """

    gram: Array
    product: Array
    square: float
    count: int
    others_precision: Array
    functions: Array
    samples: Array
    sizes: NDArray[np.intp]
    known_variance: bool = True

    def solve(self, penalty: Array) -> "PenalisedFit":
        """Fit with prior precisions (R,) of the penalised functions."""
        precision = np.concatenate([penalty, self.others_precision])
        # With a tiny penalty, samples may be too few to determine all functions.
        precision = np.maximum(precision, _MIN_PRECISION * np.trace(self.gram))
        normal = self.gram + np.diag(precision)
        precision_factor = cholesky(normal, lower=True, check_finite=False)
        amounts = cho_solve((precision_factor, True), self.product, check_finite=False)
        return PenalisedFit(self, precision, precision_factor, amounts)


@dataclass(frozen=True, eq=False)
class PenalisedFit:
    """A penalised fit with its posterior.

    Args:
        problem: the equations.
        precision: prior precisions, shape (R + Q,).
        precision_factor: L with L L' = B'B + diag(precision), the posterior precision.
        amounts: coefficients of the functions, shape (R + Q,).
    """

    problem: PenalisedProblem
    precision: Array
    precision_factor: Array
    amounts: Array

    def whitened_rows(self, functions: Array) -> Array:
        """Return B L'^-1 for rows (n, R + Q); the squares of its rows are variances."""
        half: Array = solve_triangular(
            self.precision_factor, functions.T, lower=True, check_finite=False
        ).T
        return half

    def variance(self, functions: Array) -> Array:
        """Return posterior variances of linear combinations with rows (n, R + Q), shape (n,).

        The Bayesian covariance of a penalised fit (G. Wahba, Bayesian "confidence intervals" for
        the cross-validated smoothing spline, 1983, doi:10.1111/j.2517-6161.1983.tb01239.x).
        """
        return np.asarray((self.whitened_rows(functions) ** 2).sum(axis=1))

    def covariance(self) -> Array:
        """Return the posterior covariance of the coefficients, shape (R + Q, R + Q)."""
        half = solve_triangular(self.precision_factor, np.eye(len(self.amounts)), lower=True)
        return np.asarray(half.T @ half)

    @property
    def effective_parameters(self) -> float:
        """Trace of the hat matrix."""
        inverse = solve_triangular(self.precision_factor, np.eye(len(self.amounts)), lower=True)
        return float(len(self.amounts) - (inverse**2 * self.precision).sum())

    @property
    def residual_sum_of_squares(self) -> float:
        """Sum of the squared whitened residuals."""
        amounts = self.amounts
        problem = self.problem
        square = problem.square - 2.0 * amounts @ problem.product + amounts @ problem.gram @ amounts
        return max(float(square), 0.0)

    def left_out(self) -> "LeftOutErrors":
        """Return the prediction errors of samples in left-out blocks.

        With r the residuals and H the hat matrix's block, leaving the block out makes them
        (1 - H)^-1 r, of covariance (1 - H)^-1, as for single samples.
        """
        problem = self.problem
        half = self.whitened_rows(problem.functions)
        rest = problem.samples - problem.functions @ self.amounts
        error, sigma, standardised, log_variance = (np.empty_like(rest) for _ in range(4))
        first = np.cumsum(problem.sizes) - problem.sizes
        for size in np.unique(problem.sizes):
            # All blocks of one size at once.
            rows = first[problem.sizes == size, None] + np.arange(size)
            hat_complement = np.eye(size) * (1.0 + _BLOCK_RIDGE) - half[rows] @ half[
                rows
            ].transpose(0, 2, 1)
            inverse = np.linalg.inv(np.linalg.cholesky(hat_complement))
            decorrelated = np.einsum("bij,bj->bi", inverse, rest[rows])
            standardised[rows] = decorrelated
            error[rows] = np.einsum("bji,bj->bi", inverse, decorrelated)
            sigma[rows] = np.sqrt((inverse**2).sum(axis=1))
            log_variance[rows] = 2.0 * np.log(np.diagonal(inverse, axis1=1, axis2=2))
        return LeftOutErrors(error, sigma, standardised, log_variance, problem.sizes)


@dataclass(frozen=True, eq=False)
class LeftOutErrors:
    """Whitened errors of T samples, each predicted by a fit without its block.

    Args:
        error: sample minus prediction, shape (T,).
        sigma: the standard deviations expected of them, shape (T,).
        standardised: the errors decorrelated within each block, of unit variance if the model is
            right, shape (T,).
        log_variance: log variances of that decorrelation, shape (T,).
        sizes: of the blocks, shape (B,).
    """

    error: Array
    sigma: Array
    standardised: Array
    log_variance: Array
    sizes: NDArray[np.intp]

    def deviances(self, *, known_variance: bool) -> Array:
        """Return minus twice the log densities of the blocks, shape (B,), up to a constant.

        Errors are clipped at GROSS_ERROR_THRESHOLD standard deviations (robust ones): otherwise a
        single wrong measurement would make the field appear rough.

        Args:
            known_variance: False: all variances have a common factor, set to its maximum-likelihood
                value.
        """
        robust_scale = _scale(self.standardised)
        most = GROSS_ERROR_THRESHOLD * (max(robust_scale, 1.0) if known_variance else robust_scale)
        square = np.minimum(self.standardised**2, most**2)
        if not known_variance:
            square = square / square.mean() + np.log(square.mean())
        each = square + self.log_variance
        first = np.cumsum(self.sizes) - self.sizes
        return np.asarray(np.add.reduceat(each, first))

    @property
    def scale(self) -> float:
        """Maximum-likelihood common factor of all standard deviations."""
        most = GROSS_ERROR_THRESHOLD * _scale(self.standardised)
        return float(np.sqrt(np.minimum(self.standardised**2, most**2).mean()))


def _scale(standardised: Array) -> float:
    """Return a robust standard deviation, from the median absolute value."""
    return max(MAD_TO_SIGMA * float(np.median(np.abs(standardised))), np.finfo(np.float64).tiny)
