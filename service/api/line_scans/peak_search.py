"""Finds the peaks of posted scans and reports what each method did."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from functools import lru_cache
from math import isfinite
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.flags import flag_names
from compute.signal.centroid_reference import find_peaks_reference
from compute.signal.centroid_settings import LEVEL_UNIT, CentroidSettings
from compute.signal.coded_aperture.shadow_fit import ShadowFitter
from compute.signal.detection.background_estimate import estimate_background
from compute.signal.detection.matched_filter import MatchedFilter, gaussian_filter
from compute.signal.detection.peak_detector import DetectionBatch, PeakDetector
from compute.signal.fit.fit_reference import fit_scans
from compute.signal.fit.group_fit import GroupFit, fit_scan
from compute.signal.peaks import PeakBatch, PeakFlag
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
from service.api.line_scans.shadow_search import read_shadow
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
            scans = _by_chain(lines, method, noise, detail=detail)
        case MatchedMethod():
            scans = _by_filter(lines, method, noise, detail=detail)
        case MaskMethod():
            scans = _by_mask(lines, method, noise, find_profile, detail=detail)
        case _:
            scans = _by_search(lines, method, noise, detail=detail)
    return LineScans(method=method.method, noise=noise, assumed=assumed, scans=scans)


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
    fit = method if isinstance(method, FitMethod) else None
    search: CentroidSettings = method.search if isinstance(method, FitMethod) else method
    seen = batch = find_peaks_reference(lines, search, model)
    further: list[int | None] = [None] * len(lines)
    if fit is not None:
        batch = fit_scans(lines, fit.settings, model, fit.line_shape, candidates=seen)
        if fit.further_peaks:
            further = np.maximum(batch.count - seen.count, 0).tolist()
    limits = search_limits(lines, search, noise)
    return [
        _scan(
            lines[line : line + 1],
            noise,
            line,
            line_peaks(batch, line),
            limit_counts=float(limits[line]),
            further_peaks=further[line],
            covariance_px2=_covariance(batch, line),
            windows=(
                fit_windows(fit_scan(lines[line], fit.settings, model, fit.line_shape))
                if detail and fit is not None
                else None
            ),
        )
        for line in range(len(lines))
    ]


def _by_chain(
    lines: Scans, method: ChainMethod, noise: PixelNoise, *, detail: bool
) -> list[LineScan]:
    count = method.average or 1
    if len(lines) % count:
        raise InvalidParameter(
            f"there are {len(lines)} scans, and average is {count}; the number of scans must be a "
            "multiple of it",
            scans=len(lines),
            average=count,
        )
    scans = []
    # One after another: a result keeps a line of values for each of its peaks.
    for first in range(0, len(lines), count):
        averaged = lines[first : first + count]
        result = method.run(averaged, line_noise(noise))
        stages = [
            Stage(name=one.name, unit="counts", shift_px=one.shift_px, values=one.scans[0].tolist())
            for one in result.stages
        ]
        peaks = line_peaks(result.peaks, 0)
        scans.append(_scan(averaged, noise, first, peaks, stages=stages if detail else None))
    return scans


def _by_filter(
    lines: Scans, method: MatchedMethod, noise: PixelNoise, *, detail: bool
) -> list[LineScan]:
    matched = _filter(method.width_px, method.length_px)
    detector = PeakDetector(matched, lines.shape[1], method, line_noise(noise))
    batch = detector.detect(lines)
    stages: list[list[Stage] | None] = [None] * len(lines)
    if detail:
        responses = matched.respond(lines) / matched.norm / batch.noise_counts[:, None]
        stages = [
            [Stage(name="matched filter", unit="deviations", shift_px=0.0, values=values)]
            for values in responses.tolist()
        ]
    return [
        _scan(
            lines[line : line + 1],
            noise,
            line,
            _detections(batch, line),
            limit_sigma=detector.threshold_sigma,
            stages=stages[line],
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
    fitters = [
        ShadowFitter(template, pixels, model, method)
        for template in method.templates(pixels, find_profile)[: len(lines)]
    ]
    scans = []
    for line, values in enumerate(lines):
        shadow = read_shadow(values, fitters[line % len(fitters)], method, model)
        scans.append(
            _scan(
                values[None],
                noise,
                line,
                line_peaks(shadow.peaks, 0, _plain(shadow.response_sigma)),
                limit_sigma=shadow.limit_sigma,
                windows=shadow.windows if detail and method.estimator == "fit" else None,
                stages=[shadow.stage] if detail else None,
            )
        )
    return scans


@lru_cache(maxsize=8)
def _filter(width_px: float, length_px: int | None) -> MatchedFilter:
    return gaussian_filter(width_px, length_px)


_ABSENT: Final[dict[str, Any]] = dict.fromkeys(
    ("limit_counts", "limit_sigma", "further_peaks", "covariance_px2", "windows", "stages")
)


def _scan(
    lines: Scans, noise: PixelNoise, index: int, peaks: list[LinePeak], **known: Any
) -> LineScan:
    """Return the answer for one line, or for averaged ones; unknown values are null.

    Levels are those of the first line; a pixel counts as saturated where it is in any.
    """
    estimate = estimate_background(lines[:1])
    background = estimate.background / LEVEL_UNIT
    return LineScan(
        **_ABSENT | known,
        index=index,
        background_counts=float(background[0]),
        noise_counts=float(noise_at(noise, background)[0]),
        measured_noise_counts=float(np.sqrt(estimate.variance()[0])),
        saturated_pixels=int((lines >= noise.full_scale_counts).any(axis=0).sum()),
        peaks=peaks,
    )


def line_peaks(batch: PeakBatch, line: int, response_sigma: float | None = None) -> list[LinePeak]:
    """Return the peaks of a line of a batch."""
    known = [_plain(asdict(peak)) for peak in batch.peaks(line)]
    return [LinePeak(**one, response_sigma=response_sigma) for one in known]


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


def fit_windows(groups: Iterable[GroupFit]) -> list[FitWindow]:
    """Return the details of a line's fits."""
    return [
        FitWindow(**{name: _plain(getattr(group, name)) for name in FitWindow.model_fields})
        for group in groups
    ]


def _plain(value: Any) -> Any:
    """Return a value without NumPy's types, and without what JSON has no number for."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, float):
        return value if isfinite(value) else None
    if isinstance(value, dict):
        return {name: _plain(item) for name, item in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(item) for item in value]
    return value
