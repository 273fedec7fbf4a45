"""The definition of CentroidSettings written out in NumPy: the oracle that the kernel must match.

It shares no code with the kernel, looks at every candidate on its own, and is slow.
"""

import numpy as np
from numpy.typing import NDArray

from compute.signal.noise import LineNoise
from compute.signal.peaks import PeakBatch, PeakFlag
from compute.signal.settings import (
    FRACTION_UNIT,
    GROUP_PIXELS,
    LEVEL_UNIT,
    CentroidSettings,
    sample_starts,
)

Row = tuple[float, float, float, float, int]


def find_peaks_reference(
    lines: NDArray[np.uint16], settings: CentroidSettings, noise: LineNoise
) -> PeakBatch:
    """Find the peaks of lines of shape (L, P), uint16, as ``CentroidFinder.find`` does."""
    room = settings.max_peaks
    shape = (len(lines), room)
    batch = PeakBatch(
        np.zeros(len(lines), np.int32),
        np.full(shape, np.nan),
        np.full(shape, np.nan, np.float32),
        np.full(shape, np.nan, np.float32),
        np.full(shape, np.nan, np.float32),
        np.zeros(shape, np.int32),
    )
    for number, line in enumerate(lines):
        rows = _line_peaks(line.astype(np.int64), settings, noise, number % len(noise))
        if len(rows) > room:
            brightest = sorted(rows, key=lambda row: (-row[2], row[0]))[:room]
            rows = [(*row[:4], row[4] | PeakFlag.TRUNCATED) for row in sorted(brightest)]
        batch.count[number] = len(rows)
        for k, (position, sigma, amplitude, width, flags) in enumerate(rows):
            batch.position_px[number, k] = position
            batch.sigma_px[number, k] = sigma
            batch.amplitude[number, k] = amplitude
            batch.width_px[number, k] = width
            batch.flags[number, k] = flags
    return batch


def _line_peaks(
    values: NDArray[np.int64], settings: CentroidSettings, noise: LineNoise, sensor: int
) -> list[Row]:
    """Return the line's peaks: position, sigma, amplitude, width, flags."""
    dark = float(noise.dark_variance[sensor])
    photon = float(noise.photon_variance[sensor])
    offset = float(noise.offset_counts[sensor])
    full = int(noise.full_scale_counts[sensor])
    background, spread = _background(values)
    light = max(background / LEVEL_UNIT - offset, 0.0)
    pixel_sigma = max((dark + photon * light) ** 0.5, spread / LEVEL_UNIT)
    limit = background / LEVEL_UNIT + settings.detection_sigma * pixel_sigma

    variances = dark + photon * np.maximum(values - offset, 0.0)
    rows: list[Row] = []
    for top in np.flatnonzero(values >= limit).tolist():
        excess = int(values[top]) * LEVEL_UNIT - background
        threshold = background + excess * settings.fraction_units // FRACTION_UNIT
        below = np.flatnonzero(values * LEVEL_UNIT <= threshold)
        split = int(np.searchsorted(below, top))
        left = int(below[split - 1]) + 1 if split > 0 else 0
        right = int(below[split]) - 1 if split < len(below) else len(values) - 1
        run = values[left : right + 1]
        if int(run.argmax()) + left != top or len(run) < settings.min_width_px:
            continue
        position, sigma = _centroid(
            np.arange(left, right + 1), run, threshold / LEVEL_UNIT, top - left, settings, variances
        )
        flags = PeakFlag.NONE
        if run.max() >= full:
            flags |= PeakFlag.SATURATED
        if left == 0 or right == len(values) - 1:
            flags |= PeakFlag.CLIPPED
        if _has_valley(run, variances[left : right + 1], settings.detection_sigma):
            flags |= PeakFlag.MERGED
        width = _crossing(values, right, 1, threshold) - _crossing(values, left, -1, threshold)
        rows.append((position, sigma, excess / LEVEL_UNIT, width, int(flags)))
    return rows


def _background(values: NDArray[np.int64]) -> tuple[int, int]:
    """Return the background and the spread of the line's dark part, in 1/LEVEL_UNIT counts."""
    sums = sorted(
        int(values[start : start + GROUP_PIXELS].sum()) for start in sample_starts(len(values))
    )
    quartile, sixteenth = sums[(len(sums) - 1) // 4], sums[(len(sums) - 1) // 16]
    scale = LEVEL_UNIT // GROUP_PIXELS
    return quartile * scale, (quartile - sixteenth) * scale


def _centroid(
    pixels: NDArray[np.int64],
    run: NDArray[np.int64],
    threshold: float,
    top: int,
    settings: CentroidSettings,
    variances: NDArray[np.float64],
) -> tuple[float, float]:
    """Return the centre of gravity above the threshold, and its standard deviation."""
    weights = run - threshold
    total = weights.sum()
    # Relative to the maximum: far from pixel 0 the moments would lose digits.
    relative = pixels - pixels[top]
    centre = (relative * weights).sum() / total
    if len(run) == 1:
        return float(pixels[top]), (1.0 / 12.0) ** 0.5
    jacobian = (relative - centre) / total
    # The maximum moves the threshold, and with it every weight.
    fraction = settings.fraction_units / FRACTION_UNIT
    jacobian[top] -= fraction * (relative - centre).sum() / total
    variance = (jacobian**2 * variances[pixels]).sum()
    return float(pixels[top] + centre), float(variance**0.5)


def _has_valley(
    run: NDArray[np.int64], variances: NDArray[np.float64], detection_sigma: float
) -> bool:
    """Say whether a valley lies deeper than noise below a maximum on each side of it."""
    left = np.maximum.accumulate(run)
    right = np.maximum.accumulate(run[::-1])[::-1]
    depth = np.minimum(left, right) - run
    return bool(depth.max() ** 2 > detection_sigma**2 * 2.0 * variances.max())


def _crossing(values: NDArray[np.int64], edge: int, step: int, threshold: int) -> float:
    """Return where the signal falls through the threshold beyond the run's last pixel."""
    if not 0 <= edge + step < len(values):
        return edge + step / 2
    above = float(values[edge] * LEVEL_UNIT - threshold)
    return edge + step * above / float((values[edge] - values[edge + step]) * LEVEL_UNIT)
