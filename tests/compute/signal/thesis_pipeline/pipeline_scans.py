"""Noiseless lines for tests of the chain: Gaussian and compact peaks, in pixels."""

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

Array = NDArray[np.float64]


def gaussian_lines(position_px: Array, sigma_px: float, pixels: int = 128) -> Array:
    """Return lines with one pixel-integrated Gaussian each, shape (L, P), 1000 counts in all."""
    edges = np.arange(pixels + 1) - 0.5
    return 1000.0 * np.diff(ndtr((edges - np.asarray(position_px)[:, None]) / sigma_px), axis=1)


def compact_peak(position_px: float, half_width_px: float, pixels: int) -> Array:
    """Return a raised cosine, shape (P,), which is zero outside its half width; height 1."""
    away = np.abs(np.arange(pixels) - position_px) / half_width_px
    return np.where(away < 1.0, 0.5 * (1.0 + np.cos(np.pi * away)), 0.0)


def whole_centre(lines: Array) -> Array:
    """Return the centres of gravity of whole lines."""
    return lines @ np.arange(lines.shape[-1]) / lines.sum(axis=-1)
