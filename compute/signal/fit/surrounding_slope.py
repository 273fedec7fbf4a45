"""Slope of the background about a group of peaks, by the pixels on both sides of its window."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from compute.signal.fit.candidate_groups import Groups
from compute.signal.fit.fit_settings import (
    MIN_SURROUNDING_PIXELS,
    SURROUNDING_LIMIT_SIGMA,
    SURROUNDING_PIXELS,
)
from compute.signal.pixel_corrections import PixelCorrections
from compute.signal.sensor_noise import SensorNoise


def take_surroundings(
    scans: NDArray[np.uint16],
    groups: Groups,
    noise: SensorNoise,
    corrections: PixelCorrections | None = None,
) -> Groups:
    """Return groups with level and slope of their surroundings, as ``FitSettings`` defines them.

    Args:
        scans: counts, shape (L, P).
        groups: all groups of the scans, in their order.
        noise: of the sensors.
        corrections: of their pixels; None: counts are taken as they are.
    """
    sensor = np.arange(len(scans)) % len(noise)
    used = scans < noise.full_scale_counts[sensor][:, None]
    counts = scans.astype(np.float64)
    if corrections is not None:
        counts = corrections.correct(scans).astype(np.float64)
        used &= ~corrections.masked[sensor]
    levels, slopes = groups.level.copy(), np.zeros(len(groups))
    for number, scan in enumerate(groups.scan.tolist()):
        first, last = int(groups.first_px[number]), int(groups.last_px[number])
        low, high = max(first - SURROUNDING_PIXELS, 0), last + 1 + SURROUNDING_PIXELS
        high = min(high, scans.shape[1])
        if number > 0 and groups.scan[number - 1] == scan:
            low = max(low, int(groups.last_px[number - 1]) + 1)
        if number + 1 < len(groups) and groups.scan[number + 1] == scan:
            high = min(high, int(groups.first_px[number + 1]))
        if min(first - low, high - last - 1) < MIN_SURROUNDING_PIXELS:
            continue
        halves = []
        for start, stop in ((low, first), (last + 1, high)):
            middle = (start + stop) // 2
            parts = (np.arange(start, middle), np.arange(middle, stop))
            halves += [part[used[scan, part]] for part in parts]
        size = np.array([len(half) for half in halves])
        if min(size[0] + size[1], size[2] + size[3]) < MIN_SURROUNDING_PIXELS or not size.all():
            continue
        level = np.array([counts[scan, half].sum() for half in halves])
        position = np.array([(half - first).sum() for half in halves])
        side_size, side_level, side_place = (
            each.reshape(2, 2).sum(axis=1) for each in (size, level, position)
        )
        means, places = side_level / side_size, side_place / side_size
        slope = (means[1] - means[0]) / (places[1] - places[0])
        own = int(sensor[scan])
        above = max(0.5 * float(means.sum()) - float(noise.offset_counts[own]), 0.0)
        variance = float(noise.dark_variance[own]) + float(noise.photon_variance[own]) * above
        straight = True
        for inner, outer in ((0, 1), (2, 3)):
            rise = level[outer] / size[outer] - level[inner] / size[inner]
            run = position[outer] / size[outer] - position[inner] / size[inner]
            limit = variance * (1.0 / size[inner] + 1.0 / size[outer])
            straight &= bool((rise - slope * run) ** 2 <= SURROUNDING_LIMIT_SIGMA**2 * limit)
        if straight:
            levels[number], slopes[number] = 0.5 * means.sum(), slope
    return replace(groups, level=levels, slope=slopes)
