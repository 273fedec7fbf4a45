"""All intersections of an exposure's peaks, ghosts included."""

from dataclasses import dataclass
from functools import cache
from itertools import combinations
from math import comb, inf, log
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements
from compute.reconstruction.correspondence.candidates import (
    Candidates,
    MatchSettings,
    MisfitDensity,
    Solve,
    solve_combinations,
)
from compute.reconstruction.correspondence.incremental import complete_triples
from compute.reconstruction.point_batch import Batch

Array = NDArray[np.float64]

MAX_TRIPLES: Final = 10_000
"""Combinations of three peaks that are tried in an exposure; more are tried part by part."""
MAX_GHOSTS: Final = 40.0
"""Most chance intersections for which a number of sensors suffices."""
GATE_PX: Final = 1.0
"""Approximate width of a reading's gate."""
MAX_PIXELS: Final = 4096.0
MAX_PREDICTED: Final = 24_000
"""Most readings predicted in an exposure; further triples of sensors wait for the next."""
MAX_INTERSECTION_POINTS: Final = 600
"""Points that are returned, the most probable."""


@dataclass(frozen=True, eq=False)
class IntersectionPoints(Batch):
    """N combinations of three peaks or more that meet in a point.

    Args:
        choice: index of each sensor's peak, in the order given; -1: none, shape (N, S).
        position_mm: shape (N, 3).
        covariance_mm2: shape (N, 3, 3).
        position_px: of the peaks; NaN where there is none, shape (N, S).
        sigma_px: of the peaks; NaN where there is none, shape (N, S).
        log_ratio: log likelihood ratio of these peaks being one marker's to being no one's,
            integrated over space [mm^3]; other sensors missed it, shape (N,).
        log_ratio_with_prior: with a marker anywhere; minus infinity where three peaks say nothing,
            shape (N,).
    """

    choice: Annotated[NDArray[np.intp], "S"]
    position_mm: Annotated[Array, 3]
    covariance_mm2: Annotated[Array, 3, 3]
    position_px: Annotated[Array, "S"]
    sigma_px: Annotated[Array, "S"]
    log_ratio: Array
    log_ratio_with_prior: Array


@dataclass(frozen=True, eq=False)
class SearchPart:
    """Part of an exposure's combinations that is tried.

    Args:
        base_index: which of the triples of sensors, that no marker escapes, to start from.
        first_px: first reading of its first sensor that is looked at.
    """

    base_index: int = 0
    first_px: float = -inf


def intersection_points(
    solve: Solve,
    model: MeasurementModel,
    measurements: Measurements,
    part: SearchPart,
    settings: MatchSettings,
) -> tuple[IntersectionPoints, float]:
    """Return the points where peaks of four sensors or more meet.

    Four sensors must agree at least; more, where too many combinations of four would by chance.
    The triples of sensors to start from, that no marker escapes, take turns as far as there is
    work in them for several exposures.

    Args:
        solve: reconstructs.
        model: the measurement model.
        measurements: the peaks of S sensors.
        part: of the combinations.
        settings: the model of peaks.

    Returns:
        The points, and the first reading of the part that comes next; minus infinity: all were
        tried.
    """
    peaks = measurements.sort()
    seeing = np.flatnonzero(peaks.count > 0)
    misfit_density = MisfitDensity()
    candidates: list[Candidates] = []
    following = -inf
    if len(seeing) >= 4:
        least = _min_sensors(peaks, seeing)
        bases = covering_triples(len(seeing), least)
        work = 0
        for base_index in range(len(bases)):
            base = seeing[list(bases[(part.base_index + base_index) % len(bases)])]
            combinations = int(np.prod(peaks.count[base], dtype=np.int64))
            if base_index and (work + combinations) * len(seeing) > MAX_PREDICTED:
                break
            work += combinations
            free, following = _slice(peaks, base, part.first_px)
            choice, _ = complete_triples(
                solve,
                model,
                peaks,
                free,
                (int(base[0]), int(base[1]), int(base[2])),
                least,
                settings.max_points,
                misfit_density,
            )
            if len(choice):
                candidates.append(solve_combinations(solve, peaks, choice).candidates)
    return _merged(model, peaks, candidates, settings), following


def _min_sensors(peaks: Measurements, seeing: NDArray[np.intp]) -> int:
    """Return the number of sensors that must agree to limit chance combinations."""
    sensors = len(seeing)
    count = float(peaks.count[seeing].mean())
    by_chance = float(np.exp(peaks.log_density(1.0 / MAX_PIXELS)[seeing].mean())) * GATE_PX
    for least in range(4, sensors):
        ways = comb(sensors - 3, least - 3) * by_chance ** (least - 3)
        if count**3 * ways <= MAX_GHOSTS:
            return least
    return sensors


def _slice(
    peaks: Measurements, base: NDArray[np.intp], first_px: float
) -> tuple[NDArray[np.bool_], float]:
    """Return the peaks that are looked at, and the first of the next part."""
    free = peaks.usable.copy()
    others = int(peaks.count[base[1]] * peaks.count[base[2]])
    room = max(MAX_TRIPLES // max(others, 1), 1)
    sensor = int(base[0])
    line = peaks.position_px[sensor, : peaks.count[sensor]]
    begin = int(np.searchsorted(line, first_px))
    if begin >= len(line):
        begin = 0
    free[sensor, : len(line)] = False
    free[sensor, begin : begin + room] = True
    return free, float(line[begin + room]) if begin + room < len(line) else -inf


def _merged(
    model: MeasurementModel,
    peaks: Measurements,
    candidates: list[Candidates],
    settings: MatchSettings,
) -> IntersectionPoints:
    """Return candidates as points, each combination once, in an order of their own."""
    sensors = len(peaks)
    merged = Candidates.concatenate([Candidates.empty(sensors), *candidates])
    if len(merged) == 0:
        return IntersectionPoints.empty(sensors)
    _, index = np.unique(merged.choice, axis=0, return_index=True)
    merged = merged.rows(index)
    used = merged.choice >= 0
    missed = (~used & model.predict(merged.position_mm).in_view).sum(axis=1)
    log_clutter = np.log(settings.detection_probability) - peaks.log_density(
        settings.clutter_density_per_px
    )
    peaks_only = merged.log_marginal + used @ log_clutter
    peaks_only += missed * settings.log_missed
    alone = np.where(used.sum(axis=1) > 3, peaks_only + log(settings.markers_per_mm3), -inf)
    if len(merged) > MAX_INTERSECTION_POINTS:
        best = np.sort(np.argsort(-peaks_only, kind="stable")[:MAX_INTERSECTION_POINTS])
        merged, used, peaks_only, alone = (
            merged.rows(best),
            used[best],
            peaks_only[best],
            alone[best],
        )
    position, sigma = peaks.readings(merged.choice)
    assert peaks.original_index is not None
    original_index = np.where(used, peaks.original_index[np.arange(sensors), merged.choice], -1)
    return IntersectionPoints(
        original_index,
        merged.position_mm,
        merged.covariance_mm2,
        position,
        sigma,
        peaks_only,
        alone,
    )


@cache
def covering_triples(sensors: int, detecting: int) -> tuple[tuple[int, int, int], ...]:
    """Return triples such that every choice of ``detecting`` of the sensors holds one of them.

    Greedy: each triple is the one that most of the choices left hold, the first in order of
    equals. For four sensors that all see, one triple is enough; for 4 of 8 it takes about twenty
    of the 56 (Turan's numbers are the least that there can be).

    Args:
        sensors: how many there are, at least ``detecting``.
        detecting: how many see a marker, at least 3.
    """
    triples = list(combinations(range(sensors), 3))
    open_choices = {frozenset(choice) for choice in combinations(range(sensors), detecting)}
    chosen = []
    while open_choices:
        best = max(
            triples, key=lambda triple: sum(choice.issuperset(triple) for choice in open_choices)
        )
        chosen.append(best)
        open_choices = {choice for choice in open_choices if not choice.issuperset(best)}
    return tuple(chosen)
