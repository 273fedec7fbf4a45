"""PeakDetector: finds faint peaks in lines at a chosen expected number of false alarms."""

from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.signal.centroid_settings import (
    LEVEL_UNIT,
    MAX_PIXELS,
    MIN_PIXELS,
    require_whole,
    sample_starts,
)
from compute.signal.detection.background_estimate import estimate_background, variance_dof
from compute.signal.detection.detection_batch import DetectionBatch
from compute.signal.detection.false_alarms import FalseAlarms
from compute.signal.detection.matched_filter import MatchedFilter
from compute.signal.peaks import PeakFlag
from compute.signal.sensor_noise import SensorNoise

NoiseSource = Literal["line", "model", "larger"]
"""Where the deviation of a pixel is taken from; DetectionSettings says what each is."""

_NO_MAXIMUM: Final = np.iinfo(np.int64).min
_MAX_RESPONSE: Final = 2**31 - 1


@dataclass(frozen=True)
class DetectionSettings:
    """What counts as detected.

    Args:
        false_alarms_per_line: expected number of detections in a line of noise.
        noise: "line": the deviation measured in each line by ``estimate_background``, whatever the
            sensor is said to do; the threshold is higher by what the uncertainty of that measure
            costs (0.1 deviations at one false alarm a line, 0.3 at a thousandth). "model": that
            of SensorNoise at the line's background; the lowest threshold, and wrong where the
            model is. "larger": the larger of the two, with the threshold of "line": fewer false
            alarms than chosen, never more.
        max_peaks: room for detections of one line; those of the highest answer are kept.

    Raises:
        InvalidParameter: a value outside its range.
    """

    false_alarms_per_line: float = 0.01
    noise: NoiseSource = "line"
    max_peaks: int = 16

    def __post_init__(self) -> None:
        if not 0.0 < self.false_alarms_per_line < np.inf:
            raise InvalidParameter(
                f"false_alarms_per_line is {self.false_alarms_per_line}; it must be positive",
                false_alarms_per_line=self.false_alarms_per_line,
            )
        if self.noise not in get_args(NoiseSource):
            raise InvalidParameter(
                f"noise is {self.noise!r}; it must be one of {get_args(NoiseSource)}",
                noise=self.noise,
            )
        require_whole("max_peaks", self.max_peaks, 1, 1024)


class PeakDetector:
    """Matched filter, threshold, local maxima: the definition, which a kernel must match.

    - *Answer.* Whole numbers r, by the filter's taps.
    - *Noise.* Variance V of a pixel: of the line itself (``BackgroundEstimate.variance``), or
      ``dark + photon max(b / 64 - offset, 0)`` by SensorNoise at the line's background b, or the
      larger; in float64 by operations that every device rounds alike.
    - *Threshold.* ``floor(K sqrt(V))``, K = the threshold in deviations times the filter's norm,
      2^31 - 1 at most.
    - *Detection.* A place above the threshold, higher than its left neighbour and not lower than
      its right one. At the line's ends the neighbour that is not there is lower.

    False alarms are as chosen for noise that is independent from pixel to pixel, even along the
    line and Gaussian. Photon noise of N electrons a pixel is skewed: at the threshold t it has
    ``exp(k t^3 / 6)`` times as many, with ``k = sum taps^3 / norm^3 / sqrt(N)`` (first term of
    Edgeworth's series): for lines of 2 px at t = 4 that is 1.4 times at 100 electrons, 1.04 at
    10,000. The model's noise at b, which lies a quarter of a deviation below the mean, adds a
    sixth at 100 electrons. Rounding bends little from 0.6 counts of noise on; below, "line" and
    "larger" have fewer than chosen, down to none, for BackgroundEstimate knows no noise below half a
    count (both measured by tests/compute/signal/detection/test_false_alarm_rates.py). Where
    the light varies along the line, its noise does too: false alarms then come from the
    brightest part.

    Args:
        matched: the filter.
        pixels: pixels of a line, 64 to 65536 and no fewer than the filter's.
        settings: what counts as detected.
        noise: noise of the S sensors; line l of a batch is of sensor ``l % S``.

    Raises:
        InvalidParameter: a length of line out of range, or a number of false alarms that no
            threshold gives.
    """

    def __init__(
        self,
        matched: MatchedFilter,
        pixels: int,
        settings: DetectionSettings,
        noise: SensorNoise,
    ) -> None:
        if not MIN_PIXELS <= pixels <= MAX_PIXELS:
            raise InvalidParameter(
                f"a line has {pixels} pixels; it must have {MIN_PIXELS} to {MAX_PIXELS}",
                pixels=pixels,
            )
        self.matched = matched
        self.pixels = pixels
        self.settings = settings
        self._noise = noise
        known = settings.noise == "model"
        dof = np.inf if known else variance_dof(len(sample_starts(pixels)))
        self.threshold_sigma = FalseAlarms.of(matched, pixels).threshold_sigma(
            settings.false_alarms_per_line, dof
        )
        """Threshold in standard deviations of the answer."""
        self.threshold_scale = self.threshold_sigma * matched.norm
        """K: the threshold per count of a pixel's deviation."""
        self._gains = matched.gains(pixels)

    def detect(self, lines: NDArray[np.uint16]) -> DetectionBatch:
        """Detect the peaks of lines, uint16, shape (L, P).

        Raises:
            InvalidParameter: another type or shape.
        """
        if lines.dtype != np.uint16 or lines.ndim != 2 or lines.shape[1] != self.pixels:
            raise InvalidParameter(
                f"lines have the type {lines.dtype} and the shape {lines.shape}; it must be "
                f"uint16 and (L, {self.pixels})",
                type=str(lines.dtype),
                shape=lines.shape,
            )
        responses = self.matched.respond(lines)
        deviation = np.sqrt(self._variance(lines))
        limit = np.minimum(np.floor(self.threshold_scale * deviation), _MAX_RESPONSE)
        line, place = np.nonzero(_maxima(responses, limit.astype(np.int64)))
        return self._batch(lines, line, place, responses[line, place], deviation)

    def _variance(self, lines: NDArray[np.uint16]) -> NDArray[np.float64]:
        """Return the variance of a pixel of each line [counts^2], shape (L,)."""
        spread = estimate_background(lines)
        own = spread.variance()
        if self.settings.noise == "line":
            return own
        noise = self._noise
        sensor = np.arange(len(lines)) % len(noise)
        light = np.maximum(spread.background / LEVEL_UNIT - noise.offset_counts[sensor], 0.0)
        model = noise.dark_variance[sensor] + noise.photon_variance[sensor] * light
        return model if self.settings.noise == "model" else np.maximum(own, model)

    def _batch(
        self,
        lines: NDArray[np.uint16],
        line: NDArray[np.int64],
        place: NDArray[np.int64],
        answer: NDArray[np.int64],
        deviation: NDArray[np.float64],
    ) -> DetectionBatch:
        """Put detections, ordered by line and place, into rows of one line each."""
        flags = self._flags(lines, line, place)
        room = self.settings.max_peaks
        found = np.bincount(line, minlength=len(lines))
        if (found > room).any():
            # By line, then by answer; of equal answers the first place comes first.
            order = np.lexsort((place, -answer, line))
            rank = np.empty_like(order)
            rank[order] = np.arange(len(order)) - (np.cumsum(found) - found)[line[order]]
            flags[found[line] > room] |= int(PeakFlag.TRUNCATED)
            kept = rank < room
            line, place, answer, flags = line[kept], place[kept], answer[kept], flags[kept]
            found = np.minimum(found, room)
        column = np.arange(len(line)) - (np.cumsum(found) - found)[line]
        shape = (len(lines), room)
        batch = DetectionBatch(
            found.astype(np.int32),
            np.full(shape, -1, dtype=np.int32),
            np.full(shape, np.nan, dtype=np.float32),
            np.full(shape, np.nan, dtype=np.float32),
            np.zeros(shape, dtype=np.int32),
            deviation,
        )
        batch.position_px[line, column] = place
        batch.response_sigma[line, column] = answer / (self.matched.norm * deviation[line])
        batch.amplitude[line, column] = answer / self._gains[place]
        batch.flags[line, column] = flags
        return batch

    def _flags(
        self, lines: NDArray[np.uint16], line: NDArray[np.int64], place: NDArray[np.int64]
    ) -> NDArray[np.int32]:
        flags = np.zeros(len(line), dtype=np.int32)
        reach = self.matched.reach_px
        full = self._noise.full_scale_counts[line % len(self._noise)]
        peak = np.clip(place[:, None] + np.arange(-reach, reach + 1), 0, self.pixels - 1)
        flags[(lines[line[:, None], peak] >= full[:, None]).any(axis=1)] |= int(PeakFlag.SATURATED)
        flags[(place < reach) | (place >= self.pixels - reach)] |= int(PeakFlag.CLIPPED)
        near = (np.diff(place) <= self.matched.half_px) & (np.diff(line) == 0)
        flags[np.flatnonzero(near)] |= int(PeakFlag.MERGED)
        flags[np.flatnonzero(near) + 1] |= int(PeakFlag.MERGED)
        return flags


def _maxima(responses: NDArray[np.int64], limit: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Say which places are local maxima above their line's limit, shape (L, P)."""
    beyond = np.full((len(responses), 1), _NO_MAXIMUM)
    before = np.concatenate([beyond, responses[:, :-1]], axis=1)
    after = np.concatenate([responses[:, 1:], beyond], axis=1)
    maxima: NDArray[np.bool_] = (
        (responses > limit[:, None]) & (responses > before) & (responses >= after)
    )
    return maxima
