"""Line-spread function: distribution of the light of a peak, by sensor and position."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PchipInterpolator
from scipy.special import ndtr

from compute.errors import InvalidParameter
from compute.parameter_checks import check_positive, require

Array = NDArray[np.float64]

GAUSSIAN_REACH: Final = 6.0
GAUSSIAN_STEP: Final = 1.0 / 16.0
"""Half the Gaussian's table and its step [deviations]: the cubic between is good to 1e-7."""


@dataclass(frozen=True, eq=False)
class LineSpreadFunction:
    """Cumulative share of a peak's light below a position, as a table with its derivative.

    A pixel i gets the share ``E((i + 1/2 - x) / w) - E((i - 1/2 - x) / w)`` of a line at x with
    the width w. Between the table's places E is the cubic through both values and both
    derivatives; outside of the table it is 0 or 1. Places t are in units of w: a Gaussian's are
    its standard deviations; a shape that was measured in pixels has w = 1 px.

    Between two nodes along the sensor both tables count, by distance; beyond the first and the
    last node these hold. The node is taken at the line's position, and its change with the
    position is not part of the derivative.

    Args:
        cumulative: share of the light below each place, S sensors (or one for all), N nodes, T
            places, shape (S, N, T); rising from 0 to 1.
        density: its derivative by t, same shape.
        first: the first place t.
        step: distance of places.
        first_node_px: where the first node is [px].
        node_step_px: distance of nodes [px]; any positive number where there is one node.
    """

    cumulative: Array
    density: Array
    first: float
    step: float
    first_node_px: float = 0.0
    node_step_px: float = 1.0

    def __post_init__(self) -> None:
        shape = self.cumulative.shape
        if len(shape) != 3 or shape[2] < 2 or 0 in shape or self.density.shape != shape:
            raise InvalidParameter(
                f"cumulative has the shape {shape} and density {self.density.shape}; both must "
                "be (S, N, T) with two places or more",
                cumulative=shape,
                density=self.density.shape,
            )
        if not (np.isfinite(self.cumulative).all() and np.isfinite(self.density).all()):
            raise InvalidParameter("cumulative or density hold a value that is not finite")
        check_positive(self, "step", "node_step_px")

    @classmethod
    def gaussian(cls) -> "LineSpreadFunction":
        """Return the Gaussian, the same for all sensors and places."""
        t = np.arange(-GAUSSIAN_REACH, GAUSSIAN_REACH + GAUSSIAN_STEP / 2, GAUSSIAN_STEP)
        # Nothing is left outside of the table.
        cumulative = (ndtr(t) - ndtr(t[0])) / (ndtr(t[-1]) - ndtr(t[0]))
        density = np.exp(-0.5 * t * t) / np.sqrt(2.0 * np.pi)
        return cls(cumulative[None, None], density[None, None], -GAUSSIAN_REACH, GAUSSIAN_STEP)

    @classmethod
    def from_cells(
        cls,
        light: ArrayLike,
        first: float,
        step: float,
        first_node_px: float = 0.0,
        node_step_px: float = 1.0,
        unit_px: float = 1.0,
    ) -> "LineSpreadFunction":
        """Make it from the light in cells finer than pixels.

        Args:
            light: light of each cell, shape (S, N, C), or (C,) for one sensor and place; zero or
                more. The first and last cell should hold next to nothing.
            first: left edge of the first cell, from the line's position [px].
            step: width of a cell [px]; 1/16 px is fine for lines of half a pixel's deviation.
            first_node_px: where the first node is [px].
            node_step_px: distance of nodes [px].
            unit_px: what a width is to be [px]: the line's deviation, so that the windows, which
                are cut by widths, hold it.

        Raises:
            InvalidParameter: another shape, a negative value, or no light.
        """
        cells = np.asarray(light, dtype=np.float64)
        if cells.ndim == 1:
            cells = cells[None, None]
        if cells.ndim != 3 or cells.shape[2] < 3:
            raise InvalidParameter(
                f"light has the shape {cells.shape}; it must be (S, N, C) or (C,) with 3 cells "
                "or more",
                light=cells.shape,
            )
        total = cells.sum(axis=2, keepdims=True)
        if not (np.isfinite(cells).all() and (cells >= 0.0).all() and (total > 0.0).all()):
            raise InvalidParameter(
                f"light has {float(np.min(cells))} at least and {float(np.min(total))} in the "
                "darkest line; it must be zero or more, with some light in each"
            )
        require(0.0 < step < np.inf, "be positive", step=step)
        require(0.0 < unit_px < np.inf, "be positive", unit_px=unit_px)
        first, step = first / unit_px, step / unit_px
        share = cells / total
        cumulative = np.concatenate([np.zeros_like(total), np.cumsum(share, axis=2)], axis=2)
        # At a cell's edge: the mean of the two cells' densities.
        density = np.zeros_like(cumulative)
        density[..., 1:-1] = (share[..., 1:] + share[..., :-1]) / (2.0 * step)
        return cls(cumulative, density, first, step, first_node_px, node_step_px)

    @classmethod
    def from_lines(
        cls,
        light: ArrayLike,
        first_px: ArrayLike,
        position_px: ArrayLike,
        cells_per_pixel: int,
        *,
        reach_px: float = 24.0,
        unit_px: float = 1.0,
    ) -> "LineSpreadFunction":
        """Make it, for one sensor, from lines at places all along it: traced or measured ones.

        As many nodes as there are lines, evenly from the first position to the last. Between two
        lines both count, by distance.

        Args:
            light: of N lines in cells finer than pixels, shape (N, G); zero or more.
            first_px: the pixels with which the cells begin, at their left edges, shape (N,).
            position_px: what is to be read where the line falls so: the line's centre of gravity,
                or the reading of a camera model, shape (N,); N different ones.
            cells_per_pixel: cells in a pixel.
            reach_px: light farther from the position is left out.
            unit_px: what a width is to be [px]; see ``from_cells``.

        Raises:
            InvalidParameter: shapes that do not agree, equal positions, a negative value, no light.
        """
        cells = np.asarray(light, dtype=np.float64)
        first, position = (np.asarray(each, dtype=np.float64) for each in (first_px, position_px))
        if cells.ndim != 2 or first.shape != (len(cells),) or position.shape != (len(cells),):
            raise InvalidParameter(
                f"light has the shape {cells.shape}, first_px {first.shape} and position_px "
                f"{position.shape}; they must be (N, G), (N,) and (N,)",
                light=cells.shape,
            )
        if cells_per_pixel < 1 or len(cells) == 0:
            raise InvalidParameter(
                f"there are {len(cells)} lines of {cells_per_pixel} cells in a pixel; both must be "
                "1 or more",
                cells_per_pixel=cells_per_pixel,
            )
        order = np.argsort(position)
        cells, first, position = cells[order], first[order], position[order]
        gaps = np.diff(position)
        if not (np.isfinite(position).all() and (gaps > 0.0).all()):
            raise InvalidParameter("position_px holds equal positions, or one that is not finite")
        step = 1.0 / cells_per_pixel
        away = np.arange(-round(reach_px / step), round(reach_px / step)) * step
        shares = np.empty((len(cells), len(away)))
        for number, line in enumerate(cells):
            edges = first[number] - 0.5 + np.arange(len(line) + 1) * step - position[number]
            below = PchipInterpolator(edges, np.concatenate([[0.0], np.cumsum(line)]))
            # Beyond the cells there is no light: all is below, or nothing.
            ends = np.clip(np.append(away, away[-1] + step), edges[0], edges[-1])
            shares[number] = np.maximum(np.diff(below(ends)), 0.0)
        nodes = np.linspace(position[0], position[-1], len(position))
        total = np.maximum(shares.sum(axis=1, keepdims=True), np.finfo(np.float64).tiny)
        even = np.stack([np.interp(nodes, position, one) for one in (shares / total).T], axis=1)
        node_step = float(nodes[1] - nodes[0]) if len(nodes) > 1 else 1.0
        return cls.from_cells(even[None], float(away[0]), step, float(nodes[0]), node_step, unit_px)

    @property
    def reach(self) -> float:
        """Half the table's length, in widths."""
        return 0.5 * self.step * float(self.cumulative.shape[2] - 1)

    def at(
        self, t: Array, sensor: ArrayLike = 0, position_px: ArrayLike = 0.0
    ) -> tuple[Array, Array]:
        """Return E and its derivative at any t, for lines at ``position_px`` on their sensors.

        Args:
            t: shape (...), in widths.
            sensor: numbers of the sensors, of a shape that broadcasts to t's.
            position_px: where the lines are, of a shape that broadcasts to t's [px].
        """
        sensors, nodes, cells = self.cumulative.shape
        row = np.asarray(sensor) % sensors * nodes
        node = (np.asarray(position_px, dtype=np.float64) - self.first_node_px) / self.node_step_px
        below = np.clip(np.floor(node), 0, max(nodes - 2, 0)).astype(np.int64)
        above = np.minimum(below + 1, nodes - 1)
        part = np.clip(node - below, 0.0, 1.0)

        cell = (np.asarray(t, dtype=np.float64) - self.first) / self.step
        k = np.clip(np.floor(cell), 0, cells - 2).astype(np.int64)
        s = np.clip(cell - k, 0.0, 1.0)

        def between(table: Array, at: NDArray[np.int64]) -> Array:
            values = table.ravel()
            interpolated: Array = values[(row + below) * cells + at]
            if nodes > 1:
                interpolated = (1.0 - part) * interpolated + part * values[
                    (row + above) * cells + at
                ]
            return interpolated

        e0, e1 = between(self.cumulative, k), between(self.cumulative, k + 1)
        d0, d1 = (between(self.density, at) * self.step for at in (k, k + 1))
        rise = e1 - e0
        square = d0 + d1 - 2.0 * rise
        linear = 3.0 * rise - 2.0 * d0 - d1
        value = e0 + s * (d0 + s * (linear + s * square))
        derivative = (d0 + s * (2.0 * linear + s * 3.0 * square)) / self.step
        outside = (cell < 0.0) | (cell > cells - 1)
        return value, np.where(outside, 0.0, derivative)
