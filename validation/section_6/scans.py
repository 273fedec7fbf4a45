"""Simulated scans of the bar's markers, and their peaks by the thesis's chain and by fit."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import SensorModel
from compute.optics.detector import Detector
from compute.optics.pixel_solid_angles import stripe_images
from compute.signal.centroid_settings import CentroidSettings
from compute.signal.fit.fit_reference import fit_scans
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.peaks import PeakBatch
from compute.signal.sensor_noise import SensorNoise
from compute.signal.thesis_pipeline.background_subtraction import PolynomialBackground
from compute.signal.thesis_pipeline.filters import ButterworthFilter
from compute.signal.thesis_pipeline.signal_chain import SignalChain

Array = NDArray[np.float64]

WIDE_PX: Final = 3.75
"""Deviation of a line: section 4.1 has bases of 20 to 25 px, which are 6 of these."""
NARROW_PX: Final = 1.5
"""That of a sharp one, for comparison."""
HEIGHT_COUNTS: Final = 160.0
"""Of 255; assumed: two of them, one over the other, are just not saturated."""
NOISE_COUNTS: Final = 3.0
"""Of a pixel without light: a videotape digitised to 8 bits; assumed."""
OFFSET_COUNTS: Final = 20.0
FULL_WELL: Final = 90_000.0
GAIN: Final = FULL_WELL / 255.0
THRESHOLD_COUNTS: Final = 40.0
"""A peak is a target's when it is higher; assumed."""
MISSED: Final = 0.02
"""Share of the frames in which a sensor does not see a target; assumed: the text says "some"."""


def line_noise() -> SensorNoise:
    """Return the noise of the lines."""
    return SensorNoise.of(GAIN, NOISE_COUNTS * GAIN, OFFSET_COUNTS, 255)


def active_lines(
    position_px: Array,
    sensor: SensorModel,
    sigma_px: float,
    missed: float,
    rng: np.random.Generator,
) -> NDArray[np.uint16]:
    """Return the lines of one sensor, of markers at positions (N, M) [px], (N, P) [counts].

    Args:
        position_px: where they are.
        sensor: for its number of pixels.
        sigma_px: of the lines.
        missed: share of the frames in which a marker's light is not there.
        rng: of light and noise.
    """
    lit = rng.uniform(size=position_px.shape) >= missed
    light = HEIGHT_COUNTS * GAIN * sigma_px * np.sqrt(2.0 * np.pi)
    image = stripe_images(
        position_px, np.full(position_px.shape, sigma_px), np.where(lit, light, 0.0), sensor.pixels
    )
    detector = Detector(
        bits=8,
        electrons_per_count=GAIN,
        offset_counts=OFFSET_COUNTS,
        read_noise_electrons=NOISE_COUNTS * GAIN,
        full_well_electrons=FULL_WELL,
        ambient_electrons=0.0,
    )
    return detector.expose(image, rng)


def thesis_points(lines: NDArray[np.uint16]) -> Array:
    """Return the centres of gravity that the thesis takes, shape (N, K) [px], NaN-padded.

    Section 6.1.2: "filtering and background removal followed by threshold subtraction". Two
    targets whose lines overlap above a third of their height are one.
    """
    chain = SignalChain(
        line_filter=ButterworthFilter(4, 0.4),
        background=PolynomialBackground(degree=2),
        weighting="above-threshold",
    )
    peaks = chain.run(lines).peaks
    high = np.where(np.isnan(peaks.amplitude), 0.0, peaks.amplitude) >= THRESHOLD_COUNTS
    kept = np.sort(np.where(high, peaks.position_px, np.nan), axis=1)
    return np.asarray(kept[:, : max(int(high.sum(axis=1).max(initial=0)), 1)])


def fitted_peaks(lines: NDArray[np.uint16], sigma_px: float) -> PeakBatch:
    """Return peaks by joint fits of lines of nearly known width: what the live path does."""
    settings = FitSettings(
        search=CentroidSettings(max_peaks=4), width_px=sigma_px, width_log_sigma=0.02
    )
    return fit_scans(lines, settings, line_noise())
