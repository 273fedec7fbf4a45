"""CorrectionTable: corrections of readings as a function of the position in space."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter, NonFiniteValue
from compute.mapping.b_splines import b_spline_basis
from compute.mapping.grid import VoxelGrid

Array = NDArray[np.float64]

Degree = Literal[1, 3]

MAX_GROWTH_CELLS = 4.0
"""Distance from the box in which variances grow, in cells: to 81 times the standard deviation."""


@dataclass(frozen=True, eq=False)
class Corrections:
    """Corrections at N points for S sensors.

    Args:
        value_px: added to the readings, shape (N, S) [px].
        gradient_px_per_mm: their derivatives by the point, shape (N, S, 3) [px/mm].
        variance_px2: their variances, shape (N, S) [px^2].
        inside: whether measurements support them, shape (N, S).
        in_box: whether the point lies in the table's box, beyond which nothing says what the
            variances are, shape (N,).
    """

    value_px: Array
    gradient_px_per_mm: Array
    variance_px2: Array
    inside: NDArray[np.bool_]
    in_box: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class CorrectionTable:
    """Corrections of the readings of S sensors over a box of voxels.

    ``reading + correction(X)`` is the reading that the calibrated camera predicts for a marker at
    X: the correction is projection minus measurement, as the thesis recommends at the end of
    section 5.6 ("correction values should be derived from the measured and the projected
    differences for every part of the volume").

    Between the nodes it is a tensor product of B-splines with equal knots: of degree 1 the
    coefficients are the corrections at the cells' corners (trilinear interpolation), of degree 3
    each cell has 4 x 4 x 4 of them (C. de Boor, A Practical Guide to Splines, 1978,
    doi:10.1007/978-1-4612-6333-3). Beyond the box the splines go on as straight lines from its
    surface and are marked as not inside; the variance there is that of the surface times
    ``variance_growth``, which suffices for gates and weights and is no statement (``in_box``).

    Args:
        sensors: names of the sensors, in the calibration's order.
        calibration_hash: content hash of the calibration that the corrections belong to.
        grid: the voxels.
        degree: of the splines, 1 or 3.
        coefficients_px: shape (S, nx + degree, ny + degree, nz + degree) [px].
        variance_px2: of the correction at the cells' corners, interpolated linearly, shape
            (S, nx + 1, ny + 1, nz + 1) [px^2].
        valid: cells that measurements support, by sensor, shape (S, nx, ny, nz).

    Raises:
        InvalidParameter: shapes that do not fit, or a variance that is negative.
        NonFiniteValue: a coefficient or variance is not finite.
    """

    sensors: tuple[str, ...]
    calibration_hash: str
    grid: VoxelGrid
    degree: Degree
    coefficients_px: Array
    variance_px2: Array
    valid: NDArray[np.bool_]

    def __post_init__(self) -> None:
        if self.degree not in (1, 3):
            raise InvalidParameter(f"degree is {self.degree}; it must be 1 or 3")
        count = len(self.sensors)
        for name, more in (("coefficients_px", self.degree), ("variance_px2", 1), ("valid", 0)):
            shape = getattr(self, name).shape
            right = (count, *(cells + more for cells in self.grid.cells))
            if shape != right:
                raise InvalidParameter(
                    f"{name} has the shape {shape}; {count} sensors over {self.grid.cells} cells "
                    f"with degree {self.degree} need {right}"
                )
        for name in ("coefficients_px", "variance_px2"):
            bad = np.argwhere(~np.isfinite(getattr(self, name)))
            if len(bad):
                place = tuple(int(index) for index in bad[0])
                raise NonFiniteValue(
                    f"{name}{list(place)} is {getattr(self, name)[place]}, one of {len(bad)} that "
                    "are not finite; mark cells without measurements as not valid instead",
                    place=place,
                )
        negative = np.argwhere(self.variance_px2 < 0.0)
        if len(negative):
            place = tuple(int(index) for index in negative[0])
            raise InvalidParameter(
                f"variance_px2{list(place)} is {self.variance_px2[place]}; it must be 0 or more"
            )

    def at(self, points_mm: Array) -> Corrections:
        """Return the corrections at points (N, 3) [mm]; NaN points have none and are outside."""
        known = np.asarray(np.isfinite(points_mm).all(axis=1))
        at_mm = np.where(known[:, None], points_mm, 0.0)
        cell, cell_coordinate, inside = self.grid.locate(at_mm)
        steps = (at_mm - np.asarray(self.grid.origin_mm)) / np.asarray(self.grid.pitch_mm)
        beyond = steps - np.clip(steps, 0.0, self.grid.cells)
        value, gradient = self._evaluate_splines(cell, cell_coordinate, beyond)
        corner, _ = b_spline_basis(cell_coordinate, 1)
        variance = _tensor(self.variance_px2, cell, corner) * variance_growth(beyond)[:, None]
        in_box = inside & known
        valid = self.valid[:, cell[:, 0], cell[:, 1], cell[:, 2]].T & in_box[:, None]
        value[~known], gradient[~known], variance[~known] = np.nan, np.nan, np.nan
        return Corrections(value, gradient, variance, valid, in_box)

    def _evaluate_splines(
        self, cell: NDArray[np.intp], cell_coordinate: Array, beyond: Array
    ) -> tuple[Array, Array]:
        """Return the splines' values (N, S) and derivatives by the point (N, S, 3).

        Args:
            cell: indices of the cells, shape (N, 3).
            cell_coordinate: in the cell, from 0 to 1, shape (N, 3).
            beyond: what lies beyond the box along each axis, in cells, shape (N, 3).
        """
        weights, derivative_weights = b_spline_basis(cell_coordinate, self.degree)
        weights += derivative_weights * beyond[..., None]
        value = _tensor(self.coefficients_px, cell, weights)
        gradient = np.empty((*value.shape, 3))
        for axis in range(3):
            one = weights.copy()
            one[:, axis] = derivative_weights[:, axis]
            gradient[..., axis] = (
                _tensor(self.coefficients_px, cell, one) / self.grid.pitch_mm[axis]
            )
        return value, gradient


def variance_growth(beyond: Array) -> Array:
    """Return the factor of variances beyond the box, ``(1 + r^2 / 2)^4`` at r cells, shape (N,).

    It was chosen by ``lumiline reproduce map-outside``; r is at most MAX_GROWTH_CELLS.

    Args:
        beyond: distance to the box along each axis, in cells, shape (N, 3).
    """
    growth: Array = (1.0 + 0.5 * np.minimum((beyond**2).sum(axis=1), MAX_GROWTH_CELLS**2)) ** 4
    return growth


def _tensor(values: Array, cell: NDArray[np.intp], weights: Array) -> Array:
    """Return sums of (S, ...) values around cells (N, 3), weighted by (N, 3, D), shape (N, S)."""
    reach = np.arange(weights.shape[2])
    x, y, z = (cell[:, axis, None] + reach for axis in range(3))
    around = values[:, x[:, :, None, None], y[:, None, :, None], z[:, None, None, :]]
    total: Array = np.einsum(
        "snijk,ni,nj,nk->ns", around, weights[:, 0], weights[:, 1], weights[:, 2]
    )
    return total
