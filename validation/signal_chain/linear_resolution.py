"""Linear resolution test of section 4.2.2: an LED displaced before a camera."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.optics.detector import Detector
from compute.optics.pixel_solid_angles import stripe_images
from compute.signal.centroid_settings import Weighting
from compute.signal.thesis_pipeline.signal_chain import SignalChain
from compute.signal.thesis_pipeline.steps import ScanFilter

Array = NDArray[np.float64]

PIXELS: Final = 512
PX_PER_MM: Final = 1.39
"""The slope of Tables C.1 to C.3."""

CENTRE_PX: Final = 309.4
"""Where the LED at 0 mm is: the first line of Tables C.1 to C.3."""

SIGMA_PX: Final = 3.75
"""Of the line's Gaussian shape: a base of 20 to 25 px (section 4.1) is 6 of these."""

PEAK_COUNTS: Final = 200.0
"""Of 255: bright, not saturated (Figures 4.6 and 4.7 are lost)."""

OFFSET_COUNTS: Final = 40.0
FULL_WELL: Final = 60_000.0
GAIN: Final = FULL_WELL / 255.0

MATCHED_COUNTS: Final = 15.8
"""The pixels' noise for which the raw centroids scatter as those of Table C.2 do."""

JUMPING_COUNTS: Final = 6.0
"""A noise for which [4.1] without the threshold subtracted scatters as the filtered columns do."""

CAMERA_COUNTS: Final = 1.0
"""The read noise of a decent 8-bit camera, for comparison."""


@dataclass(frozen=True)
class Laboratory:
    """A camera's line and its noise.

    Args:
        noise_counts: standard deviation of the pixels' noise without light; shot noise and the
            rounding to 8 bits come on top; None: neither of them.
        weighting: how the centre of gravity weighs.
        sigma_px: of the line's Gaussian shape.
    """

    noise_counts: float | None
    weighting: Weighting = "above-threshold"
    sigma_px: float = SIGMA_PX

    def lines_at(self, position_px: Array) -> Array:
        """Return noiseless lines of markers at positions (N,) [px], shape (N, 512) [counts]."""
        return np.asarray(self._image(position_px) / GAIN)

    def lines(self, position_mm: Array, repeats: int, seed: int) -> Array:
        """Return lines of the LED at positions (N,), shape (repeats * N, 512) [counts]."""
        image = self._image(np.tile(CENTRE_PX + PX_PER_MM * position_mm, repeats))
        if self.noise_counts is None:
            return np.asarray(image / GAIN)
        detector = Detector(
            bits=8,
            electrons_per_count=GAIN,
            # Dark enough for no noise to be cut off, as a camera's black level is set.
            offset_counts=OFFSET_COUNTS,
            read_noise_electrons=self.noise_counts * GAIN,
            full_well_electrons=FULL_WELL,
            ambient_electrons=0.0,
        )
        counts = detector.expose(image, np.random.default_rng(seed))
        return np.asarray(counts - OFFSET_COUNTS)

    def _image(self, position_px: Array) -> Array:
        light = PEAK_COUNTS * GAIN * self.sigma_px * np.sqrt(2.0 * np.pi)
        at = position_px[:, None]
        return stripe_images(at, np.full_like(at, self.sigma_px), np.full_like(at, light), PIXELS)

    def centroids_px(self, lines: Array, line_filter: ScanFilter | None) -> tuple[Array, Array]:
        """Return the pixels of the maxima and the centres of gravity of lines, shape (L,) each."""
        # One marker: only the highest peak matters.
        chain = SignalChain(line_filter=line_filter, level_fraction=0.95, weighting=self.weighting)
        result = chain.run(lines)
        peaks = result.peaks
        best = np.nanargmax(np.nan_to_num(peaks.amplitude, nan=-1.0), axis=1)
        centroid = peaks.position_px[np.arange(len(lines)), best]
        top = result.stages[-1].scans.argmax(axis=1).astype(np.float64)
        return top, centroid


@dataclass(frozen=True)
class LineFit:
    """How positions follow a straight line.

    Args:
        slope: [px/mm].
        rms_px: root mean square about the line, by the N - 2 degrees of freedom [px].
        residual_px: shape (N,).
    """

    slope: float
    rms_px: float
    residual_px: Array


def fit_line(position_mm: Array, centroid_px: Array) -> LineFit:
    """Fit a straight line to positions (N,)."""
    slope, intercept = np.polyfit(position_mm, centroid_px, 1)
    residual = centroid_px - (slope * position_mm + intercept)
    rms = float(np.sqrt((residual**2).sum() / (len(residual) - 2)))
    return LineFit(float(slope), rms, residual)


def ascending_neighbours(values: Array) -> int:
    """Return how many of the N - 1 values that have one before them are larger than it."""
    return int((np.diff(values) > 0.0).sum())


def longest_ascending(values: Array) -> int:
    """Return how many values, others left out, stand in ascending order at most."""
    tails: list[float] = []
    for value in values.tolist():
        index = int(np.searchsorted(tails, value))
        tails[index : index + 1] = [value]
    return len(tails)
