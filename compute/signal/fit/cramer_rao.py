"""Bounds: how precisely positions can be known at best, jointly with all that is unknown beside."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from compute.errors import InvalidParameter
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.fit.line_spread_function import LineSpreadFunction
from compute.signal.fit.window_model import Array, Layout, Windows, evaluate
from compute.signal.sensor_noise import SensorNoise


def position_bounds(
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
    """Return the Cramer-Rao bounds of the positions of K lines on sensor 0, as covariances.

    The inverse of ``sum_i dmu_i dmu_i^T / V_i`` over all pixels of the line, with the unknowns
    and the width's prior of ``FitSettings`` (S. M. Kay, Fundamentals of Statistical Signal
    Processing I, 1993, chapter 3). ``compute.planning.cramer_rao.position_bound`` is the bound
    for one line of any shape whose brightness alone is unknown beside its position. The variances
    are taken as known; see there.

    Args:
        position_px: true positions, shape (N, K) [px].
        light_electrons: light of each of the K lines.
        ambient_electrons: of a pixel.
        pixels: of the line.
        settings: what is known: the width is ``width_px``.
        noise: of the sensor.
        shape: how a line's light is spread; a Gaussian where there is none.
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
    layout = Layout(place.shape[1], settings.background == "slope")
    parameters = np.zeros((len(place), layout.size))
    parameters[:, 0] = offset + ambient_electrons / gain
    parameters[:, layout.light] = np.asarray(light_electrons) / gain
    parameters[:, layout.position] = place
    parameters[:, -1] = np.log(settings.width_px)
    windows = Windows.cut(
        np.zeros((1, pixels), np.uint16),
        np.zeros(len(place), np.int64),
        np.zeros(len(place), np.int64),
        np.full(len(place), pixels - 1),
        noise,
    )
    model = evaluate(
        windows,
        parameters,
        layout,
        settings,
        LineSpreadFunction.gaussian() if shape is None else shape,
    )
    weighted = model.jacobian / model.variance[:, None, :]
    information = weighted @ model.jacobian.transpose(0, 2, 1)
    unknown = np.arange(layout.size)
    if 0.0 < settings.width_log_sigma < np.inf:
        information[:, -1, -1] += settings.width_log_sigma**-2
    if settings.width_log_sigma == 0.0:
        unknown = unknown[:-1]
    if only_positions:
        unknown = unknown[layout.position]
    covariance = np.linalg.inv(information[:, unknown[:, None], unknown])
    positions = np.isin(unknown, np.arange(layout.size)[layout.position])
    return np.asarray(covariance[:, positions][:, :, positions], dtype=np.float64)
