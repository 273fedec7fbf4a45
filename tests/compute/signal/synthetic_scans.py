"""Line scans to test with: Gaussian lines over ambient light, and lines that are not like that."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from compute.signal.peaks import PeakBatch
from compute.signal.sensor_noise import SensorNoise

GAIN, READ, OFFSET, FULL = 10.0, 20.0, 100.0, 4095
NOISE = SensorNoise.of(GAIN, READ, OFFSET, FULL)


def gaussian_counts(
    pixels: int, position_px: ArrayLike, width_px: ArrayLike, height: ArrayLike
) -> NDArray[np.float64]:
    """Mean counts of Gaussian lines, integrated over each pixel; one row for each position."""
    position, width, size = (
        np.atleast_1d(np.asarray(values, float))[:, None]
        for values in (position_px, width_px, height)
    )
    edges = np.arange(pixels + 1) - 0.5
    shares = np.diff(ndtr((edges - position) / width), axis=1)
    return size * width * np.sqrt(2 * np.pi) * shares


def measured(
    counts: NDArray[np.float64],
    rng: np.random.Generator,
    ambient: float = 20.0,
    full: int = 65535,
) -> NDArray[np.uint16]:
    """Lines as a sensor of NOISE reads them: photon noise, read noise, offset, whole counts."""
    electrons = rng.poisson((counts + ambient) * GAIN) + rng.normal(0.0, READ, counts.shape)
    return np.clip(np.rint(electrons / GAIN + OFFSET), 0, full).astype(np.uint16)


def varied_lines(lines: int, pixels: int, rng: np.random.Generator) -> NDArray[np.uint16]:
    """Lines of every kind: none to many peaks, saturated, at the edges, merged, flat, random."""
    rows = np.empty((lines, pixels), np.uint16)
    for number in range(lines):
        match number % 8:
            case 0:
                rows[number] = rng.choice([0, 300, 4095, 65535])
            case 1:
                rows[number] = rng.integers(0, 65536, pixels)
            case 2:
                # Noise with a few pixels at the extremes.
                rows[number] = rng.integers(95, 106, pixels)
                rows[number, rng.integers(0, pixels, 6)] = rng.choice([0, 4095, 65535], 6)
            case kind:
                count = (1, 2, 6, 20, 60)[kind - 3]
                peaks = gaussian_counts(
                    pixels,
                    rng.uniform(-5, pixels + 5, count),
                    rng.uniform(0.5, 6.0, count),
                    10 ** rng.uniform(1, 4.2, count),
                )
                rows[number] = measured(peaks.sum(axis=0, keepdims=True), rng, full=FULL)[0]
    return rows


def assert_same(found: PeakBatch, expected: PeakBatch) -> None:
    """The same peaks and flags exactly; figures to the last digits of their types."""
    np.testing.assert_array_equal(found.count, expected.count)
    np.testing.assert_array_equal(found.flags, expected.flags)
    np.testing.assert_array_equal(found.amplitude, expected.amplitude)
    np.testing.assert_allclose(found.position_px, expected.position_px, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.width_px, expected.width_px, rtol=1e-6)
    np.testing.assert_allclose(found.sigma_px, expected.sigma_px, rtol=1e-5)
