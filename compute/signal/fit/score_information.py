"""Score and information of models over their windows, what every step of a fit is made of."""

from dataclasses import dataclass

import numpy as np

from compute.signal.fit.fit_settings import FitSettings
from compute.signal.fit.line_spread_function import LineSpreadFunction
from compute.signal.fit.width_prior import width_prior
from compute.signal.fit.window_model import Array, Layout, Windows, evaluate


@dataclass(frozen=True, eq=False)
class ScoreInformation:
    """ScoreInformation of N models over the pixels that count, with the width's prior.

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
        """Work out the sums of models with the given parameters, shape (N, Q)."""
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
