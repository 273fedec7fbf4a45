"""Fitted peaks of lines by the definition of FitSettings, in NumPy: what the kernel must match."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.signal.fit.averaging import average_widths
from compute.signal.fit.gather import FlatPeaks, batched, fitted_peaks, unfitted_peaks
from compute.signal.fit.group import (
    Groups,
    form_groups,
    line_backgrounds,
    starting_parameters,
)
from compute.signal.fit.model import Windows
from compute.signal.fit.selection import Chosen, fit_windows
from compute.signal.fit.settings import FitSettings
from compute.signal.fit.shape import LineShape
from compute.signal.noise import LineNoise
from compute.signal.peaks import PeakBatch, PeakFlag
from compute.signal.reference import find_peaks_reference
from compute.signal.settings import MAX_PIXELS, MIN_PIXELS


def fit_lines(
    lines: NDArray[np.uint16],
    settings: FitSettings,
    noise: LineNoise,
    shape: LineShape | None = None,
    candidates: PeakBatch | None = None,
) -> PeakBatch:
    """Fit the peaks of lines, as ``FitSettings`` defines it.

    The search is written out plainly and slow; the fits of all lines go together.

    Args:
        lines: counts, shape (L, P); line l belongs to sensor ``l % len(noise)``.
        settings: how lines are fitted.
        noise: of the sensors.
        shape: how a line's light is spread; a Gaussian where there is none.
        candidates: what ``settings.search`` finds, where it is known already.

    Raises:
        InvalidParameter: lines of another type or shape, or candidates of other lines.
    """
    check_lines(lines)
    shape = LineShape.gaussian() if shape is None else shape
    if candidates is None:
        candidates = find_peaks_reference(lines, settings.search, noise)
    elif len(candidates) != len(lines):
        raise InvalidParameter(
            f"candidates are of {len(candidates)} lines; they must be of these {len(lines)}",
            candidates=len(candidates),
        )
    groups = form_groups(candidates, lines.shape[1], settings)
    parts: list[FlatPeaks] = []
    for number, fits in fitted_groups(lines, groups, candidates, settings, noise, shape):
        part = groups[number]
        for chosen in fits:
            parts.append(
                fitted_peaks(chosen, number, part, candidates, lines.shape[1], settings, shape)
            )
            parts.append(unfitted_peaks(chosen, number, part, candidates))
    room = settings.search.max_peaks
    if not parts:
        return PeakBatch.empty(len(lines), room)
    truncated = ((candidates.flags & PeakFlag.TRUNCATED) != 0).any(axis=1)
    return batched(FlatPeaks.joined(parts), len(lines), room, truncated)


def fitted_groups(
    lines: NDArray[np.uint16],
    groups: Groups,
    candidates: PeakBatch,
    settings: FitSettings,
    noise: LineNoise,
    shape: LineShape,
) -> list[tuple[NDArray[np.int64], list[Chosen]]]:
    """Fit groups, those with equally many candidates together.

    Returns:
        The numbers of such groups, and their fits, whose rows count these.
    """
    background = line_backgrounds(lines)
    found = []
    for count in np.unique(groups.count).tolist():
        number = np.flatnonzero(groups.count == count)
        part = groups[number]

        def grown(rows: NDArray[np.int64], part: Groups = part) -> Windows:
            some = part[rows]
            return Windows.cut(lines, some.line, some.grown_first_px, some.grown_last_px, noise)

        windows = Windows.cut(lines, part.line, part.first_px, part.last_px, noise)
        layout, start = starting_parameters(
            part, candidates, background, windows.sensor, settings, shape
        )
        fits = fit_windows(windows, grown, start, layout, settings, shape)
        found.append((number, [_averaged(chosen, settings, shape) for chosen in fits]))
    return found


def _averaged(chosen: Chosen, settings: FitSettings, shape: LineShape) -> Chosen:
    solution = average_widths(chosen.windows, chosen.solution, chosen.layout, settings, shape)
    return replace(chosen, solution=solution)


def check_lines(lines: NDArray[np.uint16]) -> None:
    """See that lines are what a sensor gives.

    Raises:
        InvalidParameter: another type or shape, or a length outside MIN_PIXELS .. MAX_PIXELS.
    """
    if lines.ndim != 2 or lines.dtype != np.uint16:
        raise InvalidParameter(
            f"lines are {lines.dtype} of shape {lines.shape}; they must be uint16, (L, P)",
            shape=lines.shape,
        )
    if not MIN_PIXELS <= lines.shape[1] <= MAX_PIXELS:
        raise InvalidParameter(
            f"lines have {lines.shape[1]} pixels; they must have {MIN_PIXELS} to {MAX_PIXELS}",
            pixels=lines.shape[1],
        )
