"""Simulated scans for benchmarks: one peak or eight, over ambient light with noise."""

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from compute.signal.sensor_noise import SensorNoise

Lines = NDArray[np.uint16]
Positions = NDArray[np.float64]

GAIN, READ_NOISE, OFFSET, AMBIENT, HEIGHT, WIDTH_PX = 10.0, 20.0, 100.0, 20.0, 1000.0, 2.0
LIMIT_COUNTS = 30.0
"""Least height for the peers: twelve times the noise of an empty pixel."""

NOISE = SensorNoise.of(GAIN, READ_NOISE, OFFSET)


def measured_lines(
    lines: int, pixels: int, peaks: int = 1, seed: int = 1
) -> tuple[Lines, Positions]:
    """Return noisy lines, uint16 (L, P), and the peaks' true positions (L, ``peaks``) [px].

    The peaks of a line do not overlap: each has a stretch of the line to itself.
    """
    rng = np.random.default_rng(seed)
    stretch = pixels / peaks
    centre = rng.uniform(20.0, stretch - 20.0, (lines, peaks))
    position = centre + stretch * np.arange(peaks)
    dark = np.hypot(READ_NOISE / GAIN, np.sqrt(AMBIENT / GAIN))
    block = rng.normal(OFFSET + AMBIENT, dark, (256, pixels))
    # Large batches repeat the noise of 256 lines: drawing all of it would take minutes.
    rows = np.resize(np.rint(block), (lines, pixels)).astype(np.uint16)
    first = position.astype(np.int64) - 12
    edges = first[..., None] + np.arange(26) - 0.5
    mean = np.diff(ndtr((edges - position[..., None]) / WIDTH_PX), axis=2)
    counts = rng.poisson(mean * HEIGHT * WIDTH_PX * np.sqrt(2 * np.pi) * GAIN) / GAIN
    columns = first[..., None] + np.arange(25)
    rows[np.arange(lines)[:, None, None], columns] += np.rint(counts).astype(np.uint16)
    return rows, position
