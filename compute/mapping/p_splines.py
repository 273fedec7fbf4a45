"""A penalised fit of one sensor's corrections, left-out errors included."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, cholesky, solve_triangular

Array = NDArray[np.float64]


_LEAST_PRECISION = 1e-12
GROSS_ERROR_THRESHOLD = 5.0
_MAD_TO_SIGMA = 1.4826  # standard deviation over the median of absolute normal errors
_BLOCK_RIDGE = 1e-9  # keeps a block that alone determines a function from an infinite error


@dataclass(frozen=True, eq=False)
class PenalisedProblem:
    """Weighted samples of a correction as a sum of functions, of which the first are penalised.

    Args:
        gram: B'B of the whitened functions at all samples, R penalised ones, then Q others,
            shape (R + Q, R + Q).
        product: B'y, y the whitened samples, shape (R + Q,).
        square: y'y.
        count: number of samples.
        others_precision: prior precisions of the Q functions that no smoothness touches; small
            where nothing is known of them, shape (Q,).
        functions, samples: of the blocks that are left out, block after block, whitened, shapes
            (T, R + Q) and (T,).
        sizes: of these blocks; they add up to T.
        known_variance: whether the variances that whitened the samples are known, or all have an
            unknown factor.
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
        # Where next to nothing is penalised, samples are too few to tell all functions apart.
        precision = np.maximum(precision, _LEAST_PRECISION * np.trace(self.gram))
        normal = self.gram + np.diag(precision)
        precision_factor = cholesky(normal, lower=True, check_finite=False)
        amounts = cho_solve((precision_factor, True), self.product, check_finite=False)
        return PenalisedFit(self, precision, precision_factor, amounts)


@dataclass(frozen=True, eq=False)
class PenalisedFit:
    """A fit and what it says of samples that it did not see.

    Args:
        problem: what was fitted.
        precision: prior precisions, shape (R + Q,).
        precision_factor: L with L L' = B'B + diag(precision), the posterior's precision.
        amounts: of the functions, shape (R + Q,).
    """

    problem: PenalisedProblem
    precision: Array
    precision_factor: Array
    amounts: Array

    def whitened_rows(self, functions: Array) -> Array:
        """Return B L'^-1 for rows of functions (n, R + Q); its rows' squares are variances."""
        half: Array = solve_triangular(
            self.precision_factor, functions.T, lower=True, check_finite=False
        ).T
        return half

    def variance(self, functions: Array) -> Array:
        """Return the posterior variances of sums with rows of functions (n, R + Q), shape (n,).

        The Bayesian covariance of a penalised fit (G. Wahba, Bayesian "confidence intervals" for
        the cross-validated smoothing spline, 1983, doi:10.1111/j.2517-6161.1983.tb01239.x).
        """
        squares: Array = (self.whitened_rows(functions) ** 2).sum(axis=1)
        return squares

    def covariance(self) -> Array:
        """Return the posterior covariance of the amounts, shape (R + Q, R + Q)."""
        half = solve_triangular(self.precision_factor, np.eye(len(self.amounts)), lower=True)
        covariance: Array = half.T @ half
        return covariance

    @property
    def effective_parameters(self) -> float:
        """Trace of the hat matrix."""
        inverse = solve_triangular(self.precision_factor, np.eye(len(self.amounts)), lower=True)
        return float(len(self.amounts) - (inverse**2 * self.precision).sum())

    @property
    def residual_sum_of_squares(self) -> float:
        """Sum of the squared whitened residuals."""
        here = self.amounts
        problem = self.problem
        square = problem.square - 2.0 * here @ problem.product + here @ problem.gram @ here
        return max(float(square), 0.0)

    def left_out(self) -> "LeftOutErrors":
        """Return the errors of samples in blocks that the fit did not see.

        With r the residuals and H the hat matrix's block, leaving the block out makes them
        (1 - H)^-1 r, of covariance (1 - H)^-1, as for single samples.
        """
        problem = self.problem
        half = self.whitened_rows(problem.functions)
        rest = problem.samples - problem.functions @ self.amounts
        error, sigma, standardised, whitened_rows = (np.empty_like(rest) for _ in range(4))
        first = np.cumsum(problem.sizes) - problem.sizes
        for size in np.unique(problem.sizes):
            # All blocks of one size at once.
            rows = first[problem.sizes == size, None] + np.arange(size)
            own = np.eye(size) * (1.0 + _BLOCK_RIDGE) - half[rows] @ half[rows].transpose(0, 2, 1)
            inverse = np.linalg.inv(np.linalg.cholesky(own))
            here = np.einsum("bij,bj->bi", inverse, rest[rows])
            standardised[rows] = here
            error[rows] = np.einsum("bji,bj->bi", inverse, here)
            sigma[rows] = np.sqrt((inverse**2).sum(axis=1))
            whitened_rows[rows] = 2.0 * np.log(np.diagonal(inverse, axis1=1, axis2=2))
        return LeftOutErrors(error, sigma, standardised, whitened_rows, problem.sizes)


@dataclass(frozen=True, eq=False)
class LeftOutErrors:
    """Errors of T samples, each predicted by a fit without its block; whitened.

    Args:
        error: sample less prediction, shape (T,).
        sigma: the standard deviations that they should have, shape (T,).
        standardised: the errors of each block made independent and of unit variance, if the model is
            right, shape (T,).
        log_variance: logarithms of the variances from which they were made so, shape (T,).
        sizes: of the blocks, shape (B,).
    """

    error: Array
    sigma: Array
    standardised: Array
    log_variance: Array
    sizes: NDArray[np.intp]

    def deviances(self, *, known_variance: bool) -> Array:
        """Return minus twice the log densities of the blocks, shape (B,), but for a constant.

        Without known variances all have one factor, the likeliest. No sample counts for more than
        one GROSS_ERROR_THRESHOLD deviations off, or as many of most of the errors: a single wrong measurement
        would have the whole field taken for rough.
        """
        usual = _scale(self.standardised)
        most = GROSS_ERROR_THRESHOLD * (max(usual, 1.0) if known_variance else usual)
        square = np.minimum(self.standardised**2, most**2)
        if not known_variance:
            square = square / square.mean() + np.log(square.mean())
        each = square + self.log_variance
        first = np.cumsum(self.sizes) - self.sizes
        blocks: Array = np.add.reduceat(each, first)
        return blocks

    @property
    def scale(self) -> float:
        """Factor of all standard deviations that makes the blocks likeliest."""
        most = GROSS_ERROR_THRESHOLD * _scale(self.standardised)
        return float(np.sqrt(np.minimum(self.standardised**2, most**2).mean()))


def _scale(standardised: Array) -> float:
    """Return the standard deviation of most of the errors."""
    return max(_MAD_TO_SIGMA * float(np.median(np.abs(standardised))), np.finfo(np.float64).tiny)
