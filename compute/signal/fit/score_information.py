"""Score and Fisher information of the window models, with the prior of the width."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from compute.signal.fit.fit_settings import NARROW_POWER, FitSettings
from compute.signal.fit.line_spread_function import LineSpreadFunction
from compute.signal.fit.window_model import Array, Layout, Windows, evaluate


class WidthPrior(NamedTuple):
    """The prior's contributions to N fits, arrays of shape (N,).

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
    """Return the contributions of the prior of the width; see ``FitSettings``, *Prior*.

    Args:
        log_width: logarithms of the widths, shape (N,).
        settings: of the fit.
    """
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


@dataclass(frozen=True, eq=False)
class ScoreInformation:
    """Score, information and deviance of N models, with the width's prior.

    Args:
        score: derivative of the likelihood's logarithm by each parameter, shape (N, Q).
        information: expected of it, shape (N, Q, Q).
        chi2: ``sum (v - mu)^2/V`` and the prior's part, shape (N,).
        deviance: ``sum ((v - mu)^2/V + ln V)`` and the prior's term, shape (N,).
    """

    score: Array
    information: Array
    chi2: Array
    deviance: Array

    @classmethod
    def of(
        cls,
        windows: Windows,
        parameters: Array,
        layout: Layout,
        settings: FitSettings,
        shape: LineSpreadFunction,
    ) -> "ScoreInformation":
        """Compute the sums over the pixels that count.

        Args:
            windows: N windows.
            parameters: shape (N, Q).
            layout: their order.
            settings: of the fit.
            shape: the line-spread function.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            model = evaluate(windows, parameters, layout, settings, shape)
            weight = windows.used / model.variance
            residual = np.where(windows.used, windows.values - model.mean, 0.0)
            weighted = model.jacobian * weight[:, None, :]
            score = (weighted @ residual[..., None])[..., 0]
            information = weighted @ model.jacobian.transpose(0, 2, 1)
            chi2 = (residual**2 * weight).sum(axis=1)
            log_variance = np.where(windows.used, np.log(model.variance), 0.0).sum(axis=1)
        prior = width_prior(parameters[:, -1], settings)
        score[:, -1] += prior.score
        information[:, -1, -1] += prior.information
        deviance = chi2 + prior.deviance + log_variance
        return cls(score, information, chi2 + prior.chi2, deviance)
