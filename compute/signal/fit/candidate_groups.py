"""Groups of candidates that are fitted together, with their pixels and initial parameters."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from compute.signal.array_rows import ArrayRows
from compute.signal.fit.fit_settings import MAX_WINDOW_PX, WIDTH_LIMITS_PX, FitSettings
from compute.signal.fit.window_model import Array, WindowModel
from compute.signal.peaks import PeakBatch

_MAX_HALF_PX = (MAX_WINDOW_PX - 1) // 2

IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Groups(ArrayRows):
    """G groups of candidates, ordered by scan and position.

    Args:
        number: by which they are told apart, shape (G,).
        scan: the scans that they are in, shape (G,).
        first_candidate: the scans' candidates with which they begin, shape (G,).
        count: numbers of candidates, shape (G,).
        first_px: first pixels, shape (G,).
        last_px: last pixels, shape (G,).
        extended_first_px: first pixels of the windows to look for further peaks in, shape (G,).
        extended_last_px: last pixels of these, shape (G,).
        split_before: the chain was cut before the group, shape (G,).
        split_after: the chain was cut after it, shape (G,).
        level: levels of the background to start with, shape (G,) [counts].
        slope: known slopes of the background, shape (G,) [counts/px].
    """

    number: IntArray
    scan: IntArray
    first_candidate: IntArray
    count: IntArray
    first_px: IntArray
    last_px: IntArray
    extended_first_px: IntArray
    extended_last_px: IntArray
    split_before: NDArray[np.bool_]
    split_after: NDArray[np.bool_]
    level: Array
    slope: Array

    def __len__(self) -> int:
        """Return G."""
        return len(self.scan)

    def candidate_indices(self) -> IntArray:
        """Return the candidates of groups of equal size, shape (G, K)."""
        return self.first_candidate[:, None] + np.arange(int(self.count.max(initial=0)))


def initial_widths(candidates: PeakBatch, settings: FitSettings) -> Array:
    """Return the initial widths of candidates, shape (L, K) [px]; see ``FitSettings``.

    Args:
        candidates: of L scans, at most K each.
        settings: of the fit.
    """
    if settings.width_log_sigma == 0.0:
        return np.full(candidates.width_px.shape, settings.width_px)
    fraction = settings.search.threshold_fraction
    width = candidates.width_px.astype(np.float64) / (2.0 * np.sqrt(-2.0 * np.log(fraction)))
    factor = np.exp(2.0 * settings.width_log_sigma) if settings.width_log_sigma < 100.0 else np.inf
    low, high = settings.width_px / factor, settings.width_px * factor
    return np.asarray(np.clip(np.clip(width, low, high), *WIDTH_LIMITS_PX))


def form_groups(candidates: PeakBatch, pixels: int, settings: FitSettings) -> Groups:
    """Group candidates whose windows overlap.

    Args:
        candidates: of L scans.
        pixels: pixels of a scan.
        settings: of the fit.
    """
    widths = initial_widths(candidates, settings)
    rows: list[tuple[int, ...]] = []
    for scan in np.flatnonzero(candidates.count).tolist():
        count = int(candidates.count[scan])
        position_px = candidates.position_px[scan, :count]
        half = np.ceil(settings.reach * widths[scan, :count]).astype(np.int64) + 1
        half = np.minimum(half, _MAX_HALF_PX)
        pixel = np.floor(position_px + 0.5).astype(np.int64)
        low, high = pixel - half, pixel + half
        cuts: set[int] = set()
        bounds = [0, *(np.flatnonzero(high[:-1] < low[1:]) + 1).tolist(), count]
        parts = [
            part
            for ends in pairwise(bounds)
            for part in _cut(*ends, position_px, low, high, settings.max_joint_peaks, cuts)
        ]
        first = np.array([low[start:stop].min() for start, stop in parts])
        last = np.array([high[start:stop].max() for start, stop in parts])
        reach = np.array([half[start:stop].max() for start, stop in parts])
        stops = np.array([stop for _, stop in parts[:-1]], dtype=np.int64)
        boundary = np.floor(0.5 * (position_px[stops - 1] + position_px[stops])).astype(np.int64)
        last[:-1], first[1:] = np.minimum(last[:-1], boundary), np.maximum(first[1:], boundary + 1)
        first, last = np.maximum(first, 0), np.minimum(last, pixels - 1)
        grown_first, grown_last = _extend(first, last, reach, pixels)
        rows += [
            (scan, start, stop - start, *ends, start in cuts, stop in cuts)
            for (start, stop), *ends in zip(
                parts, first, last, grown_first, grown_last, strict=True
            )
        ]
    table = np.array(rows, dtype=np.int64).reshape(-1, 9).T
    zeros = np.zeros(len(rows))
    before, after = table[7:].astype(bool)
    columns = (np.arange(len(rows)), *table[:7], before, after, zeros, zeros)
    return Groups(*columns)


def _extend(
    first: IntArray, last: IntArray, reach: IntArray, pixels: int
) -> tuple[IntArray, IntArray]:
    """Return the windows of a scan grown by ``reach``, up to midway between them."""
    by = np.minimum(reach, (MAX_WINDOW_PX - (last - first + 1)) // 2)
    boundary = (last[:-1] + first[1:]) // 2
    return (
        np.maximum(first - by, np.concatenate([[0], boundary + 1])),
        np.minimum(last + by, np.concatenate([boundary, [pixels - 1]])),
    )


def _cut(
    start: int,
    stop: int,
    position_px: Array,
    low: IntArray,
    high: IntArray,
    max_candidates: int,
    cuts: set[int],
) -> list[tuple[int, int]]:
    """Cut a chain of candidates ``start`` to ``stop`` at its widest gaps until its parts fit."""
    length = int(high[start:stop].max() - low[start:stop].min()) + 1
    if stop - start <= max_candidates and length <= MAX_WINDOW_PX:
        return [(start, stop)]
    split = start + 1 + int(np.argmax(np.diff(position_px[start:stop])))
    cuts.add(split)
    return [
        part
        for ends in ((start, split), (split, stop))
        for part in _cut(*ends, position_px, low, high, max_candidates, cuts)
    ]


def initial_parameters(
    model: WindowModel,
    groups: Groups,
    candidates: PeakBatch,
    sensor: IntArray,
) -> Array:
    """Return the initial parameters of groups of ``model.peaks`` candidates, shape (G, Q).

    Args:
        model: the model.
        groups: G groups.
        candidates: of all scans.
        sensor: sensors of the groups' scans, shape (G,).
    """
    member = (groups.scan[:, None], groups.candidate_indices())
    log_width = np.log(initial_widths(candidates, model.settings)[member]).mean(axis=1)
    position = candidates.position_px[member]
    share = model.central_pixel_fraction(np.exp(log_width)[:, None], sensor[:, None], position)
    start = np.zeros((len(groups), model.size))
    start[:, 0] = groups.level
    start[:, model.light] = candidates.amplitude[member] / share
    start[:, model.position] = position
    start[:, -1] = log_width
    return start
