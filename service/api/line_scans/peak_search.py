"""Finds the peaks of posted scans and reports what each method did."""

from collections.abc import Sequence
from dataclasses import asdict
from functools import lru_cache
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.flags import flag_names
from compute.signal.centroid_reference import find_peaks_reference
from compute.signal.centroid_settings import LEVEL_UNIT, CentroidSettings
from compute.signal.detection.background_estimate import estimate_background
from compute.signal.detection.matched_filter import MatchedFilter, gaussian_filter
from compute.signal.detection.peak_detector import DetectionBatch, PeakDetector
from compute.signal.fit.fit_reference import fit_scans
from compute.signal.fit.group_fit import GroupFit, fit_scan
from compute.signal.peaks import PeakBatch, PeakFlag
from compute.signal.sensor_noise import SensorNoise
from compute.signal.thesis_pipeline.result import ChainResult
from service.api.line_scans.chain_steps import ChainMethod
from service.api.line_scans.mask_method import MaskMethod
from service.api.line_scans.methods import CentroidMethod, FitMethod, MatchedMethod, Method
from service.api.line_scans.noise import (
    NoiseConstants,
    estimate_noise,
    line_noise,
    noise_at,
    search_limits,
)
from service.api.line_scans.schema import (
    FitWindow,
    LinePeak,
    LineScan,
    LineScans,
    PixelNoise,
    Stage,
)
from service.api.line_scans.shadow_search import ShadowSearch
from service.pipeline.detection_stage import FindProfile, built_in_profile

Scans = NDArray[np.uint16]


def find_peaks(
    lines: Scans,
    method: Method,
    noise: PixelNoise | NoiseConstants | None = None,
    *,
    detail: bool = False,
    find_profile: FindProfile = built_in_profile,
) -> LineScans:
    """Find the peaks of lines of one sensor.

    Args:
        lines: counts, shape (L, P), P from 64 to 65536.
        method: how.
        noise: of the sensor; None, or known in part: the rest is guessed from the lines.
        detail: tell also about pixels.
        find_profile: gives the profiles that a mask's method may name.

    Raises:
        InvalidParameter: a value above full scale, or settings that do not fit the lines.
    """
    assumed: list[str] = []
    if not isinstance(noise, PixelNoise):
        noise, assumed = estimate_noise(lines, noise)
    _check_full_scale(lines, noise)
    match method:
        case ChainMethod():
            found = _by_chain(lines, method, noise, detail=detail)
        case MatchedMethod():
            found = _by_filter(lines, method, noise, detail=detail)
        case MaskMethod():
            found = _by_mask(lines, method, noise, find_profile, detail=detail)
        case _:
            found = _by_search(lines, method, noise, detail=detail)
    return LineScans(method=method.method, noise=noise, assumed=assumed, scans=found)


def _check_full_scale(lines: Scans, noise: PixelNoise) -> None:
    above = lines > noise.full_scale_counts
    if above.any():
        line, pixel = (int(index) for index in np.argwhere(above)[0])
        raise InvalidParameter(
            f"scans.{line}.{pixel} is {lines[line, pixel]}, above full_scale_counts, "
            f"{noise.full_scale_counts}; a saturated pixel has that, none has more",
            index=line,
            pixel=pixel,
            value=int(lines[line, pixel]),
        )


def _by_search(
    lines: Scans, method: CentroidMethod | FitMethod, noise: PixelNoise, *, detail: bool
) -> list[LineScan]:
    model = line_noise(noise)
    search: CentroidSettings = method.search if isinstance(method, FitMethod) else method
    seen = batch = find_peaks_reference(lines, search, model)
    further = None
    if isinstance(method, FitMethod):
        batch = fit_scans(lines, method.settings, model, method.line_shape, candidates=seen)
        if method.further_peaks:
            further = np.maximum(batch.count - seen.count, 0).tolist()
    limits = search_limits(lines, search, noise)
    return [
        LineScan(
            **_levels(lines[line : line + 1], noise),
            index=line,
            limit_counts=float(limits[line]),
            limit_sigma=None,
            further_peaks=None if further is None else further[line],
            peaks=_peaks(batch, line),
            covariance_px2=_covariance(batch, line),
            windows=_windows(lines[line], method, model) if detail else None,
            stages=None,
        )
        for line in range(len(lines))
    ]


def _by_chain(
    lines: Scans, method: ChainMethod, noise: PixelNoise, *, detail: bool
) -> list[LineScan]:
    count = 1 if method.average is None else method.average
    if len(lines) % count:
        raise InvalidParameter(
            f"there are {len(lines)} scans, and average is {count}; the number of scans must be a "
            "multiple of it",
            scans=len(lines),
            average=count,
        )
    found = []
    # One after another: a result keeps a line of values for each of its peaks.
    for first in range(0, len(lines), count):
        result = method.run(lines[first : first + count], line_noise(noise))
        found.append(
            LineScan(
                **_levels(lines[first : first + count], noise),
                index=first,
                limit_counts=None,
                limit_sigma=None,
                further_peaks=None,
                peaks=_peaks(result.peaks, 0),
                covariance_px2=None,
                windows=None,
                stages=_stages(result) if detail else None,
            )
        )
    return found


def _by_filter(
    lines: Scans, method: MatchedMethod, noise: PixelNoise, *, detail: bool
) -> list[LineScan]:
    matched = _filter(method.width_px, method.length_px)
    detector = PeakDetector(matched, lines.shape[1], method, line_noise(noise))
    batch = detector.detect(lines)
    answers = matched.respond(lines) / matched.norm if detail else None
    return [
        LineScan(
            **_levels(lines[line : line + 1], noise),
            index=line,
            limit_counts=None,
            limit_sigma=detector.threshold_sigma,
            further_peaks=None,
            peaks=_detections(batch, line),
            covariance_px2=None,
            windows=None,
            stages=None
            if answers is None
            else [
                Stage(
                    name="matched filter",
                    unit="deviations",
                    shift_px=0.0,
                    values=(answers[line] / batch.noise_counts[line]).tolist(),
                )
            ],
        )
        for line in range(len(lines))
    ]


def _by_mask(
    lines: Scans,
    method: MaskMethod,
    noise: PixelNoise,
    find_profile: FindProfile,
    *,
    detail: bool,
) -> list[LineScan]:
    pixels, model = lines.shape[1], line_noise(noise)
    readings = [
        ShadowSearch(template, pixels, method, model)
        for template in method.templates(pixels, find_profile)[: len(lines)]
    ]
    found = []
    for line, values in enumerate(lines):
        shadow = readings[line % len(readings)].read(values)
        peaks = [
            peak.model_copy(update={"response_sigma": _plain(shadow.response_sigma)})
            for peak in _peaks(shadow.peaks, 0)
        ]
        found.append(
            LineScan(
                **_levels(values[None], noise),
                index=line,
                limit_counts=None,
                limit_sigma=shadow.limit_sigma,
                further_peaks=None,
                peaks=peaks,
                covariance_px2=None,
                windows=shadow.windows if detail and method.estimator == "fit" else None,
                stages=[shadow.stage] if detail else None,
            )
        )
    return found


@lru_cache(maxsize=8)
def _filter(width_px: float, length_px: int | None) -> MatchedFilter:
    return gaussian_filter(width_px, length_px)


def _levels(lines: Scans, noise: PixelNoise) -> dict[str, Any]:
    """Return the levels of the first of the lines of one answer, and what is saturated in any."""
    spread = estimate_background(lines[:1])
    background = spread.background / LEVEL_UNIT
    return {
        "background_counts": float(background[0]),
        "noise_counts": float(noise_at(noise, background)[0]),
        "measured_noise_counts": float(np.sqrt(spread.variance()[0])),
        "saturated_pixels": int((lines >= noise.full_scale_counts).any(axis=0).sum()),
    }


def _peaks(batch: PeakBatch, line: int) -> list[LinePeak]:
    found = []
    for peak in batch.peaks(line, ""):
        values = {name: _plain(value) for name, value in asdict(peak).items() if name != "sensor"}
        found.append(LinePeak(**values, response_sigma=None))
    return found


def _detections(batch: DetectionBatch, line: int) -> list[LinePeak]:
    return [
        LinePeak(
            position_px=float(batch.position_px[line, k]),
            sigma_px=None,
            amplitude=_plain(float(batch.amplitude[line, k])),
            width_px=None,
            reduced_chi2=None,
            response_sigma=_plain(float(batch.response_sigma[line, k])),
            flags=flag_names(PeakFlag(int(batch.flags[line, k]))),
        )
        for k in range(int(batch.count[line]))
    ]


def _covariance(batch: PeakBatch, line: int) -> list[list[float]] | None:
    count = int(batch.count[line])
    if not (batch.flags[line, :count] & PeakFlag.JOINT).any():
        return None
    found: list[list[float]] = batch.covariance(line).tolist()
    return found


def _windows(
    line: NDArray[np.uint16], method: CentroidMethod | FitMethod, noise: SensorNoise
) -> list[FitWindow] | None:
    if not isinstance(method, FitMethod):
        return None
    return [_window(group) for group in fit_scan(line, method.settings, noise, method.line_shape)]


def _window(group: GroupFit) -> FitWindow:
    values = {name: _plain(getattr(group, name)) for name in FitWindow.model_fields}
    return FitWindow(**values)


def _stages(result: ChainResult) -> list[Stage]:
    return [
        Stage(
            name=stage.name, unit="counts", shift_px=stage.shift_px, values=stage.scans[0].tolist()
        )
        for stage in result.stages
    ]


def _plain(value: Any) -> Any:
    """Return a value without NumPy's types, and without what JSON has no number for."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, float):
        return value if isfinite(value) else None
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(item) for item in value]
    return value
