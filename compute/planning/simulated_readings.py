"""Simulated readings of a grid of points: light, noise and pattern of every stripe."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.planning.coverage import is_visible
from compute.planning.cramer_rao import centre_of_gravity_sigma
from compute.planning.fixed_pattern_noise import fixed_pattern_sigma
from compute.planning.planning_device import PlanningDevice
from compute.signal.centroid_settings import CentroidSettings
from compute.signal.cramer_rao import position_bound

Array = NDArray[np.float64]
Progress = Callable[[float], None]

_BATCH_POINTS: Final = 128  # points traced at once, between progress reports


@dataclass(frozen=True, eq=False)
class SimulatedReadings:
    """Readings of N points by S sensors; NaN where a sensor does not see a point.

    Args:
        cameras: perspective cameras calibrated on the exact readings.
        misfit_px: what of the distortion they leave, RMS, shape (S,) [px].
        readings_px: without noise, shape (N, S) [px].
        gradient_px_per_mm: d reading / d point, shape (N, S, 3) [px/mm].
        visible: a reading on the pixels, with light; shape (N, S).
        scan_electrons, peak_electrons: of the signal: whole line, brightest pixel; shape (N, S).
        saturated: the brightest pixel is full, with ambient light and dark signal; shape (N, S).
        bound_px: Cramer-Rao bound, shape (N, S) [px].
        centroid_px: what threshold and centre of gravity reach, shape (N, S) [px].
        pattern_px: error by the pixels' differences, shape (N, S) [px].
    """

    cameras: CameraStack
    misfit_px: Array
    readings_px: Array
    gradient_px_per_mm: Array
    visible: NDArray[np.bool_]
    scan_electrons: Array
    peak_electrons: Array
    saturated: NDArray[np.bool_]
    bound_px: Array
    centroid_px: Array
    pattern_px: Array


def simulate_readings(
    device: PlanningDevice, points_mm: Array, progress: Progress
) -> SimulatedReadings:
    """Form the stripes of points and compute the precision of their readings.

    Args:
        device: the sensors.
        points_mm: shape (N, 3) [mm].
        progress: called with the fraction done, 0 to 0.9.

    Raises:
        InvalidParameter: a sensor sees too little of the points.
    """
    blocks = [
        slice(start, start + _BATCH_POINTS) for start in range(0, len(points_mm), _BATCH_POINTS)
    ]
    images = []
    for done, block in enumerate(blocks):
        images.append(device.image_points(points_mm[block]))
        progress(0.5 * (done + 1) / len(blocks))
    readings = np.concatenate([image.readings_px for image in images])
    light = np.concatenate([image.light_sr for image in images])
    visible = is_visible(readings, device.pixels, light)
    cameras, misfit = device.cameras(points_mm, readings, visible)

    electrons, peak, bound, centroid, pattern = (np.full(visible.shape, np.nan) for _ in range(5))
    for done, (block, image) in enumerate(zip(blocks, images, strict=True)):
        lines = device.lines(image, cameras)
        per_sr = device.electrons_per_sr(points_mm[block])[..., None]
        mean, derivative = lines.mean_sr * per_sr, lines.slope_sr_per_px * per_sr
        electrons[block], peak[block] = mean.sum(axis=2), mean.max(axis=2)
        if device.quantisation_px is None:
            bound[block] = position_bound(mean, derivative, device.noise.variance_electrons2)
            pattern[block] = fixed_pattern_sigma(mean, derivative, device.noise, device.pattern)
            if device.mask is None:
                centroid[block] = _by_centre_of_gravity(device, mean, visible[block])
        else:
            bound[block] = device.quantisation_px
        progress(0.5 + 0.4 * (done + 1) / len(blocks))
    for values in (electrons, peak, bound, centroid, pattern):
        values[~visible] = np.nan
    for values in (bound, pattern):
        values[~np.isfinite(values)] = np.nan
    # The well also holds what is not signal.
    full = visible & (peak + device.noise.background_electrons >= device.full_electrons)
    jacobian = np.where(visible[..., None], cameras.linearise(points_mm)[1], np.nan)
    return SimulatedReadings(
        cameras,
        misfit,
        np.where(visible, readings, np.nan),
        jacobian,
        visible,
        electrons,
        peak,
        full,
        bound,
        centroid,
        pattern,
    )


def _by_centre_of_gravity(device: PlanningDevice, mean: Array, visible: NDArray[np.bool_]) -> Array:
    sigma = np.full(visible.shape, np.nan)
    if visible.any():
        sigma[visible] = centre_of_gravity_sigma(mean[visible], device.noise, CentroidSettings())
    return sigma
