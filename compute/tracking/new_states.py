"""States of new tracks: a place by readings of three sensors or more, any speed and direction."""

import numpy as np
from numpy.typing import NDArray

from compute.tracking.motion_model import STATES, MotionModels
from compute.tracking.reading_model import ReadingModel
from compute.tracking.settings import TrackerSettings
from compute.tracking.states import States

Array = NDArray[np.float64]


def new_states(
    model: ReadingModel,
    motion: MotionModels,
    settings: TrackerSettings,
    place_mm: Array,
    sigma_px: Array,
) -> tuple[States, Array]:
    """Return the states of markers just seen, and the covariance of the constant errors there.

    The place has the covariance of the readings' weighted least squares, and the covariance with
    the sensors' constant errors that this solution gives it.

    Args:
        model: of the readings.
        motion: M models.
        settings: deviations of speed and acceleration at the start.
        place_mm: shape (N, 3).
        sigma_px: of the readings that made the places, shape (N, S); NaN where there is none.

    Returns:
        The states, and the constant errors' covariance, shape (N, S, S) [px^2].
    """
    count, sensors = sigma_px.shape
    used = np.isfinite(sigma_px)
    bias = model.bias_covariance(place_mm)
    slope = np.where(used[..., None], model.predict(place_mm).slope, 0.0)
    both = used[:, :, None] & used[:, None, :]
    noise = np.where(both, bias, 0.0)
    diagonal = np.arange(sensors)
    noise[:, diagonal, diagonal] += np.where(used, sigma_px, 1.0) ** 2
    weighted = np.linalg.solve(noise, slope).swapaxes(-1, -2)
    place = np.linalg.inv(weighted @ slope)
    with_bias = -(place @ weighted) @ bias

    models = len(motion)
    mean = np.zeros((count, models, STATES))
    mean[..., :3] = place_mm[:, None]
    covariance = np.zeros((count, models, STATES, STATES))
    covariance[..., :3, :3] = place[:, None]
    axes = np.arange(3)
    covariance[..., 3 + axes, 3 + axes] = settings.start_speed_mm_s**2
    for own, has in enumerate(motion.with_acceleration):
        if has:
            covariance[:, own, 6 + axes, 6 + axes] = settings.start_acceleration_mm_s2**2
    biased = np.zeros((count, models, STATES, sensors))
    biased[..., :3, :] = with_bias[:, None]
    return States(mean, covariance, biased, np.full((count, models), 1.0 / models)), bias
