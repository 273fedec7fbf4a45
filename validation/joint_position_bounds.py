"""Cramer-Rao bounds of the positions of peaks that overlap: the unknowns of the weighted fit."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from compute.errors import InvalidParameter
from compute.signal.cramer_rao import fisher_information
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.fit.line_spread_function import LineSpreadFunction
from compute.signal.fit.window_model import Array, WindowModel, Windows
from compute.signal.sensor_noise import SensorNoise


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
    position = np.asarray(position_px, dtype=np.float64)
    if position.ndim != 2 or position.shape[1] != len(light_electrons):
        raise InvalidParameter(
            f"position_px has the shape {position.shape}; it must be (N, {len(light_electrons)})",
            position_px=position.shape,
        )
    gain, offset = noise.electrons_per_count[0], noise.offset_counts[0]
    model = WindowModel(
        position.shape[1], settings, LineSpreadFunction.gaussian() if shape is None else shape
    )
    parameters = np.zeros((len(position), model.size))
    parameters[:, 0] = offset + ambient_electrons / gain
    parameters[:, model.light] = np.asarray(light_electrons) / gain
    parameters[:, model.position] = position
    parameters[:, -1] = np.log(settings.width_px)
    windows = Windows.cut(
        np.zeros((1, pixels), np.uint16),
        np.zeros(len(position), np.int64),
        np.zeros(len(position), np.int64),
        np.full(len(position), pixels - 1),
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
