"""Number of peaks in a window: a further one is tried where noise does not explain the misfit."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.signal.fit.fisher_scoring import Solution, solve
from compute.signal.fit.fit_settings import (
    SPLIT_LOG_WIDTH,
    SPLIT_WIDTHS,
    WIDTH_LIMITS_PX,
    FitSettings,
)
from compute.signal.fit.line_spread_function import LineSpreadFunction
from compute.signal.fit.window_model import Array, Layout, Windows, central_pixel_fraction, evaluate

_ADDED = 2  # parameters of a line: light and position


@dataclass(frozen=True, eq=False)
class SelectedFits:
    """Groups that hold the same number of peaks, with their fits.

    Args:
        layout: the order of the parameters.
        rows: numbers of the groups, shape (M,).
        windows: in which they were fitted; M of them.
        solution: fits of these.
    """

    layout: Layout
    rows: NDArray[np.int64]
    windows: Windows
    solution: Solution

    def __getitem__(self, rows: NDArray[np.bool_]) -> "SelectedFits":
        """Return some of them."""
        return SelectedFits(self.layout, self.rows[rows], self.windows[rows], self.solution[rows])


CutWindows = Callable[[NDArray[np.int64]], Windows]
"""Cuts the grown windows of groups, by their numbers."""


def fit_windows(
    windows: Windows,
    extended: CutWindows,
    start: Array,
    layout: Layout,
    settings: FitSettings,
    shape: LineSpreadFunction,
) -> list[SelectedFits]:
    """Fit as many lines as each window shows, ``layout.peaks`` or, if the settings allow, more.

    Args:
        windows: N windows with ``layout.peaks`` candidates each.
        extended: cuts the grown windows of some of them.
        start: where the fits of these start, shape (N, Q).
        layout: the order of the parameters.
        settings: of the fit.
        shape: the line-spread function.

    Returns:
        By the number of lines, each window in one of them.
    """
    rows = np.arange(len(windows))
    first = SelectedFits(layout, rows, windows, solve(windows, start, layout, settings, shape))
    poor = _misfits(first.solution, settings) if settings.further_peaks else ~first.solution.good
    if layout.peaks >= settings.max_joint_peaks or not poor.any():
        return [first]
    wide = extended(rows[poor])
    base = np.where(first.solution.good[poor, None], first.solution.parameters[poor], start[poor])
    again = solve(wide, base, layout, settings, shape)
    base = np.where(again.good[:, None], again.parameters, base)
    many: list[SelectedFits] = []
    accepted = np.zeros(len(base), bool)
    if settings.further_peaks:
        many, accepted = _add_peaks(
            SelectedFits(layout, rows[poor], wide, again), base, settings, shape
        )
    # Where none stood: the first window's fit, or else the grown one's.
    instead = ~accepted & ~first.solution.good[poor] & again.good
    keep = ~poor
    keep[rows[poor][~accepted & ~instead]] = True
    second = SelectedFits(layout, rows[poor], wide, again)[instead]
    return [first[keep], second, *many]


def _misfits(solution: Solution, settings: FitSettings) -> NDArray[np.bool_]:
    limit = settings.chi2_limits()[np.maximum(solution.dof, 0)]
    return ~solution.good | (solution.chi2 > limit)


def _add_peaks(
    fits: SelectedFits, base: Array, settings: FitSettings, shape: LineSpreadFunction
) -> tuple[list[SelectedFits], NDArray[np.bool_]]:
    """Add lines as long as they stand; say which of the windows got any."""
    found: list[SelectedFits] = []
    accepted: NDArray[np.bool_] | None = None
    while len(fits.rows) and fits.layout.peaks < settings.max_joint_peaks:
        layout, more = _best_additional_peak(fits.windows, base, fits.layout, settings, shape)
        with np.errstate(invalid="ignore"):
            fall = fits.solution.deviance - more.deviance
        needed = _ADDED * np.log(np.maximum(fits.windows.count, 1)) + settings.split_margin
        better = more.good & (fall > needed)
        if accepted is None:
            accepted = better
        else:
            found.append(fits[~better])
        fits = SelectedFits(layout, fits.rows[better], fits.windows[better], more[better])
        poor = _misfits(fits.solution, settings)
        found.append(fits[~poor])
        fits = fits[poor]
        base = fits.solution.parameters
    return [*found, fits], np.zeros(0, bool) if accepted is None else accepted


def _best_additional_peak(
    windows: Windows,
    parameters: Array,
    layout: Layout,
    settings: FitSettings,
    shape: LineSpreadFunction,
) -> tuple[Layout, Solution]:
    """Return the best fits by one line more, from each split in two and at the worst residual."""
    more = Layout(layout.peaks + 1, layout.slope)
    starts = [
        _start_from_split(parameters, k, layout, more, fitted_width=settings.width_log_sigma > 0.0)
        for k in range(layout.peaks)
    ]
    starts.append(_start_at_largest_residual(windows, parameters, layout, more, settings, shape))
    tries = [solve(windows, start, more, settings, shape) for start in starts]
    merits = [np.where(one.good, one.deviance, np.inf) for one in tries]
    best = np.argmin(merits, axis=0)
    return more, Solution(
        *(
            np.stack([getattr(one, name) for one in tries])[best, np.arange(len(best))]
            for name in vars(tries[0])
        )
    )


def _start_from_split(
    parameters: Array, k: int, layout: Layout, more: Layout, *, fitted_width: bool
) -> Array:
    """Return starts with line k split in two."""
    light, position = parameters[:, layout.light], parameters[:, layout.position]
    apart = SPLIT_WIDTHS * np.exp(parameters[:, -1])
    start = _with_room_for_peak(parameters, layout, more)
    start[:, more.light] = np.insert(light, k, light[:, k], axis=1)
    start[:, more.light][:, k : k + 2] *= 0.5
    start[:, more.position] = np.insert(position, k, position[:, k], axis=1)
    start[:, more.position][:, k] -= apart
    start[:, more.position][:, k + 1] += apart
    if fitted_width:
        start[:, -1] = np.clip(start[:, -1] - SPLIT_LOG_WIDTH, *np.log(WIDTH_LIMITS_PX))
    return start


def _start_at_largest_residual(
    windows: Windows,
    parameters: Array,
    layout: Layout,
    more: Layout,
    settings: FitSettings,
    shape: LineSpreadFunction,
) -> Array:
    """Return starts with a line added at the pixel of the largest residual in deviations."""
    model = evaluate(windows, parameters, layout, settings, shape)
    residual = np.where(windows.used, windows.values - model.mean, -np.inf)
    worst = np.argmax(residual / np.sqrt(model.variance), axis=1)
    place = (windows.first_px + worst).astype(np.float64)
    height = residual[np.arange(len(worst)), worst]
    start = _with_room_for_peak(parameters, layout, more)
    share = central_pixel_fraction(shape, np.exp(parameters[:, -1]), windows.sensor, place)
    light = np.column_stack([parameters[:, layout.light], height / share])
    position = np.column_stack([parameters[:, layout.position], place])
    start[:, more.light], start[:, more.position] = light, position
    return start


def _with_room_for_peak(parameters: Array, layout: Layout, more: Layout) -> Array:
    """Return parameters with room for a line more; background and width as they are."""
    start = np.zeros((len(parameters), more.size))
    start[:, : layout.background] = parameters[:, : layout.background]
    start[:, -1] = parameters[:, -1]
    return start
