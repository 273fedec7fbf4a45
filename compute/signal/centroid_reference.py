"""Threshold and centre of gravity in NumPy: the definition that the kernel must match.

It shares no code with the kernel, looks at every candidate on its own, and is slow.
"""

import numpy as np
from numpy.typing import NDArray

from compute.signal.centroid_settings import (
    FRACTION_UNIT,
    GROUP_PIXELS,
    LEVEL_UNIT,
    SAMPLE_GROUPS,
    CentroidSettings,
    sample_starts,
)
from compute.signal.native.definitions import RAMP_UNIT
from compute.signal.peaks import PeakBatch, PeakFlag
from compute.signal.pixel_corrections import PixelCorrections
from compute.signal.sensor_noise import SensorNoise

Row = tuple[float, float, float, float, int]


def find_peaks_reference(
    scans: NDArray[np.uint16],
    settings: CentroidSettings,
    noise: SensorNoise,
    corrections: PixelCorrections | None = None,
) -> PeakBatch:
    """Find the peaks of scans as ``CentroidFinder.find`` does, plainly and slowly.

    Args:
        scans: counts, uint16, shape (L, P); scan l is of sensor ``l % len(noise)``.
        settings: what counts as a peak, and where it is cut.
        noise: noise of the sensors.
        corrections: of their pixels; None: counts are taken as they are.
    """
    room = settings.max_peaks
    batch = PeakBatch.empty(len(scans), room)
    for number, scan in enumerate(scans):
        rows = _line_peaks(scan.astype(np.int64), settings, noise, number % len(noise), corrections)
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


def background_levels(
    scans: NDArray[np.uint16], corrections: PixelCorrections | None = None
) -> NDArray[np.float64]:
    """Return the backgrounds of scans by their dark parts, shape (L,) [counts].

    Args:
        scans: counts, uint16, shape (L, P).
        corrections: of the sensors' pixels; None: counts are taken as they are.
    """
    none = np.zeros((1, SAMPLE_GROUPS), np.int64)
    shifts = none if corrections is None else corrections.group_shifts().astype(np.int64)
    return np.array(
        [
            scan_background(scan.astype(np.int64), shifts[number % len(shifts)])[0] / LEVEL_UNIT
            for number, scan in enumerate(scans)
        ]
    )


def _line_peaks(
    raw: NDArray[np.int64],
    settings: CentroidSettings,
    noise: SensorNoise,
    sensor: int,
    corrections: PixelCorrections | None,
) -> list[Row]:
    """Return the scan's peaks: position, sigma, amplitude, width, flags."""
    dark = float(noise.dark_variance[sensor])
    photon = float(noise.photon_variance[sensor])
    offset = float(noise.offset_counts[sensor])
    full = int(noise.full_scale_counts[sensor])
    raw_values, values, shifts = raw, raw, np.zeros(SAMPLE_GROUPS, np.int64)
    if corrections is not None:
        sensor_corrections = PixelCorrections(
            *(each[sensor : sensor + 1] for each in vars(corrections).values())
        )
        rounded = np.floor(
            sensor_corrections.correct(raw[None].astype(np.uint16))[0] + np.float32(0.5)
        )
        values = np.clip(rounded, 0, 65535).astype(np.int64)
        shifts = sensor_corrections.group_shifts()[0].astype(np.int64)
        raw = np.where(sensor_corrections.masked[0], 0, raw)
    background, noise_level, ramp = scan_background(raw_values, shifts)
    rise = _ramp_at(ramp, len(values), np.arange(len(values)))
    values = np.clip(values - rise, 0, 65535)
    light = max(background / LEVEL_UNIT - offset, 0.0)
    pixel_sigma = max((dark + photon * light) ** 0.5, noise_level / LEVEL_UNIT)
    limit = background / LEVEL_UNIT + settings.detection_sigma * pixel_sigma

    variances = dark + photon * np.maximum(values - offset, 0.0)
    rows: list[Row] = []
    bright = (values >= limit) & (raw_values - rise >= limit)
    for top in np.flatnonzero(bright).tolist():
        excess = int(values[top]) * LEVEL_UNIT - background
        local = max(background / LEVEL_UNIT + int(rise[top]) - offset, 0.0)
        if ramp and excess / LEVEL_UNIT < settings.detection_sigma * (dark + photon * local) ** 0.5:
            continue
        threshold = background + excess * settings.fraction_units // FRACTION_UNIT
        below = np.flatnonzero(values * LEVEL_UNIT <= threshold)
        split = int(np.searchsorted(below, top))
        left = int(below[split - 1]) + 1 if split > 0 else 0
        right = int(below[split]) - 1 if split < len(below) else len(values) - 1
        run = values[left : right + 1]
        if int(run.argmax()) + left != top or len(run) < settings.min_width_px:
            continue
        position, sigma = _centroid(
            values, left, right, top, background / LEVEL_UNIT, settings, variances
        )
        flags = PeakFlag.NONE
        if raw[top] >= full:
            flags |= PeakFlag.SATURATED
        if left == 0 or right == len(values) - 1:
            flags |= PeakFlag.CLIPPED
        if _has_valley(run, variances[left : right + 1], settings.detection_sigma):
            flags |= PeakFlag.MERGED
        width = _crossing(values, right, 1, threshold) - _crossing(values, left, -1, threshold)
        rows.append((position, sigma, excess / LEVEL_UNIT, width, int(flags)))
    return rows


def scan_background(
    values: NDArray[np.int64], shifts: NDArray[np.int64] | None = None
) -> tuple[int, int, int]:
    """Return background, noise level [1/LEVEL_UNIT counts] and slope [1/RAMP_UNIT counts per px].

    The background is that of the scan's dark part, in its middle where there is a slope.

    Args:
        values: counts of a scan, int64, shape (P,).
        shifts: what its groups of pixels differ by for their pixels' sake, from
            ``PixelCorrections.group_shifts``; None: nothing.
    """
    starts = sample_starts(len(values))
    shifts = np.zeros(len(starts), np.int64) if shifts is None else shifts
    sums = [
        max(int(values[start : start + GROUP_PIXELS].sum() - shift), 0)
        for start, shift in zip(starts, shifts, strict=False)
    ]
    groups = len(sums)
    scale = LEVEL_UNIT // GROUP_PIXELS
    order = np.argsort(sums, kind="stable")
    first, low = (groups - 1) // 4, (groups - 1) // 16
    quartile, sixteenth = sums[order[first]], sums[order[low]]
    contrast = int((2 * order[: first + 1] - (groups - 1)).sum())
    farthest = (first + 1) * (groups - first - 1)
    ramp = 0
    if contrast**2 >= min(10 * farthest * (groups + 1) // 3, farthest**2):
        part = groups // 4
        dark = [sorted(sums[q * part : (q + 1) * part])[(part - 1) // 4] for q in range(4)]
        part_start = [starts[q * part] + starts[(q + 1) * part - 1] for q in range(4)]
        slopes = sorted(
            int(
                (dark[b] - dark[a])
                * 2
                * RAMP_UNIT
                // GROUP_PIXELS
                / (part_start[b] - part_start[a])
            )
            for a in range(4)
            for b in range(a + 1, 4)
        )
        ramp = int((slopes[2] + slopes[3]) / 2)
        at = np.array(starts)
        ends = _ramp_at(ramp, len(values), at) + _ramp_at(ramp, len(values), at + GROUP_PIXELS - 1)
        beside = sorted(np.maximum(np.array(sums) - GROUP_PIXELS // 2 * ends, 0).tolist())
        if ramp and beside[first] - beside[low] < quartile - sixteenth:
            quartile, sixteenth = beside[first], beside[low]
        else:
            ramp = 0
    return quartile * scale, (quartile - sixteenth) * scale, ramp


def _ramp_at(ramp: int, pixels: int, pixel: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return what the background rises from the middle to pixels, rounded to zero."""
    rise = ramp * (2 * pixel - (pixels - 1))
    return np.asarray(np.sign(rise) * (np.abs(rise) // (2 * RAMP_UNIT)))


def _centroid(
    values: NDArray[np.int64],
    left: int,
    right: int,
    top: int,
    background: float,
    settings: CentroidSettings,
    variances: NDArray[np.float64],
) -> tuple[float, float]:
    """Return the centre of gravity and its standard deviation."""
    # From one pixel outside on; positions relative to the maximum: far off, digits would be lost.
    first, last = max(left - 1, 0), min(right + 1, len(values) - 1)
    profile = values[first : last + 1].astype(np.complex128)
    ends = (left - first, right - first, top - first)
    centre = _centre(profile, ends, background, settings)
    if left == right:
        return top + centre.real, (1.0 / 12.0) ** 0.5
    # The derivative by each value, by a step along the imaginary axis: exact, and blind to how
    # the kernel does it.
    step = 1e-100
    variance = 0.0
    for pixel in range(len(profile)):
        moved = profile.copy()
        moved[pixel] += 1j * step
        derivative = _centre(moved, ends, background, settings).imag / step
        variance += derivative**2 * float(variances[first + pixel])
    variance += _phase_variance(profile.real, ends, float(centre.real), background, settings)
    return top + centre.real, variance**0.5


def _phase_variance(
    profile: NDArray[np.float64],
    ends: tuple[int, int, int],
    centre: float,
    background: float,
    settings: CentroidSettings,
) -> float:
    """Return the variance of the error by where the run's ends fall between two pixels."""
    left, right, top = ends
    excess = int(profile[top]) * LEVEL_UNIT - round(background * LEVEL_UNIT)
    threshold = background + excess * settings.fraction_units // FRACTION_UNIT / LEVEL_UNIT
    run = profile[left : right + 1]
    total = float(
        (run - (background if settings.weighting == "above-background" else threshold)).sum()
    )
    variance = 0.0
    corrected = total
    for end, side in ((left, -1), (right, 1)):
        if not 0 <= end + side < len(profile):
            continue
        slope = profile[end] - profile[end + side]
        inside = (profile[end] - threshold) / slope
        corrected += slope / 2 * (inside**2 - inside + 1 / 6)
        arm = end - top + side * inside - centre
        match settings.weighting:
            case "above-background":
                variance += ((threshold - background) * arm) ** 2 / 12
            case "above-threshold":
                variance += (slope * arm / 2) ** 2 / 180
            case "edge-corrected":
                variance += (slope * 2 / 3) ** 2 / 840
    if settings.weighting == "edge-corrected":
        total = corrected
    return float(variance) / total**2


def _centre(
    profile: NDArray[np.complex128],
    ends: tuple[int, int, int],
    background: float,
    settings: CentroidSettings,
) -> complex:
    """Return the centre of gravity relative to the maximum, as an analytic function of values."""
    left, right, top = ends
    # The threshold as decided on, in whole units, with the derivative of its formula.
    excess = int(profile[top].real) * LEVEL_UNIT - round(background * LEVEL_UNIT)
    threshold = (
        background
        + excess * settings.fraction_units // FRACTION_UNIT / LEVEL_UNIT
        + 1j * profile[top].imag * settings.fraction_units / FRACTION_UNIT
    )
    base = background if settings.weighting == "above-background" else threshold
    weights = profile[left : right + 1] - base
    positions = np.arange(left - top, right - top + 1)
    total = complex(weights.sum())
    moment = complex((positions * weights).sum())
    if settings.weighting == "edge-corrected":
        for end, side in ((left, -1), (right, 1)):
            if 0 <= end + side < len(profile):
                slope = complex(profile[end] - profile[end + side])
                inside = complex(profile[end] - threshold) / slope
                excess_at_end = slope / 2 * (inside**2 - inside + 1 / 6)
                total += excess_at_end
                moment += excess_at_end * (end - top + side * inside)
    return moment / total


def _has_valley(
    run: NDArray[np.int64], variances: NDArray[np.float64], detection_sigma: float
) -> bool:
    """Say whether a valley lies deeper than noise below a maximum on each side of it."""
    left_max = np.maximum.accumulate(run)
    right = np.maximum.accumulate(run[::-1])[::-1]
    depth = np.minimum(left_max, right) - run
    return bool(depth.max() ** 2 > detection_sigma**2 * 2.0 * variances.max())


def _crossing(values: NDArray[np.int64], edge: int, step: int, threshold: int) -> float:
    """Return where the signal falls through the threshold beyond the run's last pixel."""
    if not 0 <= edge + step < len(values):
        return edge + step / 2
    above = float(values[edge] * LEVEL_UNIT - threshold)
    return edge + step * above / float((values[edge] - values[edge + step]) * LEVEL_UNIT)
