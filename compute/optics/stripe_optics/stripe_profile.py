"""Profiles of stripes on a sub-pixel grid: traced rays, blurred by emitter and diffraction."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fftfreq, irfft, next_fast_len, rfft, rfftfreq
from scipy.interpolate import CubicSpline

from compute.optics.pixel_row import PixelRow
from compute.optics.stripe_optics.ray_aiming import RayFans

Array = NDArray[np.float64]

CELLS: Final = 16
"""Cells of the fine grid in a pixel."""

_TUBES: Final = 8  # ray tubes between two traced rays
_MARGIN_PX: Final = 24  # room for the blur on both sides of a line
# The tails of sinc^2 fall with the square of the distance and have no centre of gravity: they
# fade out here; beyond lie 0.2 to 0.8 % of the light, more of it the narrower the stop.
_TAIL_PX: Final = (12.0, 20.0)
_BESIDE_PX: Final = 64.0  # a line that lies farther beside the row than this is dark
_MIN_CELLS: Final = 0.5  # smallest width of a tube
_BLOCK: Final = 4_000_000  # grid cells worked on at once


@dataclass(frozen=True, eq=False)
class StripeProfiles:
    """N stripes on the sub-pixel grid, in readings.

    A line of which any light falls within 64 px of the row is whole, but for what falls farther
    beside the row than the row is long; any other line is dark. Cell k of line n covers
    ``first_px[n] - 1/2 + [k, k + 1] / CELLS``.

    Args:
        first_px: number of the pixel with which the grid begins, int64, shape (N,).
        cell_sr: effective solid angle by cell, shape (N, G) [sr]; G is a multiple of CELLS.
    """

    first_px: NDArray[np.int64]
    cell_sr: Array

    @property
    def total_sr(self) -> Array:
        """Effective solid angle of each stripe, shape (N,) [sr]."""
        total: Array = self.cell_sr.sum(axis=1)
        return total

    @property
    def pixels_sr(self) -> Array:
        """Effective solid angle by pixel, shape (N, G / CELLS) [sr]."""
        pixels: Array = self.cell_sr.reshape(len(self.cell_sr), -1, CELLS).sum(axis=2)
        return pixels

    @property
    def centres_px(self) -> Array:
        """Readings of the middles of the cells, shape (N, G) [px]."""
        cells = (np.arange(self.cell_sr.shape[1]) + 0.5) / CELLS - 0.5
        return self.first_px[:, None] + cells

    @property
    def centroid_px(self) -> Array:
        """Centre of gravity of each stripe, shape (N,) [px]; NaN without light."""
        with np.errstate(invalid="ignore"):
            centroid: Array = (self.cell_sr * self.centres_px).sum(axis=1) / self.total_sr
        return centroid


@dataclass(frozen=True)
class Blur:
    """Blur of a stripe beyond geometrical optics: emitter width and diffraction.

    Args:
        wavelength_nm: wavelength, for the diffraction at the pupil [nm]; None: none.
        emitter_width_mm: diameter of a round, evenly bright emitter [mm]; 0: a point.
    """

    wavelength_nm: float | None
    emitter_width_mm: float


def stripe_profiles(
    rays: RayFans,
    height_weights_mm: Array,
    row: PixelRow,
    blur: Blur,
    scale_px_per_mm: Array,
) -> StripeProfiles:
    """Bin ray fans to stripe profiles on the sub-pixel grid.

    The light between two neighbouring rays lies between their two positions on the row. Emitter and
    diffraction then widen the line: the first by the emitter's image, the second by the line
    spread of a slit, sinc^2, whose transfer function falls linearly to zero at
    ``(sine of the last ray - sine of the first) / wavelength`` (J. W. Goodman, Introduction to
    Fourier Optics, section 6.3). Geometric spread and diffraction are convolved: right where
    either is the larger, and an approximation where they are alike.

    Args:
        rays: fans of N points at T heights.
        height_weights_mm: weights of the integral over the row's height, shape (T,) [mm].
        row: the pixels.
        blur: emitter and wavelength.
        scale_px_per_mm: by how much a line moves when its point moves along x, shape (N,)
            [px/mm].

    Returns:
        Lines of one grid length for all; dark ones where no ray arrives.
    """
    tubes = _near_row(_tubes(rays, height_weights_mm, row), row.count)
    lit = tubes.light > 0.0
    dark = ~lit.any(axis=1)
    low = np.where(dark, row.centre_px, np.where(lit, tubes.low, np.inf).min(axis=1))
    high = np.where(dark, row.centre_px, np.where(lit, tubes.high, -np.inf).max(axis=1))
    emitter = np.abs(scale_px_per_mm) * blur.emitter_width_mm / 2.0
    margin = _MARGIN_PX + np.ceil(emitter.max(initial=0.0))
    first = np.floor(low + 0.5 - margin).astype(np.int64)
    pixels = int(np.ceil((high - low).max(initial=0.0) + 2.0 * margin + 1.0))
    cells = np.empty((len(low), CELLS * pixels))
    cutoff = _cutoff(rays, blur.wavelength_nm, row)
    block = max(1, _BLOCK // cells.shape[1])
    for start in range(0, len(low), block):
        part = slice(start, start + block)
        gathered = _gather_tubes(tubes, part, first[part], cells.shape[1])
        cells[part] = _blur(gathered, emitter[part], cutoff[part])
    return StripeProfiles(first, cells)


@dataclass(frozen=True, eq=False)
class _Tubes:
    """Fine ray tubes of N lines: their two ends on the row [px] and their light [sr], (N, K)."""

    low: Array
    high: Array
    light: Array


def merge_profiles(
    parts: Sequence[tuple[NDArray[np.int64], StripeProfiles]], count: int
) -> StripeProfiles:
    """Merge profiles of several grids.

    Args:
        parts: which of the lines they are, and the lines.
        count: N, of all lines.
    """
    width = max((lines.cell_sr.shape[1] for _, lines in parts), default=CELLS)
    first = np.zeros(count, dtype=np.int64)
    cells = np.zeros((count, width))
    for which, lines in parts:
        first[which] = lines.first_px
        cells[which, : lines.cell_sr.shape[1]] = lines.cell_sr
    return StripeProfiles(first, cells)


def spline_error_px(rays: RayFans, row: PixelRow) -> Array:
    """Return an estimate of the error of a spline through the rays' positions, shape (N,) [px].

    A spline through every second ray misses those between by sixteen times as much as one
    through all misses what lies between them. Infinite where rays are lost inside of a fan;
    zero for a dark line.

    Args:
        rays: the ray fans of N points.
        row: the pixels.
    """
    nodes = np.linspace(0.0, 1.0, rays.position_mm.shape[2])
    position = rays.position_mm / row.pitch_mm
    gaps = ~np.isfinite(position).all(axis=2) | (rays.solid_angle_sr_per_mm2 == 0.0).any(axis=2)
    finite = np.where(gaps[..., None], 0.0, position)
    coarse = CubicSpline(nodes[::2], finite[..., ::2], axis=2)
    miss = np.abs(coarse(nodes[1::2]) - finite[..., 1::2]).mean(axis=2) / 15.0
    miss = np.where(gaps, np.inf, miss)
    return np.asarray(np.where(rays.lit, miss, 0.0).max(axis=1))


def _tubes(rays: RayFans, weights: Array, row: PixelRow) -> _Tubes:
    points, _, samples = rays.position_mm.shape
    ends = np.linspace(0.0, 1.0, _TUBES * (samples - 1) + 1)
    midpoints = 0.5 * (ends[1:] + ends[:-1])
    traced = np.linspace(0.0, 1.0, samples)
    # The image is upside down: readings grow against x.
    reading = row.centre_px - rays.position_mm / row.pitch_mm
    finite = np.isfinite(reading)
    light = rays.solid_angle_sr_per_mm2
    lower = np.minimum((midpoints * (samples - 1)).astype(np.int64), samples - 2)
    ends_px = _interpolate(traced, np.where(finite, reading, 0.0), ends, finite)
    density = _interpolate(traced, light, midpoints, light > 0.0)
    density *= (light[..., lower] > 0.0) & (light[..., lower + 1] > 0.0)
    width = np.diff(rays.pupil_mm[..., [0, -1]], axis=2) / len(midpoints)
    light = np.maximum(density, 0.0) * width * weights[:, None]
    light *= rays.lit[..., None]
    one, other = ends_px[..., :-1], ends_px[..., 1:]
    return _Tubes(
        np.minimum(one, other).reshape(points, -1),
        np.maximum(one, other).reshape(points, -1),
        light.reshape(points, -1),
    )


def _near_row(tubes: _Tubes, count: int) -> _Tubes:
    """Darken lines beside a row of ``count`` pixels; cut off what is a row's length beside it.

    A line is not cut where it leaves the row: its light would jump by a whole tube's. The far cut
    bounds the grid's length; it shares the light of the tubes that it meets.
    """
    near = (tubes.high >= -_BESIDE_PX) & (tubes.low <= count + _BESIDE_PX) & (tubes.light > 0.0)
    reach = _BESIDE_PX + count
    low = np.clip(tubes.low, -reach, count + reach)
    high = np.clip(tubes.high, -reach, count + reach)
    width = tubes.high - tubes.low
    inside = (tubes.high >= -reach) & (tubes.low <= count + reach)
    share = np.where(width > 0.0, (high - low) / np.where(width > 0.0, width, 1.0), inside)
    return _Tubes(low, high, tubes.light * share * near.any(axis=1, keepdims=True))


def _interpolate(nodes: Array, values: Array, at: Array, good: NDArray[np.bool_]) -> Array:
    """Interpolate along the last axis: by a spline, or linearly in a fan that has gaps."""
    complete = good.all(axis=-1)
    interpolated = np.empty((*values.shape[:-1], len(at)))
    if complete.any():
        interpolated[complete] = CubicSpline(nodes, values[complete], axis=-1)(at)
    for index in zip(*np.nonzero(~complete), strict=True):
        interpolated[index] = np.interp(at, nodes, values[index])
    return interpolated


def _gather_tubes(tubes: _Tubes, part: slice, first: NDArray[np.int64], cells: int) -> Array:
    """Spread each tube's light evenly between its ends.

    The light of the cells is the running sum of what each tube adds at its low end and takes
    away at its high end, shared between the two cells there.
    """
    low = (tubes.low[part] - first[:, None] + 0.5) * CELLS
    high = (tubes.high[part] - first[:, None] + 0.5) * CELLS
    # At a focus a tube has no width; half a cell keeps its position.
    missing = 0.5 * np.maximum(_MIN_CELLS - (high - low), 0.0)
    low, high = low - missing, high + missing
    density = tubes.light[part] / (high - low)
    line = (cells + 2) * np.arange(len(low))[:, None]
    steps = np.zeros(len(low) * (cells + 2))
    for end, sign in ((low, 1.0), (high, -1.0)):
        cell = np.floor(end)
        share = end - cell
        index = (np.clip(cell.astype(np.int64), 0, cells) + line).ravel()
        for offset, part_of in ((0, 1.0 - share), (1, share)):
            added = (sign * density * part_of).ravel()
            steps += np.bincount(index + offset, added, minlength=len(steps))
    gathered = np.cumsum(steps.reshape(len(low), -1), axis=1)[:, :cells]
    return np.asarray(np.maximum(gathered, 0.0))


def _cutoff(rays: RayFans, wavelength_nm: float | None, row: PixelRow) -> Array:
    """Return where diffraction ends the transfer function, shape (N,) [cycles per pixel]."""
    if wavelength_nm is None:
        return np.full(len(rays.sine), np.inf)
    sine = np.nan_to_num(rays.sine)
    aperture = np.abs(sine[..., -1] - sine[..., 0]).max(axis=1)
    cutoff: Array = np.maximum(aperture / (wavelength_nm * 1e-6) * row.pitch_mm, 1e-6)
    return cutoff


def _blur(cells: Array, emitter_px: Array, cutoff: Array) -> Array:
    """Convolve the lines with the emitter's image and the line spread of diffraction."""
    if not emitter_px.any() and np.isinf(cutoff).all():
        return cells
    length = next_fast_len(cells.shape[1], real=True)
    frequency = rfftfreq(length, 1.0 / CELLS)
    transfer = np.maximum(1.0 - frequency / cutoff[:, None], 0.0)
    # A disc of a cell or less has no shape on the grid: three cells of its variance. Larger ones
    # share their light among the cells as they cover them; neither rings.
    radius = CELLS * emitter_px[:, None]
    variance = (0.5 * radius) ** 2
    small = 1.0 - variance * (1.0 - np.cos(2.0 * np.pi * frequency / CELLS))
    cell = fftfreq(length, 1.0 / length)
    ends = np.clip((cell + np.array([-0.5, 0.5])[:, None, None]) / np.maximum(radius, 1.0), -1, 1)
    below = (ends * np.sqrt(1.0 - ends**2) + np.arcsin(ends)) / np.pi
    large = rfft(below[1] - below[0], axis=1).real
    transfer *= np.where(variance < 0.5, small, large)
    kernel = irfft(transfer, length, axis=1)
    distance = np.abs(fftfreq(length, 1.0 / length)) / CELLS - emitter_px[:, None]
    outside = np.clip((distance - _TAIL_PX[0]) / (_TAIL_PX[1] - _TAIL_PX[0]), 0.0, 1.0)
    kernel *= np.cos(0.5 * np.pi * outside) ** 2
    kernel /= kernel.sum(axis=1, keepdims=True)
    blurred = irfft(rfft(cells, length, axis=1) * rfft(kernel, axis=1), length, axis=1)
    # The rounding of the transforms, 1e-16 of the peak, is not light.
    lit = np.maximum(blurred[:, : cells.shape[1]], 0.0)
    total = lit.sum(axis=1, keepdims=True)
    return np.asarray(lit * (cells.sum(axis=1, keepdims=True) / np.where(total > 0.0, total, 1.0)))
