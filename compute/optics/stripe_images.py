"""Images of Gaussian stripes on a row of pixels, in mean electrons."""

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

Array = NDArray[np.float64]

_REACH_SIGMA = 6.0  # beyond it lie 2e-9 of a Gaussian


def stripe_images(position_px: Array, sigma_px: Array, electrons: Array, pixels: int) -> Array:
    """Integrate Gaussian stripes over the pixels and add them up, scan by scan.

    Pixel i covers [i - 0.5, i + 0.5]. A stripe outside the row leaves there what of its tail
    falls on it; the tails end at 6 sigma at the earliest, which drops 2e-9 of the light.

    Args:
        position_px: centres of M stripes on each of L scans, shape (L, M) [px]; NaN: no stripe.
        sigma_px: their standard deviations, shape (L, M) [px], positive.
        electrons: their mean electrons in total, shape (L, M).
        pixels: pixels of a scan.

    Returns:
        Mean electrons, shape (L, pixels).
    """
    lines = len(position_px)
    # One window width for all stripes keeps the work in one array.
    reach = np.ceil(_REACH_SIGMA * float(sigma_px.max(initial=0.0)) + 0.5)
    lit = (position_px > -0.5 - reach) & (position_px < pixels - 0.5 + reach) & (electrons > 0.0)
    line = np.nonzero(lit)[0]
    position, sigma = position_px[lit][:, None], sigma_px[lit][:, None]
    first = np.rint(position) - reach
    edges = first - 0.5 + np.arange(2 * int(reach) + 2)
    share = np.diff(ndtr((edges - position) / sigma), axis=1)
    pixel = first.astype(np.int64) + np.arange(2 * int(reach) + 1)
    inside = (pixel >= 0) & (pixel < pixels)
    place = (line[:, None] * pixels + pixel)[inside]
    light = (share * electrons[lit][:, None])[inside]
    image = np.bincount(place, light, minlength=lines * pixels)
    return image.reshape(lines, pixels).astype(np.float64, copy=False)
