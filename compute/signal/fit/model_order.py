"""Number of peaks in a window: a further one is tried where noise does not explain the misfit."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.signal.fit.candidate_groups import Groups
from compute.signal.fit.fisher_scoring import Solution, solve
from compute.signal.fit.fit_settings import (
    SPLIT_LOG_WIDTH,
    SPLIT_WIDTHS,
    WIDTH_LIMITS_PX,
    FitSettings,
)
from compute.signal.fit.window_model import Array, WindowModel, Windows
from compute.signal.pixel_corrections import PixelCorrections
from compute.signal.sensor_noise import SensorNoise

_ADDED = 2  # parameters of a peak: light and position


@dataclass(frozen=True, eq=False)
class SelectedFits:
    """M groups that are fitted by the same number of peaks, with their fits.

    Args:
        model: of these peaks.
        groups: the groups.
        windows: in which they were fitted.
        solution: their fits.
    """

    model: WindowModel
    groups: Groups
    windows: Windows
    solution: Solution

    def __getitem__(self, rows: NDArray[np.bool_]) -> "SelectedFits":
        """Return some of them."""
        return SelectedFits(self.model, self.groups[rows], self.windows[rows], self.solution[rows])


def fit_windows(
    model: WindowModel,
    groups: Groups,
    start: Array,
    scans: NDArray[np.uint16],
    noise: SensorNoise,
    corrections: PixelCorrections | None = None,
) -> list[SelectedFits]:
    """Fit as many peaks as each window shows, ``model.peaks`` or, if the settings allow, more.

    Args:
        model: of as many peaks as each group has candidates.
        groups: N groups of candidates.
        start: where their fits start, shape (N, Q).
        scans: counts of the scans, shape (L, P).
        noise: of the sensors.
        corrections: of their pixels; None: counts are taken as they are.

    Returns:
        By the number of peaks, each group in one of them.
    """
    settings = model.settings
    windows = Windows.cut(
        scans, groups.scan, groups.first_px, groups.last_px, noise, corrections, groups.slope
    )
    first = SelectedFits(model, groups, windows, solve(model, windows, start))
    good = first.solution.good
    poor = _misfits(first.solution, settings) if settings.further_peaks else ~good
    if model.peaks >= settings.max_joint_peaks or not poor.any():
        return [first]
    part = groups[poor]
    ends = (part.extended_first_px, part.extended_last_px)
    wide = Windows.cut(scans, part.scan, *ends, noise, corrections, part.slope)
    base = np.where(good[poor, None], first.solution.parameters[poor], start[poor])
    again = SelectedFits(model, part, wide, solve(model, wide, base))
    base = np.where(again.solution.good[:, None], again.solution.parameters, base)
    many: list[SelectedFits] = []
    accepted = np.zeros(len(base), bool)
    if settings.further_peaks:
        many, accepted = _add_peaks(again, base)
    # Where none stood: the first window's fit, or else the grown one's.
    instead = ~accepted & ~good[poor] & again.solution.good
    keep = ~poor
    keep[poor] = ~accepted & ~instead
    return [first[keep], again[instead], *many]


def _misfits(solution: Solution, settings: FitSettings) -> NDArray[np.bool_]:
    limit = settings.chi2_limits()[np.maximum(solution.dof, 0)]
    return ~solution.good | (solution.chi2 > limit)


def _add_peaks(fits: SelectedFits, base: Array) -> tuple[list[SelectedFits], NDArray[np.bool_]]:
    """Add peaks as long as they stand; say which of the windows got any."""
    settings = fits.model.settings
    selected: list[SelectedFits] = []
    accepted: NDArray[np.bool_] | None = None
    while len(fits.groups) and fits.model.peaks < settings.max_joint_peaks:
        more = _best_additional_peak(fits.model, fits.windows, base)
        with np.errstate(invalid="ignore"):
            fall = fits.solution.deviance - more.deviance
        needed = _ADDED * np.log(np.maximum(fits.windows.count, 1)) + settings.split_margin
        better = more.good & (fall > needed)
        if accepted is None:
            accepted = better
        else:
            selected.append(fits[~better])
        fits = SelectedFits(
            fits.model.with_peak_more(), fits.groups[better], fits.windows[better], more[better]
        )
        poor = _misfits(fits.solution, settings)
        selected.append(fits[~poor])
        fits = fits[poor]
        base = fits.solution.parameters
    return [*selected, fits], np.zeros(0, bool) if accepted is None else accepted


def _best_additional_peak(model: WindowModel, windows: Windows, parameters: Array) -> Solution:
    """Return the best fits by one peak more, from each split in two and at the worst residual."""
    starts = [_start_from_split(model, parameters, k) for k in range(model.peaks)]
    starts.append(_start_at_largest_residual(model, windows, parameters))
    tries = [solve(model.with_peak_more(), windows, start) for start in starts]
    best = np.argmin([np.where(one.good, one.deviance, np.inf) for one in tries], axis=0)
    row = np.arange(len(best))
    columns = zip(*(vars(one).values() for one in tries), strict=True)
    return Solution(*(np.stack(column)[best, row] for column in columns))


def _start_from_split(model: WindowModel, parameters: Array, k: int) -> Array:
    """Return starts with peak k split in two."""
    light, position = parameters[:, model.light], parameters[:, model.position]
    apart = SPLIT_WIDTHS * np.exp(parameters[:, -1])
    light, position = (np.insert(each, k, each[:, k], axis=1) for each in (light, position))
    light[:, k : k + 2] *= 0.5
    position[:, k] -= apart
    position[:, k + 1] += apart
    start = _with_peaks(model, parameters, light, position)
    if model.settings.width_log_sigma > 0.0:
        start[:, -1] = np.clip(start[:, -1] - SPLIT_LOG_WIDTH, *np.log(WIDTH_LIMITS_PX))
    return start


def _start_at_largest_residual(model: WindowModel, windows: Windows, parameters: Array) -> Array:
    """Return starts with a peak added at the pixel of the largest residual in deviations."""
    expected = model.evaluate(windows, parameters)
    residual = np.where(windows.used, windows.values - expected.mean, -np.inf)
    worst = np.argmax(residual / np.sqrt(expected.variance), axis=1)
    position_px = (windows.first_px + worst).astype(np.float64)
    height = residual[np.arange(len(worst)), worst]
    share = model.central_pixel_fraction(np.exp(parameters[:, -1]), windows.sensor, position_px)
    light = np.column_stack([parameters[:, model.light], height / share])
    position = np.column_stack([parameters[:, model.position], position_px])
    return _with_peaks(model, parameters, light, position)


def _with_peaks(model: WindowModel, parameters: Array, light: Array, position: Array) -> Array:
    """Return parameters with these lights and positions; background and width as they are."""
    background = parameters[:, : model.background_size]
    return np.column_stack([background, light, position, parameters[:, -1]])
