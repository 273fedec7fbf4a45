"""Table of the stripes of one kind of sensor, interpolated between exact traces.

A table holds, over both field angles and the inverse distance, each line's total light and its
quantiles: the readings below which given shares of the light lie. Between two lines of different
position and width, quantiles go over from one to the other as the lines do, which their heights at
given pixels do not.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import NdBSpline, make_interp_spline

from compute.errors import InvalidParameter
from compute.optics.stripe_optics.stripe_quantiles import (
    QUANTILE_LEVELS,
    centroid_of_quantiles,
    quantiles,
)
from compute.optics.stripe_optics.traced_stripes import TracedStripes
from compute.optics.tracing.assembly import Alignment, Assembly
from compute.parameter_checks import require

Array = NDArray[np.float64]

DEGREE: Final = 3
"""Degree of the splines between the nodes."""


@dataclass(frozen=True)
class FieldOfView:
    """Tabulated part of a sensor's field of view, in its frame.

    Args:
        u: smallest and largest x/z, along the row.
        v: smallest and largest y/z, along the lens's axis.
        distance_mm: smallest and largest z [mm], positive.

    Raises:
        InvalidParameter: an interval that is empty or not finite, a distance not positive.
    """

    u: tuple[float, float]
    v: tuple[float, float]
    distance_mm: tuple[float, float]

    def __post_init__(self) -> None:
        for name in ("u", "v", "distance_mm"):
            low, high = getattr(self, name)
            if not (np.isfinite([low, high]).all() and low < high):
                raise InvalidParameter(
                    f"{name} is {low} to {high}; it must be a finite interval",
                    **{name: (low, high)},
                )
        if self.distance_mm[0] <= 0.0:
            raise InvalidParameter(
                f"distance_mm begins at {self.distance_mm[0]}; it must be positive",
                distance_mm=self.distance_mm,
            )

    def contains(self, points_mm: Array) -> NDArray[np.bool_]:
        """Return which points (N, 3) of the sensor's frame [mm] lie in it, shape (N,)."""
        z = points_mm[:, 2]
        inside = (z >= self.distance_mm[0]) & (z <= self.distance_mm[1])
        for (low, high), along in ((self.u, points_mm[:, 0]), (self.v, points_mm[:, 1])):
            inside &= (along >= low * z) & (along <= high * z)
        return inside


@dataclass(frozen=True)
class TableNodes:
    """Numbers of nodes of a table, at least 7 along u and 4 along the other axes.

    Args:
        u: along u, from end to end.
        v: along v from the centre to the end, in steps of v^2 where the optics are symmetric.
        distance: along the inverse distance.
    """

    u: int = 49
    v: int = 85
    distance: int = 9

    def __post_init__(self) -> None:
        for name in ("u", "v", "distance"):
            value = getattr(self, name)
            lowest = 2 * DEGREE + 1 if name == "u" else DEGREE + 1  # half of u may be tabulated
            require(value >= lowest, f"be at least {lowest} nodes", **{name: value})


_SHAPES: Final = 24  # principal components of the quantiles: what they leave is below 0.004 px RMS


class StripeTable:
    """Tabulated stripes of one kind of sensor.

    Args:
        lines: what traces them.
        field: the part of the field of view to tabulate.
        nodes: how finely.
    """

    def __init__(
        self, lines: TracedStripes, field: FieldOfView, nodes: TableNodes | None = None
    ) -> None:
        nodes = nodes or TableNodes()
        self.field = field
        self._lines = lines
        # Optics that are their own mirror image need a quarter of the field, and their lines
        # change with the square of v: a skew ray meets a steeper lens.
        self._mirrored = _is_symmetric(lines.assembly)
        near, far = field.distance_mm
        if self._mirrored:
            across = np.linspace(0.0, max(abs(field.u[0]), abs(field.u[1])), (nodes.u + 1) // 2)
            along = np.linspace(0.0, max(field.v[0] ** 2, field.v[1] ** 2), nodes.v)
            slopes = np.sqrt(along)
        else:
            across = np.linspace(*field.u, nodes.u)
            along = slopes = np.linspace(*field.v, 2 * nodes.v - 1)
        inverse = np.linspace(1.0 / far, 1.0 / near, nodes.distance)
        axes = (across, along, inverse)
        u, v, w = (values.ravel() for values in np.meshgrid(across, slopes, inverse, indexing="ij"))
        shape = tuple(len(axis) for axis in axes)
        shapes = lines.shapes(np.stack([u / w, v / w, 1.0 / w], axis=1))
        lit = shapes.total_sr > 0.0
        levels = quantiles(shapes)
        self._basis = _Basis.of(levels, lit)
        # The light falls with the square of the distance: what is left is smooth.
        values = np.concatenate(
            [self._basis.coordinates(levels), (shapes.total_sr / w**2)[:, None]], axis=1
        )
        _continue_into_the_dark(np.stack([u, v, w], axis=1), values, lit)
        values = values.reshape(*shape, -1)
        self._low = np.array([axis[0] for axis in axes])
        self._step = np.array([axis[1] - axis[0] for axis in axes])
        self._all_lit = _cells(lit.reshape(shape), all_of=True)
        self._dark = ~_cells(lit.reshape(shape), all_of=False)
        knots = []
        for axis, ticks in enumerate(axes):
            spline = make_interp_spline(ticks, values, k=DEGREE, axis=axis)
            values = np.moveaxis(spline.c, 0, axis)
            knots.append(spline.t)
        self._spline = NdBSpline(tuple(knots), np.ascontiguousarray(values), DEGREE)

    def __call__(self, points_mm: Array) -> tuple[Array, Array]:
        """Look up points (N, 3) in the sensor's frame [mm].

        Points outside of the field, and those at the edge of what the row can see, are traced.

        Returns:
            Quantiles at QUANTILE_LEVELS, shape (N, K) [px], and the total light, shape (N,) [sr];
            zero for a point that the row does not see.
        """
        in_field = self.field.contains(points_mm)
        z = np.where(in_field, points_mm[:, 2], 1.0)
        coordinates = np.stack([points_mm[:, 0] / z, points_mm[:, 1] / z, 1.0 / z], axis=1)
        mirrored = np.zeros(len(coordinates), dtype=np.bool_)
        if self._mirrored:
            mirrored = coordinates[:, 0] < 0.0
            coordinates[:, 0] = np.abs(coordinates[:, 0])
            coordinates[:, 1] *= coordinates[:, 1]
        steps = (np.where(in_field[:, None], coordinates, self._low) - self._low) / self._step
        cell = tuple(np.minimum(steps.astype(np.int64), np.array(self._all_lit.shape) - 1).T)
        complete = in_field & self._all_lit[cell]
        if complete.all():
            return self._interpolate(coordinates, mirrored)
        levels, light = np.zeros((len(points_mm), len(QUANTILE_LEVELS))), np.zeros(len(points_mm))
        levels[complete], light[complete] = self._interpolate(
            coordinates[complete], mirrored[complete]
        )
        traced = ~complete & ~(in_field & self._dark[cell])
        if traced.any():
            shapes = self._lines.shapes(points_mm[traced])
            levels[traced], light[traced] = quantiles(shapes), shapes.total_sr
        return levels, light

    def _interpolate(self, coordinates: Array, mirrored: NDArray[np.bool_]) -> tuple[Array, Array]:
        coefficients = self._spline(coordinates)
        levels = self._basis.levels(coefficients[:, :-1])
        light = np.maximum(coefficients[:, -1], 0.0) * coordinates[:, 2] ** 2
        if mirrored.any():
            levels[mirrored] = 2.0 * self._lines.row.centre_px - levels[mirrored, ::-1]
        return levels, light


@dataclass(frozen=True, eq=False)
class _Basis:
    """Principal components of lines' quantiles: 25 numbers say what 97 would, four times as fast.

    Args:
        mean_px: mean quantiles, shape (K,) [px].
        shapes: components, and an even shift last, shape (C + 1, K).
        weights: of the quantiles in the components, shape (K,).
    """

    mean_px: Array
    shapes: Array
    weights: Array

    @classmethod
    def of(cls, quantiles_px: Array, lit: NDArray[np.bool_]) -> "_Basis":
        """Return the basis of the lines (N, K) that are lit, shape (N,)."""
        weights = np.sqrt(np.gradient(QUANTILE_LEVELS))
        lit_quantiles = quantiles_px[lit] if lit.any() else quantiles_px
        mean = lit_quantiles.mean(axis=0)
        weighted = (lit_quantiles - mean) * weights
        _, vectors = np.linalg.eigh(weighted.T @ weighted)
        shapes = vectors[:, : -_SHAPES - 1 : -1].T / weights
        return cls(mean, np.vstack([shapes, np.ones(len(QUANTILE_LEVELS))]), weights)

    def coordinates(self, quantiles_px: Array) -> Array:
        """Return what lines (N, K) have of each shape, (N, C + 1); their centroids are kept."""
        parts = ((quantiles_px - self.mean_px) * self.weights**2) @ self.shapes[:-1].T
        residual = quantiles_px - self.mean_px - parts @ self.shapes[:-1]
        return np.concatenate([parts, centroid_of_quantiles(residual)[:, None]], axis=1)

    def levels(self, coordinates: Array) -> Array:
        """Return the quantiles of coordinates (N, C + 1), shape (N, K) [px]."""
        levels: Array = coordinates @ self.shapes + self.mean_px
        return levels


def _is_symmetric(assembly: Assembly) -> bool:
    """Return whether the optics are their own mirror image along x and along y."""
    straight = Alignment()
    elements = all(element.alignment == straight for element in assembly.elements)
    return elements and assembly.sensor_alignment == straight


def _continue_into_the_dark(coordinates: Array, values: Array, lit: NDArray[np.bool_]) -> None:
    """Fill nodes without light by a polynomial through the others, so that the spline is smooth."""
    if lit.all() or not lit.any():
        return
    scaled = 2.0 * (coordinates - coordinates.min(axis=0)) / np.ptp(coordinates, axis=0) - 1.0
    powers = [p for p in np.ndindex(*(DEGREE + 2,) * 3) if sum(p) <= DEGREE + 1]
    terms = np.stack([np.prod(scaled ** np.array(power), axis=1) for power in powers], axis=1)
    fitted, *_ = np.linalg.lstsq(terms[lit], values[lit], rcond=None)
    values[~lit] = terms[~lit] @ fitted


def _cells(lit: NDArray[np.bool_], *, all_of: bool) -> NDArray[np.bool_]:
    """Return for each cell between nodes whether all, or any, nodes about it are lit.

    About it: its eight corners and their neighbours, on which the spline in the cell leans.
    """
    about = (4, 4, 4)
    padded = np.pad(lit, 1, mode="edge")
    windows_of = np.lib.stride_tricks.sliding_window_view(padded, about)
    axes = (3, 4, 5)
    return np.asarray(windows_of.all(axis=axes) if all_of else windows_of.any(axis=axes))
