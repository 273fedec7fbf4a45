"""What is believed of a width before a line is seen: ``FitSettings``, *Prior*."""

from typing import NamedTuple

import numpy as np

from compute.signal.fit.fit_settings import NARROW_POWER, FitSettings
from compute.signal.fit.window_model import Array


class WidthPrior(NamedTuple):
    """What beliefs add to fits, for N logarithms of widths; shape (N,) each.

    Args:
        score: slope of the prior's logarithm.
        information: its curvature, negative.
        chi2: to the misfit: the square of the distance from ``width_px`` in ``width_log_sigma``.
        deviance: twice the prior's logarithm, negative.
    """

    score: Array
    information: Array
    chi2: Array
    deviance: Array


def width_prior(log_width: Array, settings: FitSettings) -> WidthPrior:
    """Return what ``settings`` believes of widths of these logarithms, shape (N,)."""
    nothing = np.zeros_like(log_width)
    if settings.width_log_sigma == 0.0:
        return WidthPrior(nothing, nothing, nothing, nothing)
    inverse = settings.width_log_sigma**-2
    away = np.log(settings.width_px) - log_width
    narrow = np.exp(NARROW_POWER * (np.log(settings.narrow_width_px) - log_width))
    chi2 = inverse * away**2
    return WidthPrior(
        inverse * away + NARROW_POWER * narrow,
        inverse + NARROW_POWER**2 * narrow,
        chi2,
        chi2 + 2.0 * narrow,
    )
