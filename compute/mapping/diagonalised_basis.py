"""DiagonalisedBasis: tensor B-splines in which a difference penalty is diagonal."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.mapping.b_splines import apply_along_axis, b_spline_basis
from compute.mapping.grid import VoxelGrid

Array = NDArray[np.float64]

DEGREE = 3
PENALTY_ORDER = 4
"""Order of the penalised differences; third ones over a single cell. The fields of lenses are
smooth: with second differences the same data need twice as many parameters."""
POLYNOMIAL_SHARE = 0.01
"""Penalty of polynomials, relative to the extrapolated penalties of oscillating functions."""


@dataclass(frozen=True, eq=False)
class DiagonalisedBasis:
    """The R smoothest eigenfunctions of a difference penalty on tensor B-splines.

    P-splines (P. H. C. Eilers and B. D. Marx, Flexible smoothing with B-splines and penalties,
    1996, doi:10.1214/ss/1038425655) with differences along each axis, ``penalty = sum_a w_a |D_a
    c|^2``. The sum is one of Kronecker products with unit matrices, so the eigenvectors of D'D
    along each axis diagonalise it for any weights of the axes (I. D. Currie, M. Durban, P. H. C.
    Eilers, 2006, doi:10.1111/j.1467-9868.2006.00543.x). The roughest functions can be dropped where
    data are too few to determine them (S. N. Wood, 2003, doi:10.1111/1467-9868.00374).

    Differences do not penalise polynomials along an axis; there are 4^3 products of them, more than
    few measurements determine. They get a share of the first oscillating function's penalty, lower
    by the power with which penalties grow with the number of oscillations; the constant gets that
    of the cheapest other function, so that a large weight removes the whole correction.

    Args:
        grid: the voxels.
        vectors: eigenvectors along each axis, shapes (K_a, K_a).
        costs: penalties along each axis, scaled to one length, shape (R, 3).
        function_index: index of the function along each axis, shape (R, 3).
    """

    grid: VoxelGrid
    vectors: tuple[Array, Array, Array]
    costs: Array
    function_index: NDArray[np.intp]

    @classmethod
    def of(cls, grid: VoxelGrid, max_functions: int) -> "DiagonalisedBasis":
        """Make the basis of a grid.

        Args:
            grid: the voxels.
            max_functions: largest number of functions.
        """
        unit = float(np.prod(grid.pitch_mm)) ** (1.0 / 3.0)
        vectors, values = [], []
        for cells, pitch in zip(grid.cells, grid.pitch_mm, strict=True):
            order = min(PENALTY_ORDER, cells + DEGREE - 1)
            difference = np.diff(np.eye(cells + DEGREE), n=order, axis=0)
            eigenvalues, eigenvectors = np.linalg.eigh(difference.T @ difference)
            vectors.append(eigenvectors)
            # Per length, not per cell, so that a finely divided axis has no larger weight.
            growth = (np.arange(order) / order) ** (2 * order)
            eigenvalues[:order] = POLYNOMIAL_SHARE * eigenvalues[order] * growth
            eigenvectors[:, :order] = _polynomials(cells + DEGREE, order)
            values.append(eigenvalues * (unit / pitch) ** (2 * order))
        index = np.indices([len(one) for one in values]).reshape(3, -1).T
        costs = np.stack([values[axis][index[:, axis]] for axis in range(3)], axis=1)
        smoothest = np.sort(np.argsort(costs.sum(axis=1), kind="stable")[:max_functions])
        first, second, third = vectors
        return cls(grid, (first, second, third), costs[smoothest], index[smoothest])

    def __len__(self) -> int:
        """Return the number of functions."""
        return len(self.function_index)

    def penalty(self, weights: Array) -> Array:
        """Return the functions' penalties, shape (R,), for weights of the axes (3,)."""
        total: Array = self.costs @ weights
        return np.asarray(np.maximum(total, total[total > 0.0].min()))

    def values(self, points_mm: Array) -> Array:
        """Evaluate the functions at points (N, 3), shape (N, R)."""
        cell, cell_coordinate, _ = self.grid.locate(points_mm)
        product = np.ones((len(points_mm), len(self)))
        for axis, eigenvectors in enumerate(self.vectors):
            weights, _ = b_spline_basis(cell_coordinate[:, axis], DEGREE)
            reach = cell[:, axis, None] + np.arange(DEGREE + 1)
            along = np.einsum("nd,ndk->nk", weights, eigenvectors[reach])
            product *= along[:, self.function_index[:, axis]]
        return product

    def coefficients(self, amounts: Array) -> Array:
        """Return the splines' coefficients (Kx, Ky, Kz) for coefficients (R,) of the functions."""
        full = np.zeros([len(eigenvectors) for eigenvectors in self.vectors])
        full[tuple(self.function_index.T)] = amounts
        for axis, eigenvectors in enumerate(self.vectors):
            full = apply_along_axis(eigenvectors, full, axis)
        return full


def _polynomials(count: int, order: int) -> Array:
    """Return orthonormal polynomials of degree 0 to order - 1 over equal steps, as columns."""
    powers = np.vander(np.linspace(-1.0, 1.0, count), order, increasing=True)
    return np.asarray(np.linalg.qr(powers)[0])
