"""DiagonalisedBasis: tensor B-splines over a grid, turned so that a difference penalty is diagonal."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.mapping.b_spline_basis import b_spline_basis
from compute.mapping.grid import VoxelGrid

Array = NDArray[np.float64]

DEGREE = 3
PENALTY_ORDER = 4
"""Of the differences that are penalised; over a single cell, third ones. The fields of lenses are
smooth: with second differences the same data take twice as many parameters."""
POLYNOMIAL_SHARE = 0.01
"""What polynomials cost of what the oscillating functions' costs would say for them."""


@dataclass(frozen=True, eq=False)
class DiagonalisedBasis:
    """The smoothest R of the tensor splines' functions, by their differences.

    P-splines (P. H. C. Eilers and B. D. Marx, Flexible smoothing with B-splines and penalties,
    1996, doi:10.1214/ss/1038425655) with differences along each axis, ``penalty = sum_a w_a
    |D_a c|^2``. The sum is one of Kronecker products with unit matrices, so the eigenvectors of
    D'D along each axis make it diagonal whatever the weights of the axes (I. D. Currie, M.
    Durban, P. H. C. Eilers, 2006, doi:10.1111/j.1467-9868.2006.00543.x). The roughest of
    these functions can be left out where data are too few to tell of them (S. N. Wood, 2003,
    doi:10.1111/1467-9868.00374).

    Along an axis the differences cost the first functions, polynomials, nothing; there are 4^3
    products of them, more than few measurements tell apart. So they are given a share of what the
    first oscillating function costs, less by the power with which the costs grow with the number
    of turns; and the constant what the cheapest of the others costs: as the penalty's weight
    grows, the correction goes to none.

    Args:
        grid: the voxels.
        vectors: eigenvectors along each axis, shapes (K_a, K_a).
        costs: their penalties, scaled to one length along all axes, shape (R, 3).
        function_index: index of the function along each axis, shape (R, 3).
    """

    grid: VoxelGrid
    vectors: tuple[Array, Array, Array]
    costs: Array
    function_index: NDArray[np.intp]

    @classmethod
    def of(cls, grid: VoxelGrid, max_functions: int) -> "DiagonalisedBasis":
        """Make the basis of at most ``max_functions`` functions."""
        unit = float(np.prod(grid.pitch_mm)) ** (1.0 / 3.0)
        vectors, values = [], []
        for cells, pitch in zip(grid.cells, grid.pitch_mm, strict=True):
            order = min(PENALTY_ORDER, cells + DEGREE - 1)
            difference = np.diff(np.eye(cells + DEGREE), n=order, axis=0)
            found, turned = np.linalg.eigh(difference.T @ difference)
            vectors.append(turned)
            # Per length and not per cell, so that no axis counts for being finely divided.
            growth = (np.arange(order) / order) ** (2 * order)
            found[:order] = POLYNOMIAL_SHARE * found[order] * growth
            turned[:, :order] = _polynomials(cells + DEGREE, order)
            values.append(found * (unit / pitch) ** (2 * order))
        index = np.indices([len(one) for one in values]).reshape(3, -1).T
        costs = np.stack([values[axis][index[:, axis]] for axis in range(3)], axis=1)
        smoothest = np.sort(np.argsort(costs.sum(axis=1), kind="stable")[:max_functions])
        first, second, third = vectors
        return cls(grid, (first, second, third), costs[smoothest], index[smoothest])

    def __len__(self) -> int:
        """Return the number of functions."""
        return len(self.function_index)

    def penalty(self, weights: Array) -> Array:
        """Return the functions' penalties with weights of the axes (3,), shape (R,)."""
        total: Array = self.costs @ weights
        raised: Array = np.maximum(total, total[total > 0.0].min())
        return raised

    def values(self, points_mm: Array) -> Array:
        """Return the functions at points (N, 3), shape (N, R)."""
        cell, cell_coordinate, _ = self.grid.locate(points_mm)
        product = np.ones((len(points_mm), len(self)))
        for axis, turned in enumerate(self.vectors):
            weights, _ = b_spline_basis(cell_coordinate[:, axis], DEGREE)
            reach = cell[:, axis, None] + np.arange(DEGREE + 1)
            along = np.einsum("nd,ndk->nk", weights, turned[reach])
            product *= along[:, self.function_index[:, axis]]
        return product

    def coefficients(self, amounts: Array) -> Array:
        """Return the splines' coefficients (Kx, Ky, Kz) for amounts (R,) of the functions."""
        full = np.zeros([len(turned) for turned in self.vectors])
        full[tuple(self.function_index.T)] = amounts
        for axis, turned in enumerate(self.vectors):
            full = np.moveaxis(np.tensordot(turned, full, axes=(1, axis)), 0, axis)
        return full


def _polynomials(count: int, order: int) -> Array:
    """Return orthonormal polynomials of degree 0 to order - 1 over equal steps, as columns."""
    powers = np.vander(np.linspace(-1.0, 1.0, count), order, increasing=True)
    orthonormal: Array = np.linalg.qr(powers)[0]
    return orthonormal
