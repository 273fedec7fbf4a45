"""Peers of the peak benchmark on the CPU: NumPy, SciPy, numba."""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import signal

from benchmarks.synthetic_scans import LIMIT_COUNTS, Lines, Positions


def by_find_peaks(lines: Lines) -> Positions:
    """scipy.signal.find_peaks on each line, then [4.1] in NumPy around the highest peak."""
    result = np.full(len(lines), np.nan)
    for number, line in enumerate(lines):
        values = line - np.median(line)
        tops, found = signal.find_peaks(values, height=LIMIT_COUNTS)
        if not len(tops):
            continue
        top = int(tops[found["peak_heights"].argmax()])
        below = np.flatnonzero(values <= values[top] / 3)
        split = int(np.searchsorted(below, top))
        left = int(below[split - 1]) + 1 if split else 0
        right = int(below[split]) if split < len(below) else len(values)
        weights = values[left:right] - values[top] / 3
        result[number] = (np.arange(left, right) * weights).sum() / weights.sum()
    return result


def by_numpy(lines: Lines) -> Positions:
    """Vectorised NumPy: everything above a third of the line's maximum is one peak."""
    values = lines.astype(np.float32)
    values -= np.median(values[:, ::8], axis=1, keepdims=True)
    weights = values - values.max(axis=1, keepdims=True) / 3
    np.maximum(weights, 0.0, out=weights)
    total = weights.sum(axis=1, dtype=np.float64)
    moment = weights @ np.arange(lines.shape[1], dtype=np.float32)
    positions: Positions = moment / total
    return positions


def numba_method() -> Callable[[Lines], Positions] | None:
    """Return the same with numba's parallel loop, compiled; None where numba is not installed.

    The loop for the maximum is one that the compiler vectorises; around the maximum only the run
    of pixels above a third of it is visited.
    """
    try:
        import numba
    except ImportError:
        return None

    def centres(lines: Lines) -> Any:
        count, pixels = lines.shape
        result = np.empty(count)
        for number in numba.prange(count):
            line = lines[number]
            # The background: the mean of the lowest of 32 groups of 8 pixels.
            base = np.int64(1 << 30)
            for group in range(32):
                total = np.int64(0)
                for p in range(8):
                    total += line[group * (pixels - 8) // 31 + p]
                base = min(base, total)
            background = base / 8.0
            most = np.uint16(0)
            for p in range(pixels):
                most = max(most, line[p])
            top = 0
            while line[top] != most:
                top += 1
            cut = background + (most - background) / 3.0
            left = top
            while left > 0 and line[left - 1] > cut:
                left -= 1
            total_weight, moment = 0.0, 0.0
            p = left
            while p < pixels and line[p] > cut:
                total_weight += line[p] - cut
                moment += (line[p] - cut) * p
                p += 1
            result[number] = moment / total_weight if total_weight > 0.0 else np.nan
        return result

    compiled: Callable[[Lines], Positions] = numba.njit(parallel=True)(centres)
    return compiled
