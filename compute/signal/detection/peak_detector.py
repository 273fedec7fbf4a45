"""Detection of faint peaks in scans at a chosen expected number of false alarms."""

from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.parameter_checks import check_positive
from compute.signal.centroid_settings import (
    LEVEL_UNIT,
    MAX_PIXELS,
    MIN_PIXELS,
    require_choice,
    require_integer,
    sample_starts,
)
from compute.signal.detection.background_estimate import estimate_background, variance_dof
from compute.signal.detection.false_alarms import FalseAlarms
from compute.signal.detection.matched_filter import MatchedFilter
from compute.signal.peaks import PeakFlag, number_within_scan
from compute.signal.sensor_noise import SensorNoise


@dataclass(frozen=True, eq=False)
class DetectionBatch:
    """Detections in L scans, at most K a scan, ordered by position.

    Args:
        count: number of detections of each scan, int32, shape (L,).
        position_px: pixel where the answer is highest, int32, shape (L, K); -1 where there is none.
        response_sigma: answer in standard deviations of the scan's noise, float32, shape (L, K).
        amplitude: height of the peak above its surroundings, as if it were centred on the pixel
            [counts], float32, shape (L, K).
        flags: PeakFlag values, int32, shape (L, K). SATURATED: a pixel of the peak is at full
            scale. CLIPPED: the peak runs over an end of the scan. MERGED: another detection
            lies within half the filter's length, where it counts as background. TRUNCATED: the
            scan had more than K; the faintest were left out.
        noise_counts: standard deviation of a pixel that was reckoned with, float64, shape (L,).
    """

    count: NDArray[np.int32]
    position_px: NDArray[np.int32]
    response_sigma: NDArray[np.float32]
    amplitude: NDArray[np.float32]
    flags: NDArray[np.int32]
    noise_counts: NDArray[np.float64]

    def __len__(self) -> int:
        """Return the number of scans."""
        return len(self.count)


NoiseSource = Literal["line", "model", "larger"]
"""Where the deviation of a pixel is taken from; DetectionSettings says what each is."""

_NO_MAXIMUM: Final = np.iinfo(np.int64).min

_MAX_RESPONSE: Final = 2**31 - 1


@dataclass(frozen=True)
class DetectionSettings:
    """Settings of the detection: false alarms, noise, room.

    Args:
        false_alarms_per_line: expected number of detections in a scan of noise.
        noise: "line": the deviation measured in each scan by ``estimate_background``, whatever the
            sensor is said to do; the threshold is higher by what the uncertainty of that measure
            costs (0.1 deviations at one false alarm a scan, 0.3 at a thousandth). "model": that
            of SensorNoise at the scan's background; the lowest threshold, and wrong where the
            model is. "larger": the larger of the two, with the threshold of "line": fewer false
            alarms than chosen, never more.
        max_peaks: room for detections of one scan; those of the highest answer are kept.

    Raises:
        InvalidParameter: a value outside its range.
    """

    false_alarms_per_line: float = 0.01
    noise: NoiseSource = "line"
    max_peaks: int = 16

    def __post_init__(self) -> None:
        check_positive(self, "false_alarms_per_line")
        require_choice("noise", self.noise, get_args(NoiseSource))
        require_integer("max_peaks", self.max_peaks, 1, 1024)


class PeakDetector:
    """Matched filter, threshold and local maxima.

    - *Answer.* Whole numbers r, by the filter's taps.
    - *Noise.* Variance V of a pixel: of the scan itself (``BackgroundEstimate.variance``), or
      ``dark + photon max(b / 64 - offset, 0)`` by SensorNoise at the scan's background b, or the
      larger; in float64 by operations that every device rounds alike.
    - *Threshold.* ``floor(K sqrt(V))``, K = the threshold in deviations times the filter's norm,
      2^31 - 1 at most.
    - *Detection.* A place above the threshold, higher than its left neighbour and not lower than
      its right one. At the scan's ends the neighbour that is not there is lower.

    False alarms are as chosen for noise that is independent from pixel to pixel, even along the
    scan and Gaussian. Photon noise of N electrons a pixel is skewed: at the threshold t it has
    ``exp(k t^3 / 6)`` times as many, with ``k = sum taps^3 / norm^3 / sqrt(N)`` (first term of
    Edgeworth's series): for peaks of 2 px at t = 4 that is 1.4 times at 100 electrons, 1.04 at
    10,000. The model's noise at b, which lies a quarter of a deviation below the mean, adds a
    sixth at 100 electrons. Rounding bends little from 0.6 counts of noise on; below, "line" and
    "larger" have fewer than chosen, down to none, for BackgroundEstimate knows no noise below half
    a count (both measured by tests/compute/signal/detection/test_false_alarm_rates.py). Where the
    light varies along the scan, its noise does too: false alarms then come from the brightest part.

    Args:
        matched: the filter.
        pixels: pixels of a scan, 64 to 65536 and no fewer than the filter's.
        settings: what counts as detected.
        noise: noise of the S sensors; scan l of a batch is of sensor ``l % S``.

    Raises:
        InvalidParameter: a length of scan out of range, or a number of false alarms that no
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
                f"a scan has {pixels} pixels; it must have {MIN_PIXELS} to {MAX_PIXELS}",
                pixels=pixels,
            )
        self.matched = matched
        self.pixels = pixels
        self.settings = settings
        self._noise = noise
        noise_modelled = settings.noise == "model"
        dof = np.inf if noise_modelled else variance_dof(len(sample_starts(pixels)))
        self.threshold_sigma = FalseAlarms.of(matched, pixels).threshold_sigma(
            settings.false_alarms_per_line, dof
        )
        """Threshold in standard deviations of the answer."""
        self.threshold_scale = self.threshold_sigma * matched.norm
        """K: the threshold per count of a pixel's deviation."""
        self._gains = matched.gains(pixels)

    def detect(self, scans: NDArray[np.uint16]) -> DetectionBatch:
        """Detect the peaks of scans, uint16, shape (L, P).

        Raises:
            InvalidParameter: another type or shape.
        """
        if scans.dtype != np.uint16 or scans.ndim != 2 or scans.shape[1] != self.pixels:
            raise InvalidParameter(
                f"scans have the type {scans.dtype} and the shape {scans.shape}; it must be "
                f"uint16 and (L, {self.pixels})",
                type=str(scans.dtype),
                shape=scans.shape,
            )
        responses = self.matched.respond(scans)
        deviation = np.sqrt(self._variance(scans))
        limit = np.minimum(np.floor(self.threshold_scale * deviation), _MAX_RESPONSE)
        scan, pixel = np.nonzero(_maxima(responses, limit.astype(np.int64)))
        return self._batch(scans, scan, pixel, responses[scan, pixel], deviation)

    def _variance(self, scans: NDArray[np.uint16]) -> NDArray[np.float64]:
        """Return the variance of a pixel of each scan [counts^2], shape (L,)."""
        estimate = estimate_background(scans)
        measured = estimate.variance()
        if self.settings.noise == "line":
            return measured
        noise = self._noise.of_scans(np.arange(len(scans)) % len(self._noise))
        model = noise.variance(estimate.background[:, None] / LEVEL_UNIT)[:, 0]
        return model if self.settings.noise == "model" else np.maximum(measured, model)

    def _batch(
        self,
        scans: NDArray[np.uint16],
        scan: NDArray[np.int64],
        pixel: NDArray[np.int64],
        answer: NDArray[np.int64],
        deviation: NDArray[np.float64],
    ) -> DetectionBatch:
        """Put detections, ordered by scan and place, into rows of one scan each."""
        flags = self._flags(scans, scan, pixel)
        room = self.settings.max_peaks
        counts = np.bincount(scan, minlength=len(scans))
        flags[counts[scan] > room] |= int(PeakFlag.TRUNCATED)
        # By scan, then by answer; of equal answers the first place comes first.
        order = np.lexsort((pixel, -answer, scan))
        strongest = np.sort(order[number_within_scan(scan) < room])
        scan, pixel, answer = (each[strongest] for each in (scan, pixel, answer))
        column = number_within_scan(scan)
        shape = (len(scans), room)
        batch = DetectionBatch(
            np.minimum(counts, room).astype(np.int32),
            np.full(shape, -1, dtype=np.int32),
            np.full(shape, np.nan, dtype=np.float32),
            np.full(shape, np.nan, dtype=np.float32),
            np.zeros(shape, dtype=np.int32),
            deviation,
        )
        batch.position_px[scan, column] = pixel
        batch.response_sigma[scan, column] = answer / (self.matched.norm * deviation[scan])
        batch.amplitude[scan, column] = answer / self._gains[pixel]
        batch.flags[scan, column] = flags[strongest]
        return batch

    def _flags(
        self, scans: NDArray[np.uint16], scan: NDArray[np.int64], pixel: NDArray[np.int64]
    ) -> NDArray[np.int32]:
        flags = np.zeros(len(scan), dtype=np.int32)
        reach = self.matched.reach_px
        full = self._noise.full_scale_counts[scan % len(self._noise)]
        peak = np.clip(pixel[:, None] + np.arange(-reach, reach + 1), 0, self.pixels - 1)
        flags[(scans[scan[:, None], peak] >= full[:, None]).any(axis=1)] |= int(PeakFlag.SATURATED)
        flags[(pixel < reach) | (pixel >= self.pixels - reach)] |= int(PeakFlag.CLIPPED)
        near = (np.diff(pixel) <= self.matched.half_px) & (np.diff(scan) == 0)
        flags[np.flatnonzero(near)] |= int(PeakFlag.MERGED)
        flags[np.flatnonzero(near) + 1] |= int(PeakFlag.MERGED)
        return flags


def _maxima(responses: NDArray[np.int64], limit: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Say which places are local maxima above their scan's limit, shape (L, P)."""
    beyond = np.full((len(responses), 1), _NO_MAXIMUM)
    before = np.concatenate([beyond, responses[:, :-1]], axis=1)
    after = np.concatenate([responses[:, 1:], beyond], axis=1)
    maxima: NDArray[np.bool_] = (
        (responses > limit[:, None]) & (responses > before) & (responses >= after)
    )
    return maxima
