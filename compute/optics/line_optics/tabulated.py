"""TabulatedOptics: the light lines of points on real sensors, interpolated between exact traces.

A table holds, over both field angles and the inverse distance, each line's total light and its
quantiles: the readings below which given shares of the light lie. Between two lines of different
place and width, quantiles go over from one to the other as the lines do, which their heights at
given pixels do not.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import NdBSpline, make_interp_spline

from compute.errors import InvalidParameter
from compute.optics.footprints import Footprints
from compute.optics.line_optics.exact import Fineness, TracedLines
from compute.optics.line_optics.line_shape import CELLS, Blur, LineShapes
from compute.optics.line_optics.row_rays import Tracer
from compute.optics.line_optics.sensor import OpticalSensor
from compute.optics.pixel_row import PixelRow
from compute.optics.tracing.assembly import Assembly
from compute.optics.tracing.elements import Alignment
from compute.optics.tracing.trace import trace_rays

Array = NDArray[np.float64]

SHARES: Final = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 97))
"""Shares of the light below the tabulated quantiles; closer towards the tails."""

TABLE_FINENESS: Final = Fineness(17)
"""Rays of a fan for a table: within 1e-4 px of 257 for the built-in devices."""

_Kind = tuple[Assembly, PixelRow]  # sensors of one kind share a table

_DEGREE: Final = 3
_SHAPES: Final = 24  # principal components of the quantiles: what they leave is below 0.004 px RMS
_PIECES: Final = np.diff(SHARES)
_LINES_AT_ONCE: Final = 512
_OVERLAP_PX: Final = 2  # pixels of a window beyond the line's ends


@dataclass(frozen=True)
class Field:
    """The part of a sensor's field of view that is tabulated, in its frame.

    Args:
        u: least and largest x/z, along the row.
        v: least and largest y/z, along the lens's axis.
        distance_mm: least and largest z [mm], positive.

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

    def contains(self, seen_mm: Array) -> NDArray[np.bool_]:
        """Return which points (N, 3) of the sensor's frame [mm] lie in it, shape (N,)."""
        z = seen_mm[:, 2]
        inside = (z >= self.distance_mm[0]) & (z <= self.distance_mm[1])
        for (low, high), along in ((self.u, seen_mm[:, 0]), (self.v, seen_mm[:, 1])):
            inside &= (along >= low * z) & (along <= high * z)
        return inside


@dataclass(frozen=True)
class Nodes:
    """Numbers of nodes of a table, each at least 4.

    Args:
        u: along u, from end to end.
        v: along v from the middle to the end, in steps of v^2 where the optics are symmetric.
        distance: along the inverse distance.
    """

    u: int = 49
    v: int = 85
    distance: int = 9

    def __post_init__(self) -> None:
        for name in ("u", "v", "distance"):
            value = getattr(self, name)
            if value < (2 * _DEGREE + 1 if name == "u" else _DEGREE + 1):
                raise InvalidParameter(
                    f"{name} is {value} nodes; it must be at least {_DEGREE + 1}", **{name: value}
                )


class LineTable:
    """The tabulated lines of one kind of sensor.

    Args:
        lines: what traces them.
        field: the part of the field of view to tabulate.
        nodes: how finely.
    """

    def __init__(self, lines: TracedLines, field: Field, nodes: Nodes | None = None) -> None:
        nodes = nodes or Nodes()
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
        self._whole = _cells(lit.reshape(shape), all_of=True)
        self._dark = ~_cells(lit.reshape(shape), all_of=False)
        knots = []
        for axis, places in enumerate(axes):
            spline = make_interp_spline(places, values, k=_DEGREE, axis=axis)
            values = np.moveaxis(spline.c, 0, axis)
            knots.append(spline.t)
        self._spline = NdBSpline(tuple(knots), np.ascontiguousarray(values), _DEGREE)

    def __call__(self, seen_mm: Array) -> tuple[Array, Array]:
        """Look up points (N, 3) in the sensor's frame [mm].

        Points outside of the field, and those at the edge of what the row can see, are traced.

        Returns:
            Quantiles at SHARES, shape (N, K) [px], and the total light, shape (N,) [sr]; zero
            for a point that the row does not see.
        """
        in_field = self.field.contains(seen_mm)
        z = np.where(in_field, seen_mm[:, 2], 1.0)
        place = np.stack([seen_mm[:, 0] / z, seen_mm[:, 1] / z, 1.0 / z], axis=1)
        turned = np.zeros(len(place), dtype=np.bool_)
        if self._mirrored:
            turned = place[:, 0] < 0.0
            place[:, 0] = np.abs(place[:, 0])
            place[:, 1] *= place[:, 1]
        steps = (np.where(in_field[:, None], place, self._low) - self._low) / self._step
        cell = tuple(np.minimum(steps.astype(np.int64), np.array(self._whole.shape) - 1).T)
        whole = in_field & self._whole[cell]
        if whole.all():
            return self._interpolated(place, turned)
        levels, light = np.zeros((len(seen_mm), len(SHARES))), np.zeros(len(seen_mm))
        levels[whole], light[whole] = self._interpolated(place[whole], turned[whole])
        traced = ~whole & ~(in_field & self._dark[cell])
        if traced.any():
            shapes = self._lines.shapes(seen_mm[traced])
            levels[traced], light[traced] = quantiles(shapes), shapes.total_sr
        return levels, light

    def _interpolated(self, place: Array, turned: NDArray[np.bool_]) -> tuple[Array, Array]:
        found = self._spline(place)
        levels = self._basis.levels(found[:, :-1])
        light = np.maximum(found[:, -1], 0.0) * place[:, 2] ** 2
        if turned.any():
            levels[turned] = 2.0 * self._lines.row.middle_px - levels[turned, ::-1]
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
    def of(cls, levels_px: Array, lit: NDArray[np.bool_]) -> "_Basis":
        """Return the basis of the lines (N, K) that are lit, shape (N,)."""
        weights = np.sqrt(np.gradient(SHARES))
        seen = levels_px[lit] if lit.any() else levels_px
        mean = seen.mean(axis=0)
        weighted = (seen - mean) * weights
        _, vectors = np.linalg.eigh(weighted.T @ weighted)
        shapes = vectors[:, : -_SHAPES - 1 : -1].T / weights
        return cls(mean, np.vstack([shapes, np.ones(len(SHARES))]), weights)

    def coordinates(self, levels_px: Array) -> Array:
        """Return what lines (N, K) have of each shape, (N, C + 1); their centroids are kept."""
        parts = ((levels_px - self.mean_px) * self.weights**2) @ self.shapes[:-1].T
        left = levels_px - self.mean_px - parts @ self.shapes[:-1]
        return np.concatenate([parts, _centroid(left)[:, None]], axis=1)

    def levels(self, coordinates: Array) -> Array:
        """Return the quantiles of coordinates (N, C + 1), shape (N, K) [px]."""
        levels: Array = coordinates @ self.shapes + self.mean_px
        return levels


def _centroid(levels_px: Array) -> Array:
    """Return the centroids of lines that are even between their quantiles, shape (N,) [px]."""
    centroid: Array = (0.5 * (levels_px[:, 1:] + levels_px[:, :-1])) @ _PIECES
    return centroid


def _is_symmetric(assembly: Assembly) -> bool:
    """Return whether the optics are their own mirror image along x and along y."""
    straight = Alignment()
    elements = all(element.alignment == straight for element in assembly.elements)
    return elements and assembly.sensor_alignment == straight


@lru_cache(maxsize=8)
def _table(
    assembly: Assembly,
    row: PixelRow,
    blur: Blur,
    fineness: Fineness,
    tracer: Tracer,
    field: Field,
    nodes: Nodes | None,
) -> LineTable:
    """Return a table, kept for the next device of the kind: making one takes seconds."""
    return LineTable(TracedLines(assembly, row, blur, fineness, tracer), field, nodes)


def _continue_into_the_dark(places: Array, values: Array, lit: NDArray[np.bool_]) -> None:
    """Fill nodes without light by a polynomial through the others, so that the spline is smooth."""
    if lit.all() or not lit.any():
        return
    scaled = 2.0 * (places - places.min(axis=0)) / np.ptp(places, axis=0) - 1.0
    powers = [p for p in np.ndindex(*(_DEGREE + 2,) * 3) if sum(p) <= _DEGREE + 1]
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


class TabulatedOptics:
    """The optics of S sensors by tables of exact traces: for live simulation.

    Points outside of a table's field, and at the edge of what the row can see, are traced.

    Args:
        sensors: the sensors, in the device's order; those of one kind share a table.
        blur: emitter and wavelength.
        field: the part of each sensor's field of view to tabulate.
        nodes: how finely to tabulate.
        fineness: how finely to trace; None: TABLE_FINENESS.
        tracer: what traces; NumPy's by default.
    """

    def __init__(
        self,
        sensors: Sequence[OpticalSensor],
        blur: Blur,
        field: Field,
        nodes: Nodes | None = None,
        fineness: Fineness | None = None,
        tracer: Tracer = trace_rays,
    ) -> None:
        self._sensors = tuple(sensors)
        self._tables: dict[_Kind, LineTable] = {}
        self._of_kind: dict[_Kind, list[int]] = {}
        for number, sensor in enumerate(self._sensors):
            kind = (sensor.assembly, sensor.row)
            self._of_kind.setdefault(kind, []).append(number)
            if kind not in self._tables:
                self._tables[kind] = _table(
                    *kind, blur, fineness or TABLE_FINENESS, tracer, field, nodes
                )

    def footprints(self, points_mm: Array) -> Footprints:
        """Return the footprints of points (N, 3) in the world frame [mm]."""
        count, total = len(points_mm), len(self._sensors)
        levels, light = [], []
        for kind, numbers in self._of_kind.items():
            seen = np.concatenate(
                [self._sensors[number].in_sensor_frame(points_mm) for number in numbers]
            )
            found, strength = self._tables[kind](seen)
            levels.append(found)
            light.append(strength)
        first, window = windows(np.concatenate(levels), np.concatenate(light))
        # The sensors of a kind stand together: back into the device's order.
        order = np.argsort(np.concatenate(list(self._of_kind.values())))
        return Footprints(
            first.reshape(total, count)[order].T,
            window.reshape(total, count, -1)[order].transpose(1, 0, 2),
        )


def quantiles(lines: LineShapes) -> Array:
    """Return the readings below which the SHARES of each line's light lie, shape (N, K) [px].

    The two ends are set so that each outermost piece has its own centre of gravity, and all are
    shifted together by what the pieces between, taken as even, lack of the whole line's; so the
    centroid of what is read from the table is the traced one. Zero for a dark line.
    """
    levels = np.zeros((len(lines.cell_sr), len(SHARES)))
    lit = np.flatnonzero(lines.cell_sr.any(axis=1))
    for start in range(0, len(lit), _LINES_AT_ONCE):
        part = lit[start : start + _LINES_AT_ONCE]
        levels[part] = lines.first_px[part, None] + _quantiles(lines.cell_sr[part])
    return levels


def _quantiles(light: Array) -> Array:
    """Return the quantiles of lines (N, G) on the fine grid from the grid's first pixel, (N, K)."""
    edges = np.arange(light.shape[1] + 1) / CELLS - 0.5
    middles = 0.5 * (edges[1:] + edges[:-1])
    share, moment = np.zeros((2, len(light), len(edges)))
    np.cumsum(light, axis=1, out=share[:, 1:])
    np.cumsum(light * middles, axis=1, out=moment[:, 1:])
    total = share[:, -1:].copy()
    share /= total
    moment /= total
    # One interpolation for all lines, put behind one another.
    order = 2.0 * np.arange(len(light))[:, None]
    level = np.interp(
        (SHARES + order).ravel(), (share + order).ravel(), np.tile(edges, len(light))
    ).reshape(len(light), -1)
    place = (level + 0.5) * CELLS
    cell = np.minimum(place.astype(np.int64), light.shape[1] - 1)
    before = np.take_along_axis(moment, cell, axis=1)
    at = before + (place - cell) * (np.take_along_axis(moment, cell + 1, axis=1) - before)
    level[:, 0] = 2.0 * (at[:, 1] - at[:, 0]) / SHARES[1] - level[:, 1]
    level[:, -1] = 2.0 * (at[:, -1] - at[:, -2]) / (1.0 - SHARES[-2]) - level[:, -2]
    return np.asarray(level + (moment[:, -1] - _centroid(level))[:, None])


def windows(levels_px: Array, light_sr: Array) -> tuple[NDArray[np.int64], Array]:
    """Spread lines given by quantiles over pixels.

    Args:
        levels_px: quantiles at SHARES, shape (N, K) [px].
        light_sr: total light, shape (N,) [sr].

    Returns:
        Number of the first pixel of each window, shape (N,), and the light of its pixels, shape
        (N, W) [sr].
    """
    levels = np.maximum.accumulate(levels_px, axis=1)
    first = np.floor(levels[:, 0] + 0.5).astype(np.int64)
    width = int(np.ceil((levels[:, -1] - first).max(initial=0.0) + 0.5)) + _OVERLAP_PX
    edges = np.arange(width + 1) - 0.5
    # One interpolation for all lines, put behind one another.
    apart = width + 4.0
    shift = apart * np.arange(len(levels))[:, None]
    order = np.arange(len(levels))[:, None]
    share = np.interp(
        (edges + shift).ravel(),
        (levels - first[:, None] + shift).ravel(),
        (SHARES + order).ravel(),
    ).reshape(len(levels), -1)
    return first, np.diff(share, axis=1) * light_sr[:, None]
