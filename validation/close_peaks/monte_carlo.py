"""Monte Carlo errors of two overlapping peaks by joint fit, valley cut and slope extension."""

from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.signal.fit.fit_reference import fit_scans
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.peaks import PeakBatch, PeakFlag
from compute.signal.thesis_pipeline.peak_separation import SlopeExtension, ValleyCut
from compute.signal.thesis_pipeline.signal_chain import SignalChain
from validation.joint_position_bounds import joint_position_bounds
from validation.synthetic_scans import (
    AMBIENT,
    GAIN,
    MIDDLE_PX,
    OFFSET,
    PIXELS,
    Array,
    expose,
    find,
    gaussian_electrons,
    line_noise,
    places_px,
)

WIDTH_PX: Final = 2.0
READ_NOISE: Final = 20.0
SEPARATIONS: Final = (8.0, 6.0, 4.0, 3.0, 2.5, 2.0, 1.5)
"""In deviations."""
LIGHTS: Final = (1e3, 1e4, 1e5)
RATIOS: Final = (1, 5)
WIDTH_LOG_SIGMA: Final = 0.5
"""Of the fit that does not know the width: the settings' default."""

LEVELS: Final = {1: 0.2, 5: 0.1}
"""Zero line of valley cut and slope extension: the thesis's 1/5 would take the fainter of 1:5."""
MIN_DEPTH: Final = 0.1
"""Valleys less deep are noise's."""

_ZONE_WIDTHS: Final = 2.0  # a peak farther outside of the pair is not of it


@dataclass(frozen=True)
class Pair:
    """Two peaks: their light [electrons], the second ``ratio`` times as bright, and distance."""

    light: float
    ratio: int
    separation: float

    @property
    def lights(self) -> tuple[float, float]:
        """The light of both [electrons]."""
        return self.light, self.ratio * self.light


@dataclass(frozen=True)
class PairErrors:
    """Errors of a method, where it found two peaks.

    Args:
        two: share of the lines in which it did.
        rms_px: of the fainter and the brighter peak.
        apart_px: mean of half the error of their distance: positive when pushed apart.
        by_bound: root mean square of both errors by their own bound; NaN without one.
        nees: mean of the pair's squared error by the stated covariance; 2 is honest.
        correlation: of the two errors.
        stated_correlation: mean of what the covariances say.
    """

    two: float
    rms_px: tuple[float, float]
    apart_px: float
    by_bound: float
    nees: float
    correlation: float
    stated_correlation: float


@dataclass(frozen=True)
class PairFigures:
    """A pair's bounds and errors.

    Args:
        pair: the pair.
        bound_px: of both positions, the width known.
        fitted_bound_px: of both, with the width's prior.
        known: the joint fit, width known.
        fitted: the joint fit, width fitted.
        valley: valley cut.
        slopes: slope extension.
    """

    pair: Pair
    bound_px: Array
    fitted_bound_px: Array
    known: PairErrors
    fitted: PairErrors
    valley: PairErrors
    slopes: PairErrors


@cache
def pair_figures(pair: Pair, count: int, chain_count: int, seed: int = 3) -> PairFigures:
    """Measure all methods by the same lines, at places all over a pixel.

    Args:
        pair: the pair.
        count: number of lines that are fitted.
        chain_count: how many of them valley cut and slope extension take apart.
        seed: of the noise.
    """
    rng = np.random.default_rng([seed, round(pair.light), pair.ratio, round(10 * pair.separation)])
    distance = pair.separation * WIDTH_PX
    position = places_px(count, rng)[:, None] + distance * np.array([-0.5, 0.5])
    lines = expose(gaussian_electrons(position, WIDTH_PX, pair.lights), READ_NOISE, rng)
    settings = (
        FitSettings(width_px=WIDTH_PX, width_log_sigma=0.0),
        FitSettings(width_px=WIDTH_PX, width_log_sigma=WIDTH_LOG_SIGMA),
    )
    noise = line_noise(READ_NOISE)
    bounds, errors = [], []
    for one in settings:
        sample = position[:: max(count // 64, 1)]
        covariance = joint_position_bounds(sample, pair.lights, AMBIENT, PIXELS, one, noise)
        bounds.append(np.sqrt(np.diagonal(covariance.mean(axis=0))))
        found = fit_scans(lines, one, noise, candidates=find(lines, one.search, READ_NOISE))
        errors.append(_fit_errors(found, position, bounds[-1]))
    some = rng.permutation(count)[:chain_count]
    cuts: tuple[ValleyCut, ...] = (
        ValleyCut(LEVELS[pair.ratio], MIN_DEPTH),
        SlopeExtension(LEVELS[pair.ratio], MIN_DEPTH),
    )
    cut = [_cut_errors(lines[some], position[some], method) for method in cuts]
    return PairFigures(pair, bounds[0], bounds[1], *errors, *cut)


def _fit_errors(found: PeakBatch, place: Array, bound: Array) -> PairErrors:
    """Return the errors where exactly two peaks were fitted in the pair's zone."""
    fitted = (found.flags & PeakFlag.UNFITTED) == 0
    first, two = _pairs(found.position_px, fitted, place)
    row = np.flatnonzero(two)
    first = first[two]
    position = np.stack([found.position_px[row, first], found.position_px[row, first + 1]], axis=1)
    sigma = np.stack([found.sigma_px[row, first], found.sigma_px[row, first + 1]], axis=1)
    mixed = found.covariance_px2[row, first, 0].astype(np.float64)
    error = position - place[two]
    covariance = np.einsum("ni,ij->nij", sigma.astype(np.float64) ** 2, np.eye(2))
    covariance[:, 0, 1] = covariance[:, 1, 0] = mixed
    if len(row) < 2:
        return _errors(float(two.mean()), error, bound)
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
    stated = mixed / sigma.prod(axis=1)
    return _errors(float(two.mean()), error, bound, float(nees.mean()), float(stated.mean()))


def _cut_errors(lines: NDArray[np.uint16], place: Array, method: ValleyCut) -> PairErrors:
    """Return the errors of the two highest peaks, where both are of the pair."""
    chain = SignalChain(
        separation=method, threshold_fraction=0.0, weighting="above-background", min_width_px=1
    )
    # The background is known here, and the line cut out: noise elsewhere is not its business.
    half = int(np.ceil(0.5 * np.ptp(place[0]) + 6.0 * WIDTH_PX))
    window = slice(MIDDLE_PX - half, MIDDLE_PX + half + 1)
    peaks = chain.run(lines[:, window] - (OFFSET + AMBIENT / GAIN), line_noise(READ_NOISE)).peaks
    highest = np.argsort(np.nan_to_num(-peaks.amplitude, nan=np.inf), axis=1)[:, :2]
    chosen = np.zeros(peaks.position_px.shape, bool)
    np.put_along_axis(chosen, highest, values=True, axis=1)
    chosen &= ~np.isnan(peaks.position_px)
    _, two = _pairs(peaks.position_px + window.start, chosen, place, only=True)
    position = np.sort(np.where(chosen, peaks.position_px, np.inf)[two], axis=1)[:, :2]
    return _errors(float(two.mean()), position + window.start - place[two])


def _pairs(
    position: Array, good: NDArray[np.bool_], place: Array, *, only: bool = False
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the first peak in the pair's zone, and which lines have exactly two in it.

    Args:
        position: shape (N, K), NaN where there is none.
        good: peaks that may count, shape (N, K).
        place: true places, shape (N, 2).
        only: peaks that do not count are not looked at.
    """
    low, high = place[:, :1] - _ZONE_WIDTHS * WIDTH_PX, place[:, 1:] + _ZONE_WIDTHS * WIDTH_PX
    with np.errstate(invalid="ignore"):
        inside = (position > low) & (position < high)
    if only:
        inside &= good
    two = (inside.sum(axis=1) == 2) & (good | ~inside).all(axis=1)
    return np.argmax(inside, axis=1), two


def _errors(
    two: float,
    error: Array,
    bound: Array | None = None,
    nees: float = np.nan,
    stated: float = np.nan,
) -> PairErrors:
    if len(error) < 2:
        return PairErrors(two, (np.nan, np.nan), np.nan, np.nan, nees, np.nan, stated)
    rms = np.sqrt(np.mean(error**2, axis=0))
    by_bound = np.nan if bound is None else float(np.sqrt(np.mean((error / bound) ** 2)))
    return PairErrors(
        two,
        (float(rms[0]), float(rms[1])),
        float(np.mean(error[:, 1] - error[:, 0]) / 2.0),
        by_bound,
        nees,
        float(np.atleast_2d(np.corrcoef(error.T))[0, 1]),
        stated,
    )


def split_share(light: float, rate: float, count: int, seed: int = 4) -> tuple[float, float]:
    """Return in which part of lines of one peak the fit saw more, and found the fit poor."""
    rng = np.random.default_rng([seed, round(light)])
    settings = FitSettings(width_px=WIDTH_PX, width_log_sigma=0.0, false_split_rate=rate)
    more = poor = 0
    block = 10_000
    for start in range(0, count, block):
        number = min(block, count - start)
        place = places_px(number, rng)[:, None]
        lines = expose(gaussian_electrons(place, WIDTH_PX, (light,)), READ_NOISE, rng)
        candidates = find(lines, settings.search, READ_NOISE)
        found = fit_scans(lines, settings, line_noise(READ_NOISE), candidates=candidates)
        more += int(np.sum(found.count > candidates.count))
        poor += int(((found.flags & PeakFlag.POOR_FIT) != 0).any(axis=1).sum())
    return more / count, poor / count
