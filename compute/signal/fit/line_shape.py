"""Line shapes of a sensor by position, estimated from scans of a marker moved through the field."""

from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.parameter_checks import require
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.fit.line_samples import LineSamples, take_samples
from compute.signal.fit.line_spread_function import LineSpreadFunction
from compute.signal.pixel_corrections import PixelCorrections
from compute.signal.sensor_noise import SensorNoise

Array = NDArray[np.float64]

MIN_LINES: Final = 400
LINES_PER_NODE: Final = 200
"""Lines from which the shape at a place is known to a tenth of what a single line's noise is."""
MAX_NODES: Final = 16
KNOT_WIDTHS: Final = 0.5
"""Distance of the knots of a shape's spline, in the lines' standard deviations: half a pixel at
most."""
ROUGHNESS: Final = 3.0
"""Standard deviation of the shape's third differences, beside those of a Gaussian: weak, but pixels
as wide as the line leave some combinations of shape and sub-pixel positions open."""
CELLS_PER_PIXEL: Final = 16
MAX_ITERATIONS: Final = 20
CONVERGENCE_PART: Final = 1e-4
"""The estimate has ended when no cell's density moves by more than this part of the highest."""
OUTLIER_SIGMA: Final = 6.0
"""A line whose chi-square is this many of its deviations beyond the median is left out: a second
light in its window."""
MIN_WIDTH_PX: Final = 0.5
"""Sharper lines' shape and sub-pixel positions cannot be told apart."""


@dataclass(frozen=True, eq=False)
class LineShape:
    """Shape of the lines of one sensor at N nodes along it, as light in cells finer than pixels.

    The position of a line is its centre of gravity.

    Args:
        light: share of each cell, shape (N, C); the sum of a node is one.
        first_px: left edge of the first cell, from the line's position [px].
        step_px: width of a cell [px].
        first_node_px: position of the first node [px].
        node_step_px: distance of nodes [px].
        width_px: standard deviation of the lines, by the Gaussian that fits best [px].
        lines: number of lines that it was estimated from.
        reduced_chi2: misfit of these lines per degree of freedom.

    Raises:
        InvalidParameter: a shape or value outside its range.
    """

    light: Array
    first_px: float
    step_px: float
    first_node_px: float
    node_step_px: float
    width_px: float
    lines: int
    reduced_chi2: float

    def __post_init__(self) -> None:
        require(0.0 < self.width_px < np.inf, "be positive", width_px=self.width_px)
        LineSpreadFunction.from_cells(
            np.atleast_2d(self.light)[None],
            self.first_px,
            self.step_px,
            self.first_node_px,
            self.node_step_px,
        )

    @property
    def skewness(self) -> Array:
        """Third moment at each node over its standard deviation cubed, shape (N,)."""
        t = self.first_px + (np.arange(self.light.shape[1]) + 0.5) * self.step_px
        second, third = self.light @ t**2, self.light @ t**3
        return np.asarray(third / second**1.5)

    def to_document(self) -> dict[str, Any]:
        """Return it as a JSON object."""
        return {
            field.name: self.light.tolist() if field.name == "light" else getattr(self, field.name)
            for field in fields(self)
        }

    @classmethod
    def from_document(cls, document: dict[str, Any]) -> "LineShape":
        """Return the line shape of a JSON object.

        Raises:
            InvalidParameter: a field is missing, unknown, or of a wrong shape or value.
        """
        names = {field.name for field in fields(cls)}
        if set(document) != names:
            raise InvalidParameter(
                f"the line shape has the fields {sorted(document)}; it must have {sorted(names)}"
            )
        try:
            return cls(**(document | {"light": np.array(document["light"], dtype=np.float64)}))
        except (TypeError, ValueError) as error:
            raise InvalidParameter(f"the line shape holds a value of another type: {error}") from error


def estimate_line_shape(
    scans: NDArray[np.uint16],
    settings: FitSettings,
    noise: SensorNoise,
    corrections: PixelCorrections | None = None,
) -> LineShape:
    """Estimate a sensor's line shape by position from scans of one marker moved through the field.

    As effective point-spread functions are built in astronomy (J. Anderson and I. R. King,
    10.1086/316632), but in one least-squares problem: shapes at nodes along the sensor, linear
    between these, each a cubic spline of the sub-pixel position; and position, light and a sloped
    background of each line, eliminated (Schur complement). Each shape has the light one and its
    centre of gravity at zero.

    Args:
        scans: counts of the sensor, shape (F, P): one line in each, at all sub-pixel positions.
        settings: of the first fit, by a Gaussian.
        noise: of the sensor, one.
        corrections: of its pixels; None: counts are taken as they are.

    Raises:
        InvalidParameter: too few usable lines, or lines too sharp.
    """
    samples = take_samples(scans, settings, noise, corrections)
    if len(samples.position_px) < MIN_LINES:
        raise InvalidParameter(
            f"{len(samples.position_px)} of {len(scans)} scans have one clear line alone; there "
            f"must be {MIN_LINES} or more, {LINES_PER_NODE * MAX_NODES} for its change along the "
            "sensor: move one marker slowly through the field"
        )
    if samples.width_px < MIN_WIDTH_PX:
        raise InvalidParameter(
            f"the lines have a standard deviation of {samples.width_px:.2g} px; their shape can be "
            f"measured from {MIN_WIDTH_PX:g} px on: sharper ones' shape and sub-pixel positions "
            "cannot be told apart"
        )
    problem = _ShapeProblem(samples)
    for number in range(MAX_ITERATIONS):
        change = problem.step()
        if number in (2, 5):
            problem.drop_outliers()
        elif number > 5 and change < CONVERGENCE_PART:
            break
    return problem.result()


class _ShapeProblem:
    """Gauss-Newton for the shapes at all nodes; the lines' own parameters are eliminated."""

    def __init__(self, samples: LineSamples) -> None:
        self.samples = samples
        width = samples.width_px
        self.knot = min(KNOT_WIDTHS * width, 0.5)
        half = int(samples.reach_px / self.knot) - 1
        self.knots = np.arange(-half, half + 1) * self.knot
        low, high = samples.position_px.min(), samples.position_px.max()
        self.nodes = int(np.clip(len(samples.position_px) // LINES_PER_NODE, 2, MAX_NODES))
        self.first_node, self.node_step = low, (high - low) / (self.nodes - 1)
        gaussian = np.exp(-0.5 * (self.knots / width) ** 2)
        self.shapes = np.tile(gaussian / (gaussian.sum() * self.knot), (self.nodes, 1))
        # Third differences of a Gaussian's density reach this.
        roughness = ROUGHNESS * 0.55 * self.knot**3 / width**4
        difference = np.diff(np.eye(len(self.knots)), 3, axis=0) / roughness
        self.penalty = difference.T @ difference
        self.keep = np.ones(len(samples.position_px), bool)
        self.chi2 = np.zeros(len(samples.position_px))
        self.dof = np.ones(len(samples.position_px))

    def step(self) -> float:
        """Move shapes and lines; return the largest change of a shape, of its highest density."""
        samples, size = self.samples, len(self.knots)
        below, part = self._nodes_of(samples.position_px)
        t = samples.pixel_offset - samples.position_px[:, None]
        basis = self.knot * (
            _cumulative((t[..., None] + 0.5 - self.knots) / self.knot)
            - _cumulative((t[..., None] - 0.5 - self.knots) / self.knot)
        )
        own = (1.0 - part)[:, None] * self.shapes[below] + part[:, None] * self.shapes[below + 1]
        share = np.einsum("lwk,lk->lw", basis, own)
        edges = [
            np.einsum("lwk,lk->lw", _density((t[..., None] + at - self.knots) / self.knot), own)
            for at in (-0.5, 0.5)
        ]
        mean, weight = samples.predict(share)
        root = np.sqrt(weight)
        residual = (samples.values - mean) * root
        self.chi2 = np.sum(residual**2, axis=1)
        self.dof = np.maximum(samples.used.sum(axis=1) - 4.0, 1.0)
        light = samples.light[:, None]
        away = samples.pixel_offset - samples.centre[:, None]
        lines = np.stack([light * (edges[0] - edges[1]), share, np.ones_like(share), away], axis=2)
        lines *= root[..., None]
        rows = basis * (root * light)[..., None]
        gram = lines.transpose(0, 2, 1) @ lines
        scale = np.sqrt(np.maximum(np.einsum("lii->li", gram), 1e-300))
        inverse = np.linalg.inv(
            gram / (scale[:, :, None] * scale[:, None, :]) + 1e-12 * np.eye(4)
        ) / (scale[:, :, None] * scale[:, None, :])
        project = inverse @ lines.transpose(0, 2, 1)  # (L, 4, W)
        clear_rows = rows - lines @ (project @ rows)
        clear_residual = residual - np.einsum("lwa,law,lw->lw", lines, project, residual, optimize=True)

        total = self.nodes * size
        normal, right = np.zeros((total, total)), np.zeros(total)
        for node in range(self.nodes - 1):
            mine = self.keep & (below == node)
            near = (clear_rows[mine] * (1.0 - part[mine])[:, None, None]).reshape(-1, size)
            far = (clear_rows[mine] * part[mine][:, None, None]).reshape(-1, size)
            both, values = np.hstack([near, far]), clear_residual[mine].ravel()
            at = slice(node * size, (node + 2) * size)
            normal[at, at] += both.T @ both
            right[at] += both.T @ values
        for node in range(self.nodes):
            at = slice(node * size, (node + 1) * size)
            normal[at, at] += self.penalty
            right[at] -= self.penalty @ self.shapes[node]
        # Light one and centre of gravity zero at each node stay: two conditions on its change.
        conditions = np.kron(np.eye(self.nodes), np.stack([np.ones(size), self.knots]))
        count = len(conditions)
        whole = np.block([[normal, conditions.T], [conditions, np.zeros((count, count))]])
        change = np.linalg.solve(whole, np.append(right, np.zeros(count)))[:total]
        moved = change.reshape(self.nodes, size)
        self.shapes = self.shapes + moved
        own_change = (1.0 - part)[:, None] * moved[below] + part[:, None] * moved[below + 1]
        left = residual - np.einsum("lwk,lk->lw", rows, own_change)
        samples.move(np.einsum("law,lw->la", project, left))
        return float(np.max(np.abs(moved)) / np.max(self.shapes))

    def drop_outliers(self) -> None:
        """Leave out lines with another light in their window."""
        ratio = self.chi2 / self.dof
        middle = float(np.median(ratio[self.keep]))
        self.keep = ratio < middle * (1.0 + OUTLIER_SIGMA * np.sqrt(2.0 / self.dof))

    def result(self) -> LineShape:
        """Return the shapes as light in cells."""
        reach = np.ceil(self.samples.reach_px)
        edges = np.arange(-reach * CELLS_PER_PIXEL, reach * CELLS_PER_PIXEL + 1) / CELLS_PER_PIXEL
        below = self.knot * _cumulative((edges[:, None] - self.knots) / self.knot)
        light = np.maximum(np.diff(self.shapes @ below.T, axis=1), 0.0)
        light /= light.sum(axis=1, keepdims=True)
        keep = self.keep
        return LineShape(
            light,
            float(edges[0]),
            1.0 / CELLS_PER_PIXEL,
            float(self.first_node),
            float(self.node_step),
            float(self.samples.width_px),
            int(keep.sum()),
            float(self.chi2[keep].sum() / self.dof[keep].sum()),
        )

    def _nodes_of(self, position_px: Array) -> tuple[NDArray[np.intp], Array]:
        """Return the node below each line, and the part of the way to the next."""
        node = (position_px - self.first_node) / self.node_step
        below = np.clip(np.floor(node), 0, self.nodes - 2).astype(np.intp)
        return below, np.clip(node - below, 0.0, 1.0)


def _density(u: Array) -> Array:
    """Return the cardinal cubic B-spline about zero."""
    away = np.abs(u)
    inner = 2.0 / 3.0 - away**2 * (1.0 - 0.5 * away)
    outer = np.maximum(2.0 - away, 0.0) ** 3 / 6.0
    return np.where(away < 1.0, inner, outer)


def _cumulative(u: Array) -> Array:
    """Return the integral of the cardinal cubic B-spline from -2 to u."""
    v = np.clip(u, -2.0, 2.0)
    away = np.abs(v)
    inner = away * (2.0 / 3.0 - away**2 * (1.0 / 3.0 - 0.125 * away))
    outer = 0.5 - (2.0 - away) ** 4 / 24.0
    return np.asarray(0.5 + np.sign(v) * np.where(away < 1.0, inner, outer))


def device_line_shape(
    shapes: "list[LineShape | None]", default_width_px: float
) -> tuple[LineSpreadFunction, float]:
    """Return one line-spread function for all sensors of a device, and its unit [px].

    Nodes and cells are brought to one grid; a sensor without a shape has a Gaussian.

    Args:
        shapes: of the S sensors; None: not measured. One at least is.
        default_width_px: standard deviation of the lines of the others [px].
    """
    known = [one for one in shapes if one is not None]
    unit = float(np.mean([one.width_px for one in known]))
    reach = max(max(-one.first_px for one in known), np.ceil(6.0 * default_width_px))
    step = min(one.step_px for one in known)
    edges = np.arange(-round(reach / step), round(reach / step) + 1) * step
    low = min(one.first_node_px for one in known)
    high = max(one.first_node_px + (len(one.light) - 1) * one.node_step_px for one in known)
    node_step = min(one.node_step_px for one in known)
    nodes = max(int(np.ceil((high - low) / node_step)) + 1, 2)
    places = np.linspace(low, high, nodes)
    own = LineSpreadFunction.gaussian()
    light = np.empty((len(shapes), nodes, len(edges) - 1))
    for row, one in zip(light, shapes, strict=True):
        if one is None:
            row[:] = np.diff(own.at(edges / default_width_px)[0])
            continue
        function = LineSpreadFunction.from_cells(
            one.light[None], one.first_px, one.step_px, one.first_node_px, one.node_step_px
        )
        for number, place in enumerate(places):
            row[number] = np.maximum(np.diff(function.at(edges, 0, place)[0]), 0.0)
    function = LineSpreadFunction.from_cells(
        light, float(edges[0]), step, float(low), float(places[1] - places[0]), unit
    )
    return function, unit
