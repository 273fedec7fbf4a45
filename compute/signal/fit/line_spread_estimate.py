"""Line-spread function of a sensor by position, estimated from scans of a moved marker."""

from typing import Final

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.fit.line_samples import LineSamples, take_samples
from compute.signal.measured_line_spread import MeasuredLineSpread
from compute.signal.pixel_corrections import PixelCorrections
from compute.signal.sensor_noise import SensorNoise

Array = NDArray[np.float64]

MIN_LINES: Final = 400
FIELD_DEGREE: Final = 7
"""Degree of the polynomials by which a shape changes along the sensor: aberrations are low powers
of the field."""
NODES: Final = 17
"""Places along the sensor at which shapes are kept."""
MAX_GAP_PART: Final = 0.15
"""Largest part of the way along the sensor without a line: the shape there would be a guess."""
KNOT_WIDTHS: Final = 0.4
"""Distance of the knots of a shape's spline, in the lines' standard deviations."""
ROUGHNESS: Final = 1.0
"""Standard deviation of the shape's third differences, beside those of a Gaussian: weak, but pixels
as wide as the line leave some combinations of shape and sub-pixel positions open."""
TAIL_WIDTHS: Final = 2.5
"""Beyond so many widths a shape is smoother, as the cube of the distance: it has a tail there."""
CELLS_PER_PIXEL: Final = 16
MAX_ITERATIONS: Final = 20
CONVERGENCE_PART: Final = 1e-4
"""The estimate has ended when no cell's density moves by more than this part of the highest."""
OUTLIER_SIGMA: Final = 6.0
"""A line whose chi-square is this many of its deviations beyond the median is left out: a second
light in its window."""
_PART: Final = 256
MIN_WIDTH_PX: Final = 0.5
"""Sharper lines' shape and sub-pixel positions cannot be told apart."""


def estimate_line_spread(
    scans: NDArray[np.uint16],
    settings: FitSettings,
    noise: SensorNoise,
    corrections: PixelCorrections | None = None,
) -> MeasuredLineSpread:
    """Estimate a sensor's line-spread function by position from scans of a moved marker.

    As effective point-spread functions are built in astronomy (J. Anderson and I. R. King,
    10.1086/316632), but in one least-squares problem: a shape that changes along the sensor by
    polynomials, a cubic spline of the sub-pixel position; and position, light and background of
    each line, eliminated (Schur complement). A slope of the background is that of the surroundings.
    Each shape has the light one and its
    centre of gravity at zero.

    Args:
        scans: counts of the sensor, shape (F, P): one line in each, at all sub-pixel positions.
        settings: of the first fit, by a Gaussian.
        noise: of the sensor, one.
        corrections: of its pixels; None: counts are taken as they are.

    Raises:
        InvalidParameter: too few usable lines, lines too sharp, or a gap between them.
    """
    samples = take_samples(scans, settings, noise, corrections)
    if len(samples.position_px) < MIN_LINES:
        raise InvalidParameter(
            f"{len(samples.position_px)} of {len(scans)} scans have one clear line alone; there "
            f"must be {MIN_LINES} or more, better ten times as many: move one marker slowly "
            "through the field"
        )
    if samples.width_px < MIN_WIDTH_PX:
        raise InvalidParameter(
            f"the lines have a standard deviation of {samples.width_px:.2g} px; their shape can be "
            f"measured from {MIN_WIDTH_PX:g} px on: sharper ones' shape and sub-pixel positions "
            "cannot be told apart"
        )
    positions = np.sort(samples.position_px)
    gaps = np.diff(positions)
    widest = int(np.argmax(gaps))
    if gaps[widest] > MAX_GAP_PART * (positions[-1] - positions[0]):
        raise InvalidParameter(
            f"no line lies between pixels {positions[widest]:.0f} and {positions[widest + 1]:.0f}; "
            f"the lines lie in {positions[0]:.0f} to {positions[-1]:.0f}, and no gap may be more "
            f"than {MAX_GAP_PART:.0%} of that: move the marker evenly through the field"
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
    """Gauss-Newton for the shapes along the sensor; the lines' own parameters are eliminated."""

    def __init__(self, samples: LineSamples) -> None:
        self.samples = samples
        width = samples.width_px
        self.knot = KNOT_WIDTHS * width
        half = int(samples.reach_px / self.knot) - 1
        self.knots = np.arange(-half, half + 1) * self.knot
        self.low, self.high = float(samples.position_px.min()), float(samples.position_px.max())
        gaussian = np.exp(-0.5 * (self.knots / width) ** 2)
        self.shapes = np.zeros((FIELD_DEGREE + 1, len(self.knots)))
        """Coefficients of Legendre polynomials along the sensor, by knot."""
        self.shapes[0] = gaussian / (gaussian.sum() * self.knot)
        # Third differences of a Gaussian's density reach this.
        roughness = ROUGHNESS * 0.55 * self.knot**3 / width**4
        centres = self.knots[1:-2] + 0.5 * self.knot
        local = roughness / (1.0 + (np.abs(centres) / (TAIL_WIDTHS * width)) ** 3)
        difference = np.diff(np.eye(len(self.knots)), 3, axis=0) / local[:, None]
        self.penalty = difference.T @ difference
        self.keep = np.ones(len(samples.position_px), bool)
        self.chi2 = np.zeros(len(samples.position_px))
        self.dof = np.ones(len(samples.position_px))

    def step(self) -> float:
        """Move shapes and lines; return the largest change of a shape, of its highest density."""
        samples, orders, size = self.samples, len(self.shapes), len(self.knots)
        total = orders * size
        normal, right = np.zeros((total, total)), np.zeros(total)
        field = self._field(samples.position_px)
        parts = np.array_split(np.arange(len(field)), 1 + len(field) // _PART)
        projected = []
        for lines in parts:
            rows, jacobian, residual = self._linearise(lines, field[lines])
            gram = jacobian.transpose(0, 2, 1) @ jacobian
            project = np.linalg.solve(gram, jacobian.transpose(0, 2, 1))
            projected.append((rows, project, residual))
            keep = self.keep[lines]
            clear = (rows - jacobian @ (project @ rows))[keep]
            residual_rest = residual - np.einsum(
                "lwa,law,lw->lw", jacobian, project, residual, optimize=True
            )
            pairs = (field[lines][keep][:, :, None] * field[lines][keep][:, None, :]).reshape(
                -1, orders * orders
            )
            squares = (clear.transpose(0, 2, 1) @ clear).reshape(-1, size * size)
            blocks = (pairs.T @ squares).reshape(orders, orders, size, size)
            normal += blocks.transpose(0, 2, 1, 3).reshape(total, total)
            right += (
                field[lines][keep].T @ np.einsum("lwk,lw->lk", clear, residual_rest[keep])
            ).ravel()
        for order in range(orders):
            at = slice(order * size, (order + 1) * size)
            stiff = self.penalty * (orders / (2.0 * order + 1.0))
            normal[at, at] += stiff
            right[at] -= stiff @ self.shapes[order]
        # Light one and centre of gravity zero everywhere stay: two conditions on each order.
        conditions = np.kron(np.eye(orders), np.stack([np.ones(size), self.knots]))
        count = len(conditions)
        bordered = np.block([[normal, conditions.T], [conditions, np.zeros((count, count))]])
        change = np.linalg.solve(bordered, np.append(right, np.zeros(count)))[:total]
        moved = change.reshape(orders, size)
        self.shapes = self.shapes + moved
        own_steps = [
            np.einsum("law,lw->la", project, residual - np.einsum("lwk,lk->lw", rows, at @ moved))
            for (rows, project, residual), at in zip(
                projected, (field[lines] for lines in parts), strict=True
            )
        ]
        samples.move(np.concatenate(own_steps))
        return float(np.abs(moved).sum(axis=0).max() / np.max(self.shapes[0]))

    def _linearise(self, lines: NDArray[np.intp], field: Array) -> tuple[Array, Array, Array]:
        """Return weighted derivatives by a line's shape (L, W, K) and its own parameters (L, W, 3).

        And the weighted residuals, shape (L, W).
        """
        samples = self.samples
        t = samples.pixel_offset[lines] - samples.position_px[lines][:, None]
        below, above = ((t[..., None] + at - self.knots) / self.knot for at in (-0.5, 0.5))
        basis = self.knot * (_cumulative(above) - _cumulative(below))
        line_shapes = field @ self.shapes
        share = np.einsum("lwk,lk->lw", basis, line_shapes)
        falls = np.einsum("lwk,lk->lw", _density(below) - _density(above), line_shapes)
        mean, weight = samples.predict(share, lines)
        root = np.sqrt(weight)
        residual = (samples.values[lines] - mean) * root
        self.chi2[lines] = np.sum(residual**2, axis=1)
        self.dof[lines] = np.maximum(samples.used[lines].sum(axis=1) - 3.0, 1.0)
        light = samples.light[lines][:, None]
        derivatives = np.stack([light * falls, share, np.ones_like(share)], axis=2)
        return basis * (root * light)[..., None], derivatives * root[..., None], residual

    def drop_outliers(self) -> None:
        """Leave out lines with another light in their window."""
        ratio = self.chi2 / self.dof
        median = float(np.median(ratio[self.keep]))
        self.keep = ratio < median * (1.0 + OUTLIER_SIGMA * np.sqrt(2.0 / self.dof))

    def result(self) -> MeasuredLineSpread:
        """Return the shapes as light in cells at nodes."""
        reach = np.ceil(self.samples.reach_px)
        edges = np.arange(-reach * CELLS_PER_PIXEL, reach * CELLS_PER_PIXEL + 1) / CELLS_PER_PIXEL
        below = self.knot * _cumulative((edges[:, None] - self.knots) / self.knot)
        nodes = np.linspace(self.low, self.high, NODES)
        light = np.maximum(np.diff(self._field(nodes) @ self.shapes @ below.T, axis=1), 0.0)
        light /= light.sum(axis=1, keepdims=True)
        keep = self.keep
        return MeasuredLineSpread(
            light,
            float(edges[0]),
            1.0 / CELLS_PER_PIXEL,
            self.low,
            float(nodes[1] - nodes[0]),
            float(self.samples.width_px),
            int(keep.sum()),
            float(self.chi2[keep].sum() / self.dof[keep].sum()),
        )

    def _field(self, position_px: Array) -> Array:
        """Return Legendre polynomials at positions, shape (L, FIELD_DEGREE + 1)."""
        normalised = (position_px - self.low) / (self.high - self.low) * 2.0 - 1.0
        return np.asarray(
            legendre.legvander(np.clip(normalised, -1.0, 1.0), FIELD_DEGREE), np.float64
        )


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
