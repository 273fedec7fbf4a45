"""Weighted fit of peaks in NumPy: the definition that the kernel must match."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.signal.centroid_reference import background_levels, find_peaks_reference
from compute.signal.centroid_settings import MAX_PIXELS, MIN_PIXELS
from compute.signal.fit.candidate_groups import (
    Groups,
    form_groups,
    initial_parameters,
)
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.fit.line_spread_function import LineSpreadFunction
from compute.signal.fit.model_order import SelectedFits, fit_windows
from compute.signal.fit.peak_batches import (
    FlatPeaks,
    collect_fitted_peaks,
    collect_unfitted_peaks,
    to_peak_batch,
)
from compute.signal.fit.surrounding_slope import take_surroundings
from compute.signal.fit.width_marginalisation import marginalise_width
from compute.signal.fit.window_model import WindowModel
from compute.signal.peaks import PeakBatch, PeakFlag
from compute.signal.pixel_corrections import PixelCorrections
from compute.signal.sensor_noise import SensorNoise


def fit_scans(
    scans: NDArray[np.uint16],
    settings: FitSettings,
    noise: SensorNoise,
    shape: LineSpreadFunction | None = None,
    candidates: PeakBatch | None = None,
    corrections: PixelCorrections | None = None,
) -> PeakBatch:
    """Fit the peaks of scans, as ``FitSettings`` defines it.

    The search is written out plainly and slow; the fits of all scans go together.

    Args:
        scans: counts, shape (L, P); scan l belongs to sensor ``l % len(noise)``.
        settings: of the fit.
        noise: of the sensors.
        shape: the line-spread function; None: a Gaussian.
        candidates: what ``settings.search`` finds, where it is known already.
        corrections: of the sensors' pixels; None: counts are taken as they are.

    Raises:
        InvalidParameter: scans of another type or shape, or candidates of other scans.
    """
    check_scans(scans)
    shape = LineSpreadFunction.gaussian() if shape is None else shape
    if candidates is None:
        candidates = find_peaks_reference(scans, settings.search, noise, corrections)
    elif len(candidates) != len(scans):
        raise InvalidParameter(
            f"candidates are of {len(candidates)} scans; they must be of these {len(scans)}",
            candidates=len(candidates),
        )
    pixels, room = scans.shape[1], settings.search.max_peaks
    groups = form_groups(candidates, pixels, settings)
    parts: list[FlatPeaks] = []
    for selected in fit_groups(scans, groups, candidates, settings, noise, shape, corrections):
        parts.append(collect_fitted_peaks(selected, candidates, pixels))
        parts.append(collect_unfitted_peaks(selected, candidates))
    if not parts:
        return PeakBatch.empty(len(scans), room)
    truncated = ((candidates.flags & PeakFlag.TRUNCATED) != 0).any(axis=1)
    return to_peak_batch(FlatPeaks.concatenate(parts), len(scans), room, truncated)


def fit_groups(
    scans: NDArray[np.uint16],
    groups: Groups,
    candidates: PeakBatch,
    settings: FitSettings,
    noise: SensorNoise,
    shape: LineSpreadFunction,
    corrections: PixelCorrections | None = None,
) -> list[SelectedFits]:
    """Fit groups, those of equal size together.

    Args:
        scans: counts of the scans, uint16, shape (L, P).
        groups: of the candidates.
        candidates: of all scans.
        settings: of the fit.
        noise: noise of the sensors.
        shape: the line-spread function.
        corrections: of the sensors' pixels; None: counts are taken as they are.
    """
    groups = replace(groups, level=background_levels(scans, corrections)[groups.scan])
    if settings.background == "surrounding-slope":
        groups = take_surroundings(scans, groups, noise, corrections)
    selected: list[SelectedFits] = []
    for count in np.unique(groups.count).tolist():
        model = WindowModel(count, settings, shape)
        part = groups[groups.count == count]
        sensor = part.scan % len(noise)
        start = initial_parameters(model, part, candidates, sensor)
        for fits in fit_windows(model, part, start, scans, noise, corrections):
            solution = marginalise_width(fits.model, fits.windows, fits.solution)
            selected.append(replace(fits, solution=solution))
    return selected


def check_scans(scans: NDArray[np.uint16]) -> None:
    """Check type, shape and length of scans.

    Raises:
        InvalidParameter: another type or shape, or a length outside MIN_PIXELS .. MAX_PIXELS.
    """
    if scans.ndim != 2 or scans.dtype != np.uint16:
        raise InvalidParameter(
            f"scans are {scans.dtype} of shape {scans.shape}; they must be uint16, (L, P)",
            shape=scans.shape,
        )
    if not MIN_PIXELS <= scans.shape[1] <= MAX_PIXELS:
        raise InvalidParameter(
            f"scans have {scans.shape[1]} pixels; they must have {MIN_PIXELS} to {MAX_PIXELS}",
            pixels=scans.shape[1],
        )
