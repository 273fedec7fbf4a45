"""How many lines a window holds: one more is tried where chance does not explain the misfit."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.signal.fit.model import Array, Layout, Windows, evaluate, middle_share
from compute.signal.fit.settings import (
    SPLIT_LOG_WIDTH,
    SPLIT_WIDTHS,
    WIDTH_LIMITS_PX,
    FitSettings,
)
from compute.signal.fit.shape import LineShape
from compute.signal.fit.solve import Solution, solve

_ADDED = 2  # parameters of a line: light and position


@dataclass(frozen=True, eq=False)
class Chosen:
    """The groups that hold so many lines, with their fits.

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

    def __getitem__(self, rows: NDArray[np.bool_]) -> "Chosen":
        """Return some of them."""
        return Chosen(self.layout, self.rows[rows], self.windows[rows], self.solution[rows])


Cut = Callable[[NDArray[np.int64]], Windows]
"""Cuts the grown windows of groups, by their numbers."""


def fit_windows(
    windows: Windows,
    grown: Cut,
    start: Array,
    layout: Layout,
    settings: FitSettings,
    shape: LineShape,
) -> list[Chosen]:
    """Fit as many lines as each window shows, ``layout.peaks`` or, if the settings allow, more.

    Args:
        windows: N windows with ``layout.peaks`` candidates each.
        grown: cuts the grown windows of some of them.
        start: where the fits of these start, shape (N, Q).
        layout: the order of the parameters.
        settings: how lines are fitted.
        shape: the lines' shape.

    Returns:
        By the number of lines, each window in one of them.
    """
    rows = np.arange(len(windows))
    first = Chosen(layout, rows, windows, solve(windows, start, layout, settings, shape))
    poor = _poor(first.solution, settings) if settings.further_peaks else ~first.solution.good
    if layout.peaks >= settings.max_joint or not poor.any():
        return [first]
    wide = grown(rows[poor])
    base = np.where(first.solution.good[poor, None], first.solution.parameters[poor], start[poor])
    again = solve(wide, base, layout, settings, shape)
    base = np.where(again.good[:, None], again.parameters, base)
    many: list[Chosen] = []
    stood = np.zeros(len(base), bool)
    if settings.further_peaks:
        many, stood = _with_more(Chosen(layout, rows[poor], wide, again), base, settings, shape)
    # Where none stood: the first window's fit, or else the grown one's.
    instead = ~stood & ~first.solution.good[poor] & again.good
    keep = ~poor
    keep[rows[poor][~stood & ~instead]] = True
    second = Chosen(layout, rows[poor], wide, again)[instead]
    return [first[keep], second, *many]


def _poor(solution: Solution, settings: FitSettings) -> NDArray[np.bool_]:
    limit = settings.misfit_limits()[np.maximum(solution.freedom, 0)]
    return ~solution.good | (solution.chi2 > limit)


def _with_more(
    fits: Chosen, base: Array, settings: FitSettings, shape: LineShape
) -> tuple[list[Chosen], NDArray[np.bool_]]:
    """Add lines as long as they stand; say which of the windows got any."""
    found: list[Chosen] = []
    stood: NDArray[np.bool_] | None = None
    while len(fits.rows) and fits.layout.peaks < settings.max_joint:
        layout, more = _one_more(fits.windows, base, fits.layout, settings, shape)
        with np.errstate(invalid="ignore"):
            fall = fits.solution.merit - more.merit
        needed = _ADDED * np.log(np.maximum(fits.windows.count, 1)) + settings.split_margin
        better = more.good & (fall > needed)
        if stood is None:
            stood = better
        else:
            found.append(fits[~better])
        fits = Chosen(layout, fits.rows[better], fits.windows[better], more[better])
        poor = _poor(fits.solution, settings)
        found.append(fits[~poor])
        fits = fits[poor]
        base = fits.solution.parameters
    return [*found, fits], np.zeros(0, bool) if stood is None else stood


def _one_more(
    windows: Windows, parameters: Array, layout: Layout, settings: FitSettings, shape: LineShape
) -> tuple[Layout, Solution]:
    """Return the best fits by one line more, from each split in two and at the worst residual."""
    more = Layout(layout.peaks + 1, layout.slope)
    starts = [
        _split(parameters, k, layout, more, fitted_width=settings.width_spread > 0.0)
        for k in range(layout.peaks)
    ]
    starts.append(_at_residual(windows, parameters, layout, more, settings, shape))
    tries = [solve(windows, start, more, settings, shape) for start in starts]
    merits = [np.where(one.good, one.merit, np.inf) for one in tries]
    best = np.argmin(merits, axis=0)
    return more, Solution(
        *(
            np.stack([getattr(one, name) for one in tries])[best, np.arange(len(best))]
            for name in vars(tries[0])
        )
    )


def _split(parameters: Array, k: int, layout: Layout, more: Layout, *, fitted_width: bool) -> Array:
    """Return starts with line k split in two."""
    light, position = parameters[:, layout.light], parameters[:, layout.position]
    apart = SPLIT_WIDTHS * np.exp(parameters[:, -1])
    start = _widened(parameters, layout, more)
    start[:, more.light] = np.insert(light, k, light[:, k], axis=1)
    start[:, more.light][:, k : k + 2] *= 0.5
    start[:, more.position] = np.insert(position, k, position[:, k], axis=1)
    start[:, more.position][:, k] -= apart
    start[:, more.position][:, k + 1] += apart
    if fitted_width:
        start[:, -1] = np.clip(start[:, -1] - SPLIT_LOG_WIDTH, *np.log(WIDTH_LIMITS_PX))
    return start


def _at_residual(
    windows: Windows,
    parameters: Array,
    layout: Layout,
    more: Layout,
    settings: FitSettings,
    shape: LineShape,
) -> Array:
    """Return starts with a line added at the pixel of the largest residual in deviations."""
    model = evaluate(windows, parameters, layout, settings, shape)
    residual = np.where(windows.used, windows.values - model.mean, -np.inf)
    worst = np.argmax(residual / np.sqrt(model.variance), axis=1)
    place = (windows.first_px + worst).astype(np.float64)
    height = residual[np.arange(len(worst)), worst]
    start = _widened(parameters, layout, more)
    share = middle_share(shape, np.exp(parameters[:, -1]), windows.sensor, place)
    light = np.column_stack([parameters[:, layout.light], height / share])
    position = np.column_stack([parameters[:, layout.position], place])
    start[:, more.light], start[:, more.position] = light, position
    return start


def _widened(parameters: Array, layout: Layout, more: Layout) -> Array:
    """Return parameters with room for a line more; background and width as they are."""
    start = np.zeros((len(parameters), more.size))
    start[:, : layout.background] = parameters[:, : layout.background]
    start[:, -1] = parameters[:, -1]
    return start
