"""Three passive markers on the rotating bar, faint over a bright background: section 6.2.1."""

from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.optics.detector import Detector
from compute.optics.pixel_solid_angles import stripe_images
from compute.signal.centroid_settings import CentroidSettings
from compute.signal.detection.peak_detector import DetectionSettings, PeakDetector
from compute.signal.fit.fit_reference import fit_scans
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.peaks import PeakBatch
from compute.signal.sensor_noise import SensorNoise
from compute.signal.thesis_pipeline.area_detection import WeightedAreas
from compute.signal.thesis_pipeline.background_subtraction import PolynomialBackground
from compute.signal.thesis_pipeline.filters import ButterworthFilter
from compute.signal.thesis_pipeline.signal_chain import SignalChain
from validation.passive_detection.detection_rates import (
    READ_ELECTRONS,
    SIGNAL_TO_BACKGROUND,
    WIDTH_PX,
    line_filter,
)
from validation.section_6.rotating_bar import (
    PASSIVE_FRAMES,
    RATE_HZ,
    TURN_S,
    Motion,
    Readings,
    cameras,
    readings,
    three_passive,
)

Array = NDArray[np.float64]

BACKGROUND_ELECTRONS: Final = 40_000.0
"""Of a pixel; assumed, as the text has none: with [3.29] a marker that faces the lens stands
seven deviations above it in its highest pixel."""
FADING: Final = 0.3
"""How much of a marker's light is left where it looks furthest away; assumed. The text has "low
reflection level of the retroreflective markers"."""
FALSE_ALARMS: Final = 1.0
"""Expected number a line, chosen for our detection: four sensors can do with so many."""
SEED: Final = 62


@dataclass(frozen=True, eq=False)
class Passive:
    """The scans of all sensors.

    Args:
        motion: of the markers.
        truth: what the sensors would read.
        lines: of each sensor, (N, P) each.
    """

    motion: Motion
    truth: Readings
    lines: tuple[NDArray[np.uint16], ...]


@cache
def scans(seed: int = SEED, frames: int = PASSIVE_FRAMES) -> Passive:
    """Expose the scene."""
    rng = np.random.default_rng(seed)
    motion = three_passive(np.arange(frames) / RATE_HZ)
    truth = readings(motion, cameras())
    detector = Detector(
        bits=16,
        electrons_per_count=1.0,
        offset_counts=0.0,
        read_noise_electrons=READ_ELECTRONS,
        full_well_electrons=1e6,
        ambient_electrons=BACKGROUND_ELECTRONS,
    )
    angle = 2.0 * np.pi / TURN_S * motion.time_s
    full = (SIGNAL_TO_BACKGROUND - 1.0) * BACKGROUND_ELECTRONS * WIDTH_PX * np.sqrt(2.0 * np.pi)
    lines = []
    for k, model in enumerate(cameras()):
        phase = rng.uniform(0.0, 2.0 * np.pi, 3)
        facing = (1.0 + np.cos(angle[:, None] + phase)) / 2.0
        light = full * (FADING + (1.0 - FADING) * facing)
        position = truth.position_px[:, :, k]
        image = stripe_images(position, np.full(position.shape, WIDTH_PX), light, model.pixels)
        lines.append(detector.expose(image, rng))
    return Passive(motion, truth, tuple(lines))


@cache
def thesis_peaks(
    weighted: bool, seed: int = SEED, frames: int = PASSIVE_FRAMES
) -> tuple[Array, ...]:
    """Return the positions that low-level thresholding leaves, (N, K) of each sensor [px].

    Args:
        weighted: whether the weighted sums [6.3] to [6.5] throw areas away.
        seed: of the scene.
        frames: of the sequence.
    """
    chain = SignalChain(
        line_filter=ButterworthFilter(4, 0.4),
        background=PolynomialBackground(degree=2),
        areas=WeightedAreas() if weighted else None,
        level_fraction=WeightedAreas().level_fraction,
        weighting="above-threshold",
    )
    return tuple(chain.run(lines).peaks.position_px for lines in scans(seed, frames).lines)


@cache
def our_peaks(seed: int = SEED, frames: int = PASSIVE_FRAMES) -> tuple[PeakBatch, ...]:
    """Return peaks found by the matched filter and fitted with lines of known width."""
    # The detector's own electron a count.
    noise = SensorNoise.of(1.0, READ_ELECTRONS)
    settings = FitSettings(
        search=CentroidSettings(max_peaks=16),
        width_px=WIDTH_PX,
        width_log_sigma=0.0,
        further_peaks=False,
    )
    found = []
    for lines in scans(seed, frames).lines:
        detector = PeakDetector(
            line_filter(), lines.shape[1], DetectionSettings(FALSE_ALARMS, "line", 16), noise
        )
        batch = detector.detect(lines)
        start = PeakBatch.empty(len(lines), batch.position_px.shape[1])
        there = batch.position_px >= 0
        start.count[:] = batch.count
        start.position_px[there] = batch.position_px[there]
        start.sigma_px[there] = WIDTH_PX / batch.response_sigma[there]
        start.amplitude[there] = batch.amplitude[there]
        start.width_px[there] = 2.0 * np.sqrt(2.0 * np.log(3.0)) * WIDTH_PX
        start.flags[there] = batch.flags[there]
        found.append(fit_scans(lines, settings, noise, candidates=start))
    return tuple(found)
