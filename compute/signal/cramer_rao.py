"""Cramer-Rao bounds: the lowest standard deviation of unbiased positions of peaks."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from compute.errors import InvalidParameter
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.fit.line_spread_function import LineSpreadFunction
from compute.signal.fit.window_model import Array, WindowModel, Windows
from compute.signal.sensor_noise import SensorNoise


def fisher_information(derivatives: Sequence[Array], variance: Array) -> Array:
    """Return the Fisher information of parameters from pixels with independent Gaussian noise.

    ``I_ab = sum_i (dmu_i / da) (dmu_i / db) / V_i`` (S. M. Kay, Fundamentals of Statistical Signal
    Processing I, 1993, section 3.9). The variances are taken as known: their own dependence on
    the parameters, of order 1 / electrons, is left out. A pixel without light and noise carries
    no information.

    Args:
        derivatives: of the pixels' means by each of Q parameters, each of shape (..., W).
        variance: of the pixels, shape (..., W), in the square of the means' unit.

    Returns:
        Shape (..., Q, Q).
    """
    size = len(derivatives)
    information = np.empty((*np.shape(variance)[:-1], size, size))
    with np.errstate(divide="ignore", invalid="ignore"):
        for row in range(size):
            for column in range(row, size):
                product = derivatives[row] * derivatives[column]
                terms = np.where(product != 0.0, product / variance, 0.0)
                information[..., row, column] = terms.sum(axis=-1)
                information[..., column, row] = information[..., row, column]
    return information


def position_bound(
    mean_electrons: Array,
    derivative_electrons_per_px: Array,
    noise_variance_electrons2: float,
    *,
    known_brightness: bool = False,
) -> Array:
    """Return the Cramer-Rao bound of the position of one peak or pattern of any shape.

    With the information A of the position, C of the relative brightness and B of both together,
    ``1 / bound^2 = A - B^2 / C`` (S. M. Kay, 1993, section 3.7), or A where the brightness is
    known, as beside a correlation, whose maximum does not depend on the brightness. B is zero for
    a symmetric peak.

    The bound holds the noise only. An error that is the same in every exposure, such as
    distortion, a shape that depends on the position, or an estimator's error within a pixel, is
    not in it.

    Args:
        mean_electrons: signal of each pixel of the window, shape (..., W).
        derivative_electrons_per_px: its derivative by the position, shape (..., W), from the
            optics (two points a little apart), not from differences of pixels.
        noise_variance_electrons2: variance of a pixel without signal, by ambient light, read
            noise and conversion [electrons^2].
        known_brightness: the brightness is not a parameter.

    Returns:
        Standard deviation, shape (...) [px]; infinite where there is no light.

    Raises:
        InvalidParameter: a noise variance that is negative or not finite.
    """
    if not 0.0 <= noise_variance_electrons2 < np.inf:
        raise InvalidParameter(
            f"noise_variance_electrons2 is {noise_variance_electrons2}; it must be zero or "
            "positive",
            noise_variance_electrons2=noise_variance_electrons2,
        )
    variance = np.maximum(mean_electrons, 0.0) + noise_variance_electrons2
    joint = fisher_information((derivative_electrons_per_px, mean_electrons), variance)
    position, mixed, brightness = joint[..., 0, 0], joint[..., 0, 1], joint[..., 1, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        lost = np.where(brightness > 0.0, mixed**2 / brightness, 0.0)
        information = position if known_brightness else position - lost
        bound: Array = np.where(information > 0.0, information, 0.0) ** -0.5
    return bound


def joint_position_bounds(
    position_px: ArrayLike,
    light_electrons: Sequence[float],
    ambient_electrons: float,
    pixels: int,
    settings: FitSettings,
    noise: SensorNoise,
    shape: LineSpreadFunction | None = None,
    *,
    only_positions: bool = False,
) -> Array:
    """Return the Cramer-Rao bounds of the positions of K peaks on sensor 0, as covariances.

    The unknowns, and the prior of the width, are those of ``FitSettings``; ``position_bound`` is
    the bound of one peak of any shape whose brightness alone is unknown beside its position.

    Args:
        position_px: true positions, shape (N, K) [px].
        light_electrons: light of each of the K peaks.
        ambient_electrons: ambient light of a pixel.
        pixels: number of pixels of the scan.
        settings: what is known: the width is ``width_px``.
        noise: of the sensors; the first counts.
        shape: the line-spread function; None: a Gaussian.
        only_positions: nothing but the positions is unknown.

    Returns:
        Covariances, shape (N, K, K) [px^2].

    Raises:
        InvalidParameter: positions of another shape than (N, K).
    """
    place = np.asarray(position_px, dtype=np.float64)
    if place.ndim != 2 or place.shape[1] != len(light_electrons):
        raise InvalidParameter(
            f"position_px has the shape {place.shape}; it must be (N, {len(light_electrons)})",
            position_px=place.shape,
        )
    gain, offset = noise.electrons_per_count[0], noise.offset_counts[0]
    model = WindowModel(
        place.shape[1], settings, LineSpreadFunction.gaussian() if shape is None else shape
    )
    parameters = np.zeros((len(place), model.size))
    parameters[:, 0] = offset + ambient_electrons / gain
    parameters[:, model.light] = np.asarray(light_electrons) / gain
    parameters[:, model.position] = place
    parameters[:, -1] = np.log(settings.width_px)
    windows = Windows.cut(
        np.zeros((1, pixels), np.uint16),
        np.zeros(len(place), np.int64),
        np.zeros(len(place), np.int64),
        np.full(len(place), pixels - 1),
        noise,
    )
    expected = model.evaluate(windows, parameters)
    information = fisher_information(tuple(expected.jacobian.transpose(1, 0, 2)), expected.variance)
    unknown = np.arange(model.size)
    if 0.0 < settings.width_log_sigma < np.inf:
        information[:, -1, -1] += settings.width_log_sigma**-2
    if settings.width_log_sigma == 0.0:
        unknown = unknown[:-1]
    if only_positions:
        unknown = unknown[model.position]
    covariance = np.linalg.inv(information[:, unknown[:, None], unknown])
    positions = np.isin(unknown, np.arange(model.size)[model.position])
    return np.asarray(covariance[:, positions][:, :, positions], dtype=np.float64)
