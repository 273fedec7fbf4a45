"""Tracking metrics: GOSPA (by Stone Soup), identity switches, consistency, time."""

import statistics
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

Array = NDArray[np.float64]

CUT_MM = 20.0
"""GOSPA's cut-off: further than this a track is false and its marker missed."""
ORDER = 2.0
DISTINGUISHABLE_MM = 6.0
"""Markers nearer to one another may be anybody's for that exposure."""


@dataclass(frozen=True, eq=False)
class Tracked:
    """A tracker's report of one exposure.

    Args:
        identity: shape (T,).
        position_mm: shape (T, 3).
        covariance_mm2: shape (T, 3, 3).
        seconds: time that it took.
    """

    identity: NDArray[np.int64]
    position_mm: Array
    covariance_mm2: Array
    seconds: float


def score(tracked: list[Tracked], positions_mm: Array) -> dict[str, float]:
    """Return the metrics of a run against the true positions (F, N, 3).

    ``switches`` counts how often a marker is followed by another track than the last that followed
    it while no other marker was near; ``held`` is the share of markers and exposures that are
    followed at all; ``nees`` is the median of the normalised position error squared, 2.37 when
    covariances are right; ``rms_mm`` is of tracks and the markers that they follow.
    """
    last: dict[int, int] = {}
    switches = held = 0
    nees: list[float] = []
    squares: list[float] = []
    gospa: list[float] = []
    for frame, positions in zip(tracked, positions_mm, strict=True):
        apart = np.linalg.norm(frame.position_mm[:, None] - positions[None], axis=2)
        between = np.linalg.norm(positions[:, None] - positions[None], axis=2)
        lonely = (between < DISTINGUISHABLE_MM).sum(axis=1) == 1
        tracks, markers = linear_sum_assignment(np.minimum(apart, CUT_MM))
        for track, marker in zip(tracks.tolist(), markers.tolist(), strict=True):
            if apart[track, marker] >= CUT_MM:
                continue
            held += 1
            number = int(frame.identity[track])
            if lonely[marker]:
                switches += last.get(marker, number) != number
                last[marker] = number
            off = frame.position_mm[track] - positions[marker]
            nees.append(float(off @ np.linalg.solve(frame.covariance_mm2[track], off)))
            squares.append(float(off @ off))
        gospa.append(_gospa(frame.position_mm, positions))
    return {
        "gospa_mm": statistics.fmean(gospa),
        "switches": float(switches),
        "held": held / positions_mm.shape[0] / positions_mm.shape[1],
        "rms_mm": float(np.sqrt(statistics.fmean(squares))) if squares else float("nan"),
        "nees": statistics.median(nees) if nees else float("nan"),
        "ms_per_frame": 1e3 * statistics.fmean(frame.seconds for frame in tracked),
    }


def _gospa(found: Array, positions: Array) -> float:
    from stonesoup.metricgenerator.ospametric import GOSPAMetric
    from stonesoup.types.state import State

    metric = GOSPAMetric(p=ORDER, c=CUT_MM)
    result, _ = metric.compute_gospa_metric(
        [State(p) for p in found], [State(p) for p in positions]
    )
    return float(result.value["distance"])
