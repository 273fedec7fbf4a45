"""TabulatedOptics: the light lines of points on real sensors, interpolated between exact traces.

A table holds, over both field angles and the inverse distance, each line's total light and its
quantiles: the readings below which given shares of the light lie. Between two lines of different
place and width, quantiles go over from one to the other as the lines do, which their heights at
given pixels do not.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import NdBSpline, make_interp_spline

from compute.errors import InvalidParameter
from compute.optics.footprints import Footprints
from compute.optics.line_optics.exact import Fineness, TracedLines
from compute.optics.line_optics.line_shape import CELLS, Blur, LineShapes
from compute.optics.line_optics.pixel_row import PixelRow
from compute.optics.line_optics.row_rays import Tracer
from compute.optics.line_optics.sensor import OpticalSensor
from compute.optics.tracing.assembly import Assembly
from compute.optics.tracing.trace import trace_rays

Array = NDArray[np.float64]

SHARES: Final = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 49))
"""Shares of the light below the tabulated quantiles; closer towards the tails."""

_Kind = tuple[Assembly, PixelRow]  # sensors of one kind share a table

_DEGREE: Final = 3
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
    """Numbers of nodes of a table along u, v and the inverse distance, each at least 4."""

    u: int = 25
    v: int = 13
    distance: int = 5

    def __post_init__(self) -> None:
        for name in ("u", "v", "distance"):
            value = getattr(self, name)
            if value < _DEGREE + 1:
                raise InvalidParameter(
                    f"{name} is {value} nodes; it must be at least {_DEGREE + 1}", **{name: value}
                )


class LineTable:
    """The tabulated lines of one kind of sensor.

    Args:
        lines: what traces them.
        field: the part of the field of view to tabulate.
        nodes: how finely.

    Raises:
        InvalidParameter: some part of the field sends no light to the row.
    """

    def __init__(self, lines: TracedLines, field: Field, nodes: Nodes | None = None) -> None:
        nodes = nodes or Nodes()
        self.field = field
        near, far = field.distance_mm
        axes = (
            np.linspace(*field.u, nodes.u),
            np.linspace(*field.v, nodes.v),
            np.linspace(1.0 / far, 1.0 / near, nodes.distance),
        )
        u, v, inverse = np.meshgrid(*axes, indexing="ij")
        z = 1.0 / inverse.ravel()
        shapes = lines.shapes(np.stack([u.ravel() * z, v.ravel() * z, z], axis=1))
        dark = shapes.total_sr == 0.0
        if dark.any():
            first = int(np.flatnonzero(dark)[0])
            raise InvalidParameter(
                f"no light reaches the row from u = {u.ravel()[first]:.3g}, "
                f"v = {v.ravel()[first]:.3g}, z = {z[first]:.4g} mm; take a smaller field",
                field=field,
            )
        # The light falls with the square of the distance: what is left is smooth.
        values = np.concatenate(
            [quantiles(shapes), (shapes.total_sr * z**2)[:, None]], axis=1
        ).reshape(*u.shape, -1)
        knots = []
        for axis, places in enumerate(axes):
            spline = make_interp_spline(places, values, k=_DEGREE, axis=axis)
            values = np.moveaxis(spline.c, 0, axis)
            knots.append(spline.t)
        self._spline = NdBSpline(tuple(knots), np.ascontiguousarray(values), _DEGREE)

    def __call__(self, seen_mm: Array) -> tuple[Array, Array]:
        """Interpolate for points (N, 3) of the field, in the sensor's frame [mm].

        Returns:
            Quantiles at SHARES, shape (N, K) [px], and the total light, shape (N,) [sr].
        """
        z = seen_mm[:, 2]
        place = np.stack([seen_mm[:, 0] / z, seen_mm[:, 1] / z, 1.0 / z], axis=1)
        found = self._spline(place)
        return found[:, :-1], np.maximum(found[:, -1], 0.0) / z**2


class TabulatedOptics:
    """The optics of S sensors by tables of exact traces: for live simulation.

    Points outside of a table's field are traced.

    Args:
        sensors: the sensors, in the device's order; those of one kind share a table.
        blur: emitter and wavelength.
        field: the part of each sensor's field of view to tabulate.
        nodes: how finely to tabulate.
        fineness: how finely to trace.
        tracer: what traces; NumPy's by default.

    Raises:
        InvalidParameter: some part of the field sends no light to the row.
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
        self._lines: dict[_Kind, TracedLines] = {}
        self._tables: dict[_Kind, LineTable] = {}
        self._of_kind: dict[_Kind, list[int]] = {}
        for number, sensor in enumerate(self._sensors):
            kind = (sensor.assembly, sensor.row)
            self._of_kind.setdefault(kind, []).append(number)
            if kind not in self._tables:
                self._lines[kind] = TracedLines(*kind, blur, fineness, tracer)
                self._tables[kind] = LineTable(self._lines[kind], field, nodes)

    def footprints(self, points_mm: Array) -> Footprints:
        """Return the footprints of points (N, 3) in the world frame [mm]."""
        count, total = len(points_mm), len(self._sensors)
        levels = np.empty((total, count, len(SHARES)))
        light = np.empty((total, count))
        for kind, numbers in self._of_kind.items():
            seen = np.concatenate(
                [self._sensors[number].in_sensor_frame(points_mm) for number in numbers]
            )
            found, strength = self._look_up(kind, seen)
            levels[numbers] = found.reshape(len(numbers), count, -1)
            light[numbers] = strength.reshape(len(numbers), count)
        first, window = windows(levels.reshape(-1, len(SHARES)), light.ravel())
        return Footprints(
            first.reshape(total, count).T, window.reshape(total, count, -1).transpose(1, 0, 2)
        )

    def _look_up(self, kind: _Kind, seen_mm: Array) -> tuple[Array, Array]:
        table = self._tables[kind]
        inside = table.field.contains(seen_mm)
        if inside.all():
            return table(seen_mm)
        levels = np.zeros((len(seen_mm), len(SHARES)))
        light = np.zeros(len(seen_mm))
        levels[inside], light[inside] = table(seen_mm[inside])
        shapes = self._lines[kind].shapes(seen_mm[~inside])
        levels[~inside], light[~inside] = quantiles(shapes), shapes.total_sr
        return levels, light


def quantiles(lines: LineShapes) -> Array:
    """Return the readings below which the SHARES of each line's light lie, shape (N, K) [px].

    The two ends are set so that each outermost piece has its own centre of gravity, and all are
    shifted together by what the pieces between, taken as even, lack of the whole line's; so the
    centroid of what is read from the table is the traced one. Zero for a dark line.
    """
    count, cells = lines.cell_sr.shape
    edges = np.arange(cells + 1) / CELLS - 0.5
    middles = 0.5 * (edges[1:] + edges[:-1])
    levels = np.zeros((count, len(SHARES)))
    for number in range(count):
        light = lines.cell_sr[number]
        total = light.sum()
        if total == 0.0:
            continue
        share = np.concatenate([[0.0], np.cumsum(light)]) / total
        moment = np.concatenate([[0.0], np.cumsum(light * middles)]) / total
        level = np.interp(SHARES, share, edges)
        at = np.interp(level, edges, moment)
        level[0] = 2.0 * (at[1] - at[0]) / SHARES[1] - level[1]
        level[-1] = 2.0 * (at[-1] - at[-2]) / (1.0 - SHARES[-2]) - level[-2]
        pieces = (np.diff(SHARES) * 0.5 * (level[1:] + level[:-1])).sum()
        levels[number] = lines.first_px[number] + level + (moment[-1] - pieces)
    return levels


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
