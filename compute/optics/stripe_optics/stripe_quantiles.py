"""Quantiles of stripes: the readings below which given shares of the light lie."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.optics.stripe_optics.stripe_profile import CELLS, StripeProfiles

Array = NDArray[np.float64]

QUANTILE_LEVELS: Final = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 97))
"""Shares of the light below the quantiles; closer towards the tails."""

_PIECES: Final = np.diff(QUANTILE_LEVELS)
_LINES_AT_ONCE: Final = 512
_OVERLAP_PX: Final = 2  # pixels of a window beyond the line's ends


def quantiles(lines: StripeProfiles) -> Array:
    """Return the readings below which the QUANTILE_LEVELS of the light lie, shape (N, K) [px].

    The two ends are set so that each outermost piece has its own centre of gravity, and all are
    shifted together by what the pieces between, taken as even, lack of the whole line's; so the
    centroid of what is read from the table is the traced one. Zero for a dark line.
    """
    levels = np.zeros((len(lines.cell_sr), len(QUANTILE_LEVELS)))
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
        (QUANTILE_LEVELS + order).ravel(), (share + order).ravel(), np.tile(edges, len(light))
    ).reshape(len(light), -1)
    position = (level + 0.5) * CELLS
    cell = np.minimum(position.astype(np.int64), light.shape[1] - 1)
    before = np.take_along_axis(moment, cell, axis=1)
    at = before + (position - cell) * (np.take_along_axis(moment, cell + 1, axis=1) - before)
    level[:, 0] = 2.0 * (at[:, 1] - at[:, 0]) / QUANTILE_LEVELS[1] - level[:, 1]
    level[:, -1] = 2.0 * (at[:, -1] - at[:, -2]) / (1.0 - QUANTILE_LEVELS[-2]) - level[:, -2]
    return np.asarray(level + (moment[:, -1] - centroid_of_quantiles(level))[:, None])


def pixel_windows(quantiles_px: Array, light_sr: Array) -> tuple[NDArray[np.int64], Array]:
    """Return the light of the pixels of stripes given by quantiles.

    Args:
        quantiles_px: quantiles at QUANTILE_LEVELS, shape (N, K) [px].
        light_sr: total light, shape (N,) [sr].

    Returns:
        Number of the first pixel of each window, shape (N,), and the light of its pixels, shape
        (N, W) [sr].
    """
    levels = np.maximum.accumulate(quantiles_px, axis=1)
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
        (QUANTILE_LEVELS + order).ravel(),
    ).reshape(len(levels), -1)
    return first, np.diff(share, axis=1) * light_sr[:, None]


def centroid_of_quantiles(quantiles_px: Array) -> Array:
    """Return the centroids of stripes that are even between their quantiles, shape (N,) [px]."""
    centroid: Array = (0.5 * (quantiles_px[:, 1:] + quantiles_px[:, :-1])) @ _PIECES
    return centroid
