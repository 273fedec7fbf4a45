"""Fixed-pattern noise: error of a stripe's position due to pixel nonuniformity."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.optics.detector import Detector
from compute.parameter_checks import check_not_negative
from compute.planning.cramer_rao import PixelNoise

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PixelNonuniformity:
    """Pixel nonuniformity, as standard deviations from pixel to pixel.

    Args:
        response_nonuniformity: relative, of the response to light (PRNU).
        ambient_electrons: mean electrons of even ambient light, to which the response applies.
        unlit_electrons: of what a pixel counts without light: dark signal (DSNU) and offset.

    Raises:
        InvalidParameter: a value is negative or not finite.
    """

    response_nonuniformity: float
    ambient_electrons: float = 0.0
    unlit_electrons: float = 0.0

    @classmethod
    def of(cls, detector: Detector) -> "PixelNonuniformity":
        """Return the pattern of a detector, neither flat-fielded nor corrected for the dark."""
        return cls(
            detector.response_nonuniformity,
            detector.ambient_electrons,
            float(
                np.hypot(
                    detector.dark_nonuniformity * detector.dark_electrons,
                    detector.offset_nonuniformity_counts * detector.electrons_per_count,
                )
            ),
        )

    def __post_init__(self) -> None:
        check_not_negative(self, *vars(self))


def fixed_pattern_sigma(
    mean_electrons: Array, slope_per_px: Array, noise: PixelNoise, pattern: PixelNonuniformity
) -> Array:
    """Return the standard deviation of a stripe's position due to pixel nonuniformity.

    Of the estimator that reaches ``position_bound``, the weighted fit of position and brightness
    to the line of nominal pixels: with its weights w = 1 / variance, a = d mu / dx, its part
    c = a - (sum w a mu / sum w mu^2) mu that no brightness explains, and the deviation s of each
    pixel's mean by the pattern, ``error = sqrt(sum (w c s)^2) / sum w c^2`` (to first order).

    The error is fixed for a line at one place of one sensor; this is its standard deviation over
    places a few pixels apart, or over devices. More light does not make it smaller, averaging
    neither; flat-fielding does.

    Args:
        mean_electrons: signal of each pixel of the window, shape (..., W).
        slope_per_px: derivative by the line's position, shape (..., W) [electrons/px].
        noise: which makes the weights.
        pattern: how the pixels differ.

    Returns:
        Standard deviation, shape (...) [px]; infinite where there is no light.
    """
    weight = 1.0 / (np.maximum(mean_electrons, 0.0) + noise.variance_electrons2)
    mixed = (weight * slope_per_px * mean_electrons).sum(axis=-1, keepdims=True)
    bright = (weight * mean_electrons**2).sum(axis=-1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(bright > 0.0, mixed / bright, 0.0)
    residual_slope = slope_per_px - share * mean_electrons
    lit = pattern.response_nonuniformity * (mean_electrons + pattern.ambient_electrons)
    deviation = np.hypot(lit, pattern.unlit_electrons)
    information = (weight * residual_slope**2).sum(axis=-1)
    moved = np.sqrt(np.square(weight * residual_slope * deviation).sum(axis=-1))
    with np.errstate(divide="ignore", invalid="ignore"):
        error: Array = np.where(information > 0.0, moved / information, np.inf)
    return error
