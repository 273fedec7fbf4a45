"""Detection rates of faint passive markers over a bright background."""

from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import ndtr
from scipy.stats import norm, qmc

from compute.signal.detection.matched_filter import MatchedFilter, gaussian_filter, gaussian_shape
from compute.signal.detection.peak_detector import DetectionBatch, DetectionSettings, PeakDetector
from compute.signal.sensor_noise import SensorNoise

Array = NDArray[np.float64]

SIGNAL_TO_BACKGROUND: Final = 1.035
"""[3.29], cylindrical lens: the target's intensity by its background's."""
PIXELS: Final = 640
"""Section 3.6: the frame grabber's."""
WIDTH_PX: Final = 2.0
READ_ELECTRONS: Final = 10.0
FALSE_ALARMS: Final = (0.001, 0.01, 0.1, 1.0)
LINES: Final = 4000
NEAR_PX: Final = 4
"""A detection is the marker's within two widths of it."""

_PHASES: Final = 8
_DRAWS: Final = 1 << 13
_EDGE_PX: Final = 40


@dataclass(frozen=True)
class Scene:
    """A marker over an even background, on the sum of some lines.

    Args:
        background_electrons: mean light of a pixel in one line.
        lines: how many lines are added up.
    """

    background_electrons: float
    lines: int = 1

    @property
    def level(self) -> float:
        """Mean electrons of a dark pixel in the sum."""
        return self.background_electrons * self.lines

    @property
    def variance(self) -> float:
        """Variance of a dark pixel in the sum [electrons^2]: photons, reading, rounding."""
        return self.level + self.lines * (READ_ELECTRONS**2 + 1.0 / 12.0)

    def marker(self, shape: Array) -> Array:
        """Return the marker's electrons, from a shape of unit area, any shape."""
        highest = float(gaussian_shape(WIDTH_PX, 0)[0])
        return (SIGNAL_TO_BACKGROUND - 1.0) * self.level * shape / highest

    @property
    def pixel_snr(self) -> float:
        """Signal-to-noise ratio of the marker's highest pixel, centred on it."""
        return (SIGNAL_TO_BACKGROUND - 1.0) * self.level / float(np.sqrt(self.variance))

    @property
    def snr(self) -> float:
        """Signal-to-noise ratio of the matched filter's answer there."""
        return self.pixel_snr * line_filter().snr_of_pixel_snr


@dataclass(frozen=True)
class Share:
    """How often something was seen, and should be.

    Args:
        measured: share of the lines, or number per line.
        expected: by theory.
        deviations: difference in standard errors, binomial or Poisson.
    """

    measured: float
    expected: float
    deviations: float


@dataclass(frozen=True)
class Point:
    """One point of an operating curve: false alarms and detections at a threshold.

    Args:
        threshold_sigma: threshold in standard deviations.
        false_alarms: per empty line.
        detections: share of the markers found within NEAR_PX.
        at_place: Q(t - SNR), the chance that the answer at the marker's own place is enough.
    """

    threshold_sigma: float
    false_alarms: Share
    detections: Share
    at_place: float


@cache
def line_filter() -> MatchedFilter:
    """Return the matched filter of the markers."""
    return gaussian_filter(WIDTH_PX)


@lru_cache(maxsize=10)
def scanned(scene: Scene, seed: int) -> tuple[NDArray[np.uint16], NDArray[np.uint16], Array]:
    """Return empty lines, lines with a marker each, (LINES, PIXELS), and where those are [px].

    The sum of lines is drawn as what it is, Poisson light and Gaussian noise of more variance.
    One electron is one count.
    """
    rng = np.random.default_rng(seed)
    position = rng.uniform(_EDGE_PX, PIXELS - 1 - _EDGE_PX, LINES)
    edges = np.arange(PIXELS + 1) - 0.5
    shape = np.diff(ndtr((edges - position[:, None]) / WIDTH_PX), axis=1)
    read = np.sqrt(scene.lines * (READ_ELECTRONS**2 + 1.0 / 12.0) - 1.0 / 12.0)

    def read_out(light: Array) -> NDArray[np.uint16]:
        electrons = rng.poisson(light) + rng.normal(0.0, read, light.shape)
        return np.rint(electrons).clip(0, 65535).astype(np.uint16)

    empty = read_out(np.full((LINES, PIXELS), scene.level))
    return empty, read_out(scene.level + scene.marker(shape)), position


@cache
def by_filter(scene: Scene, rate: float, seed: int = 1) -> Point:
    """Return the matched filter's point at a chosen number of false alarms per line."""
    # The deviation is known: given as read noise, over an offset that leaves no photon noise.
    known = SensorNoise.of(1.0, np.sqrt(scene.variance - 1.0 / 12.0), 65535.0)
    detector = PeakDetector(line_filter(), PIXELS, DetectionSettings(rate, "model", 64), known)
    empty, marked, position = scanned(scene, seed)
    alarms = int(detector.detect(empty).count.sum())
    found = detector.detect(marked)
    threshold = detector.threshold_sigma
    return Point(
        threshold,
        _counted(alarms, rate * alarms_by_skewness(scene, threshold)),
        _seen(_near(found, position), filter_detection_probability(scene, threshold)),
        float(norm.sf(threshold - scene.snr)),
    )


@cache
def by_own_noise(scene: Scene, rate: float, seed: int = 1) -> float:
    """Return the share detected where the noise is measured in each line."""
    detector = PeakDetector(
        line_filter(), PIXELS, DetectionSettings(rate, "line", 64), SensorNoise.of(1.0, 0.0)
    )
    _, marked, position = scanned(scene, seed)
    found = detector.detect(marked)
    return float(_near(found, position).mean())


@cache
def by_pixel(scene: Scene, rate: float, seed: int = 1) -> Point:
    """Return the point of a threshold on single pixels over a background that is known."""
    threshold = pixel_threshold(rate)
    empty, marked, position = scanned(scene, seed)
    limit = scene.level + threshold * np.sqrt(scene.variance)
    inner = empty[:, 1:-1]
    maxima = (inner > limit) & (inner > empty[:, :-2]) & (inner >= empty[:, 2:])
    near = np.abs(np.arange(PIXELS) - position[:, None]) <= NEAR_PX
    skew = 1.0 / np.sqrt(scene.variance) * scene.level / scene.variance
    return Point(
        threshold,
        _counted(int(maxima.sum()), rate * float(np.exp(skew * threshold**3 / 6.0))),
        _seen(((marked > limit) & near).any(axis=1), pixel_detection_probability(scene, threshold)),
        float(norm.sf(threshold - scene.pixel_snr)),
    )


def pixel_threshold(rate: float) -> float:
    """Return the threshold that so many maxima of independent pixels of a line are above.

    A share ``(1 - Phi(t)^3) / 3`` of pixels is higher than t and both neighbours.
    """
    return float(brentq(lambda t: PIXELS * (1.0 - ndtr(t) ** 3) / 3.0 - rate, 0.0, 12.0, xtol=1e-9))


def alarms_by_skewness(scene: Scene, threshold: float) -> float:
    """Return how many times more false alarms photon noise has than Gaussian noise.

    The first term of Edgeworth's series; Poisson light has the third moment of its mean.
    """
    taps = line_filter().taps.astype(np.float64)
    skew = (taps**3).sum() / line_filter().norm ** 3 * scene.level / scene.variance**1.5
    return float(np.exp(skew * threshold**3 / 6.0))


def filter_detection_probability(scene: Scene, threshold: float) -> float:
    """Return the theoretical chance that an answer within NEAR_PX is above a threshold.

    The answers are jointly normal, of the taps' correlation, with the marker's own photon noise;
    over all phases of the marker within a pixel.
    """
    highest = _highest_answers(scene)
    return float(1.0 - np.searchsorted(highest, threshold) / len(highest))


def pixel_detection_probability(scene: Scene, threshold: float) -> float:
    """Return the theoretical chance that a pixel within NEAR_PX is above a threshold."""
    probabilities = []
    for phase in _phases():
        light = scene.marker(gaussian_shape(WIDTH_PX, NEAR_PX + 1, phase))
        pixel = np.arange(-NEAR_PX - 1, NEAR_PX + 2)
        light = light[np.abs(pixel - phase) <= NEAR_PX]
        limit = threshold * np.sqrt(scene.variance)
        below = ndtr((limit - light) / np.sqrt(scene.variance + light))
        probabilities.append(1.0 - float(below.prod()))
    return float(np.mean(probabilities))


@cache
def _highest_answers(scene: Scene) -> Array:
    """Return draws of the highest answer near a marker, in deviations, sorted."""
    matched = line_filter()
    span = matched.half_px + NEAR_PX + 1
    rows = np.zeros((2 * NEAR_PX + 3, 2 * span + 1))
    for row in range(len(rows)):
        rows[row, row : row + len(matched.taps)] = matched.taps / matched.norm
    highest = []
    for number, phase in enumerate(_phases()):
        near = np.abs(np.arange(-NEAR_PX - 1, NEAR_PX + 2) - phase) <= NEAR_PX
        light = scene.marker(gaussian_shape(WIDTH_PX, span, phase))
        mean = rows[near] @ light
        spread = (rows[near] * (scene.variance + light)) @ rows[near].T
        draws = qmc.MultivariateNormalQMC(mean, spread, rng=np.random.default_rng(number))
        highest.append(draws.random(_DRAWS).max(axis=1))
    return np.asarray(np.sort(np.concatenate(highest)) / np.sqrt(scene.variance))


def _near(found: DetectionBatch, position_px: Array) -> NDArray[np.bool_]:
    """Say in which lines a detection is the marker's."""
    # No marker is so near the line's start that a place of -1, which is none, is near it.
    apart: Array = np.abs(found.position_px - position_px[:, None])
    return np.asarray((apart <= NEAR_PX).any(axis=1))


def _phases() -> Array:
    """Return places of a marker within a pixel, evenly spread [px]."""
    return (np.arange(_PHASES) + 0.5) / _PHASES - 0.5


def _counted(found: int, expected_per_line: float) -> Share:
    expected = expected_per_line * LINES
    return Share(found / LINES, expected_per_line, (found - expected) / float(np.sqrt(expected)))


def _seen(found: NDArray[np.bool_], probability: float) -> Share:
    measured = float(found.mean())
    # Of a chance near 1 the binomial error is less than what a single line makes.
    error = np.sqrt(max(probability * (1.0 - probability), 1.0 / LINES) / LINES)
    return Share(measured, probability, (measured - probability) / float(error))
