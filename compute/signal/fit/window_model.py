"""Model of a window: expected counts by background, peaks and width; its score and information."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from compute.signal.array_rows import ArrayRows
from compute.signal.fit.fit_settings import NARROW_POWER, FitSettings
from compute.signal.fit.line_spread_function import LineSpreadFunction
from compute.signal.pixel_corrections import PixelCorrections
from compute.signal.sensor_noise import ScanNoise, SensorNoise

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Windows(ArrayRows):
    """N windows of at most W pixels; shorter ones are padded with pixels that do not count.

    Args:
        values: counts, shape (N, W).
        used: pixels that count: of the window, and below full scale; shape (N, W).
        first_px: first pixels, shape (N,).
        last_px: last pixels, shape (N,).
        sensor: numbers of the sensors, shape (N,).
        noise: of the windows' scans.
        masked: bad pixels of the window, shape (N, W).
        scale: factors of the pixels' corrections, shape (N, W).
        slope: known slopes of the background, shape (N,) [counts/px].
    """

    values: Array
    used: NDArray[np.bool_]
    first_px: NDArray[np.int64]
    last_px: NDArray[np.int64]
    sensor: NDArray[np.int64]
    noise: ScanNoise
    masked: NDArray[np.bool_]
    scale: Array
    slope: Array

    @classmethod
    def cut(
        cls,
        scans: NDArray[np.uint16],
        scan: NDArray[np.int64],
        first_px: NDArray[np.int64],
        last_px: NDArray[np.int64],
        noise: SensorNoise,
        corrections: PixelCorrections | None = None,
        slope: Array | None = None,
    ) -> "Windows":
        """Cut windows out of scans.

        Args:
            scans: counts of the scans, uint16, shape (L, P).
            scan: scan of each window, shape (N,).
            first_px: first pixels, shape (N,).
            last_px: last pixels, shape (N,).
            noise: noise of the sensors.
            corrections: of their pixels; None: counts are taken as they are.
            slope: known slopes of the background [counts/px], shape (N,); None: zero.
        """
        width = int((last_px - first_px).max(initial=0)) + 1
        pixel = first_px[:, None] + np.arange(width)
        at = (scan[:, None], np.minimum(pixel, scans.shape[1] - 1))
        raw = scans[at]
        sensor = scan % len(noise)
        full = noise.full_scale_counts[sensor][:, None]
        inside = pixel <= last_px[:, None]
        values, scale = raw.astype(np.float64), np.ones(raw.shape)
        if corrections is not None:
            values = corrections.correct(scans)[at].astype(np.float64)
            scale = corrections.scale[sensor[:, None], at[1]].astype(np.float64)
        masked = inside & (scale == 0.0)
        return cls(
            values,
            inside & (raw < full) & ~masked,
            first_px,
            last_px,
            sensor,
            noise.of_scans(sensor),
            masked,
            np.where(scale == 0.0, 1.0, scale),
            np.zeros(len(scan)) if slope is None else slope,
        )

    def __len__(self) -> int:
        """Return N."""
        return len(self.values)

    @property
    def count(self) -> NDArray[np.int64]:
        """Number of pixels that count, shape (N,)."""
        count: NDArray[np.int64] = self.used.sum(axis=1)
        return count

    @property
    def offset_from_centre(self) -> Array:
        """Positions of the pixels relative to their window's centre, shape (N, W) [px]."""
        centre = 0.5 * (self.first_px + self.last_px)
        return (self.first_px - centre)[:, None] + np.arange(self.values.shape[1])

    def contain(self, position_px: Array) -> NDArray[np.bool_]:
        """Return which windows contain all of their positions, shape (N, K) -> (N,)."""
        inside = (position_px >= self.first_px[:, None] - 0.5) & (
            position_px <= self.last_px[:, None] + 0.5
        )
        return np.asarray(inside.all(axis=1))


@dataclass(frozen=True, eq=False)
class ModelPrediction:
    """Expected counts, variances and Jacobian of the models of N windows.

    Args:
        mean: expected counts, shape (N, W).
        variance: of each pixel [counts^2], shape (N, W).
        jacobian: derivative of the expected counts by each parameter, shape (N, Q, W).
    """

    mean: Array
    variance: Array
    jacobian: Array


class WidthPrior(NamedTuple):
    """The prior's contributions to N fits, arrays of shape (N,).

    Args:
        score: derivative of the prior's logarithm.
        information: its curvature, negative.
        chi2: to the misfit: the square of the distance from ``width_px`` in ``width_log_sigma``.
        deviance: twice the prior's logarithm, negative.
    """

    score: Array
    information: Array
    chi2: Array
    deviance: Array


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


@dataclass(frozen=True)
class WindowModel:
    """Model of K peaks in a window, as ``FitSettings`` defines it.

    Its Q parameters are level, [slope], lights, positions, ln width. The width always has its
    place, known or not.

    Args:
        peaks: K.
        settings: of the fit.
        shape: the line-spread function.
    """

    peaks: int
    settings: FitSettings
    shape: LineSpreadFunction

    @property
    def background_size(self) -> int:
        """Number of the background's parameters."""
        return 2 if self.settings.background == "slope" else 1

    @property
    def light(self) -> slice:
        """The lights A_k [counts]."""
        return slice(self.background_size, self.background_size + self.peaks)

    @property
    def position(self) -> slice:
        """The positions x_k [px]."""
        return slice(self.light.stop, self.light.stop + self.peaks)

    @property
    def size(self) -> int:
        """Q, with the logarithm of the width."""
        return self.background_size + 2 * self.peaks + 1

    def with_peak_more(self) -> "WindowModel":
        """Return the model of K + 1 peaks."""
        return replace(self, peaks=self.peaks + 1)

    def evaluate(self, windows: Windows, parameters: Array) -> ModelPrediction:
        """Return the expected counts and their derivatives.

        Args:
            windows: N windows.
            parameters: shape (N, Q).
        """
        pixels = windows.values.shape[1]
        position, light = parameters[:, self.position], parameters[:, self.light]
        width = np.exp(parameters[:, -1:])
        edge_px = windows.first_px[:, None] - 0.5 + np.arange(pixels + 1)
        t = (edge_px[:, None, :] - position[..., None]) / width[..., None]
        below, density = self.shape.at(t, windows.sensor[:, None, None], position[..., None])
        share = np.diff(below, axis=2)
        jacobian = np.ones((len(windows), self.size, pixels))
        jacobian[:, self.light] = share
        bright = light[..., None]
        jacobian[:, self.position] = np.diff(density, axis=2) * (-bright / width[..., None])
        jacobian[:, -1] = -(np.diff(t * density, axis=2) * bright).sum(axis=1)
        lit = (bright * share).sum(axis=1)
        mean = lit + parameters[:, :1]
        if self.settings.background == "slope":
            jacobian[:, 1] = windows.offset_from_centre
            mean += parameters[:, 1:2] * jacobian[:, 1]
        mean += windows.slope[:, None] * windows.offset_from_centre
        noise = windows.noise
        light = noise.photon * np.maximum(mean - noise.offset, 0.0)
        variance = windows.scale * (windows.scale * noise.dark + light)
        variance += (self.settings.shape_error * lit) ** 2
        return ModelPrediction(mean, variance, jacobian)

    def score_information(self, windows: Windows, parameters: Array) -> ScoreInformation:
        """Return the sums over the pixels that count, with the prior of the width.

        Args:
            windows: N windows.
            parameters: shape (N, Q).
        """
        with np.errstate(over="ignore", invalid="ignore"):
            model = self.evaluate(windows, parameters)
            weight = windows.used / model.variance
            residual = np.where(windows.used, windows.values - model.mean, 0.0)
            weighted = model.jacobian * weight[:, None, :]
            score = (weighted @ residual[..., None])[..., 0]
            information = weighted @ model.jacobian.transpose(0, 2, 1)
            chi2 = (residual**2 * weight).sum(axis=1)
            log_variance = np.where(windows.used, np.log(model.variance), 0.0).sum(axis=1)
        prior = self.width_prior(parameters[:, -1])
        score[:, -1] += prior.score
        information[:, -1, -1] += prior.information
        deviance = chi2 + prior.deviance + log_variance
        return ScoreInformation(score, information, chi2 + prior.chi2, deviance)

    def width_prior(self, log_width: Array) -> WidthPrior:
        """Return the contributions of the prior of widths with these logarithms, shape (N,)."""
        settings = self.settings
        if settings.width_log_sigma == 0.0:
            return WidthPrior(*np.zeros((4, len(log_width))))
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

    def central_pixel_fraction(
        self, width_px: Array, sensor: NDArray[np.int64], position_px: Array
    ) -> Array:
        """Return the share of a peak's light in a pixel centred on it; all arguments broadcast.

        Args:
            width_px: widths of the peaks [px].
            sensor: numbers of the sensors.
            position_px: positions of the peaks [px].
        """
        upper, lower = (
            self.shape.at(half / width_px, sensor, position_px)[0] for half in (0.5, -0.5)
        )
        return np.asarray(upper - lower)
