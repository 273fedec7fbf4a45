"""Readings: what the sensors read of a grid's points: light, noise and pattern of every line."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.planning.coverage import seen
from compute.planning.device import PlanningDevice
from compute.planning.line_bound import centre_of_gravity_sigma, position_bound
from compute.planning.pattern import pattern_error
from compute.signal.settings import CentroidSettings

Array = NDArray[np.float64]
Progress = Callable[[float], None]

_BLOCK: Final = 128  # points traced at once; between them progress is told


@dataclass(frozen=True, eq=False)
class Readings:
    """What S sensors read of N points; NaN where a sensor does not see a point.

    Args:
        cameras: perspective cameras calibrated on the exact readings.
        misfit_px: what of the distortion they leave, RMS, shape (S,) [px].
        readings_px: without noise, shape (N, S) [px].
        slope_px_per_mm: d reading / d point, shape (N, S, 3) [px/mm].
        sees: a reading on the pixels, with light; shape (N, S).
        line_electrons, peak_electrons: of the signal: whole line, brightest pixel; shape (N, S).
        saturated: the brightest pixel is full, with ambient light and dark signal; shape (N, S).
        bound_px: Cramer-Rao bound, shape (N, S) [px].
        centroid_px: what threshold and centre of gravity reach, shape (N, S) [px].
        pattern_px: error by the pixels' differences, shape (N, S) [px].
    """

    cameras: CameraStack
    misfit_px: Array
    readings_px: Array
    slope_px_per_mm: Array
    sees: NDArray[np.bool_]
    line_electrons: Array
    peak_electrons: Array
    saturated: NDArray[np.bool_]
    bound_px: Array
    centroid_px: Array
    pattern_px: Array


def read_points(device: PlanningDevice, points_mm: Array, tell: Progress) -> Readings:
    """Form the lines of points and work out how well they can be read.

    Args:
        device: the sensors.
        points_mm: shape (N, 3) [mm].
        tell: told the share done, 0 to 0.9.

    Raises:
        InvalidParameter: a sensor sees too little of the points.
    """
    blocks = [slice(start, start + _BLOCK) for start in range(0, len(points_mm), _BLOCK)]
    looks = []
    for done, block in enumerate(blocks):
        looks.append(device.look(points_mm[block]))
        tell(0.5 * (done + 1) / len(blocks))
    readings = np.concatenate([look.readings_px for look in looks])
    light = np.concatenate([look.light_sr for look in looks])
    sees = seen(readings, device.pixels, light)
    cameras, misfit = device.cameras(points_mm, readings, sees)

    electrons, peak, bound, centroid, pattern = (np.full(sees.shape, np.nan) for _ in range(5))
    for done, (block, look) in enumerate(zip(blocks, looks, strict=True)):
        lines = device.lines(look, cameras)
        per_sr = device.electrons_per_sr(points_mm[block])[..., None]
        mean, slope = lines.mean_sr * per_sr, lines.slope_sr_per_px * per_sr
        electrons[block], peak[block] = mean.sum(axis=2), mean.max(axis=2)
        if device.quantisation_px is None:
            bound[block] = position_bound(mean, slope, device.noise)
            pattern[block] = pattern_error(mean, slope, device.noise, device.pattern)
            if device.mask is None:
                centroid[block] = _by_centre_of_gravity(device, mean, sees[block])
        else:
            bound[block] = device.quantisation_px
        tell(0.5 + 0.4 * (done + 1) / len(blocks))
    for values in (electrons, peak, bound, centroid, pattern):
        values[~sees] = np.nan
    for values in (bound, pattern):
        values[~np.isfinite(values)] = np.nan
    # The well also holds what is not signal.
    full = sees & (peak + device.noise.background_electrons >= device.full_electrons)
    slopes = np.where(sees[..., None], cameras.linearised(points_mm)[1], np.nan)
    return Readings(
        cameras,
        misfit,
        np.where(sees, readings, np.nan),
        slopes,
        sees,
        electrons,
        peak,
        full,
        bound,
        centroid,
        pattern,
    )


def _by_centre_of_gravity(device: PlanningDevice, mean: Array, sees: NDArray[np.bool_]) -> Array:
    sigma = np.full(sees.shape, np.nan)
    if sees.any():
        sigma[sees] = centre_of_gravity_sigma(mean[sees], device.noise, CentroidSettings())
    return sigma
