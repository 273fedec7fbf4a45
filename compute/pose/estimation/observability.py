"""Observability: which motions of a tool its readings determine, and which they do not."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.pose.rigid_body import CentredMarkers, are_collinear
from compute.pose.settings import POSE_PARAMETERS, PoseFitSettings

Array = NDArray[np.float64]

RANK_RATIO = 1e-12
"""Smallest ratio of eigenvalues of a normal matrix in mm; below it a direction is undetermined."""


@dataclass(frozen=True, eq=False)
class Observability:
    """Standard deviations of the independent motions of a tool.

    Args:
        sd_mm: standard deviations of the six principal motions, best first, at the markers'
            radius, shape (6,) [mm]; infinite where undetermined.
        worst: the last of them: rotation times radius, then shift of the centroid, along the
            world's axes, of length 1, shape (6,).
        reason: why there is no pose; None if there is one.
    """

    sd_mm: Array
    worst: Array
    reason: str | None

    @property
    def observable(self) -> bool:
        """Whether all six motions are determined well enough."""
        return self.reason is None


def missing_readings(
    centred: CentredMarkers, used: NDArray[np.bool_], settings: PoseFitSettings
) -> str | None:
    """Return why readings cannot determine a pose, whatever their values; None if they may.

    Args:
        centred: the tool's markers.
        used: which readings there are, shape (M, S).
        settings: smallest number of readings.
    """
    count = int(used.sum())
    markers = np.flatnonzero(used.any(axis=1))
    if count < settings.min_readings:
        return (
            f"{_number(count, 'reading')} of {_number(len(markers), 'marker')}; a pose takes "
            f"{POSE_PARAMETERS} and {settings.min_redundancy} more to check them"
        )
    if len(markers) == len(centred.markers_mm) and not centred.collinear:
        return None
    if len(markers) < 3 or are_collinear(centred.markers_mm[markers]):
        return (
            f"only {_listed('marker', markers)} were seen, which are on a line: nothing tells the "
            "turn about it"
        )
    return None


def observability(
    normal: Array, centred: CentredMarkers, used: NDArray[np.bool_], settings: PoseFitSettings
) -> Observability:
    """Return the standard deviations of the motions of a pose, by its normal matrix.

    Args:
        normal: inverse covariance of (rotation times radius, shift of the centroid), shape (6, 6)
            [1/mm^2].
        centred: the tool's markers.
        used: readings that the pose was fitted to, shape (M, S).
        settings: largest standard deviation of a motion.
    """
    values, vectors = np.linalg.eigh(normal)
    told = values > RANK_RATIO * max(float(values[-1]), 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        sd = np.where(told, 1.0 / np.sqrt(values), np.inf)[::-1]
    worst = vectors[:, 0]
    limit = settings.max_sigma_fraction * centred.radius_mm
    reason = None
    if not sd[-1] <= limit:
        reason = _describe_unobservable(worst, float(sd[-1]), limit, centred, used)
    return Observability(sd, worst, reason)


def _describe_unobservable(
    worst: Array, sd_mm: float, limit_mm: float, centred: CentredMarkers, used: NDArray[np.bool_]
) -> str:
    """Return in words which motion is undetermined."""
    turn, shift = worst[:3], worst[3:]
    share = float(turn @ turn)
    parts = []
    if share > 0.1:
        parts.append(f"a turn about {_direction(turn)}")
    if share < 0.9:
        parts.append(f"a shift along {_direction(shift)}")
    size = "at all" if np.isinf(sd_mm) else f"better than {sd_mm:.3g} mm"
    if share > 0.5 and np.isfinite(sd_mm):
        size = f"better than {sd_mm / centred.radius_mm:.2g} rad"
    seen = "; ".join(
        f"marker {marker + 1} by {_listed('sensor', np.flatnonzero(row))}"
        for marker, row in enumerate(used)
        if row.any()
    )
    return (
        f"the readings do not tell {' with '.join(parts)} {size} ({limit_mm:.3g} mm at the "
        f"markers' radius of {centred.radius_mm:.3g} mm is the most): {seen}"
    )


def _direction(vector: Array) -> str:
    unit = vector / np.linalg.norm(vector)
    # The sign of a direction is arbitrary; the largest component is made positive.
    unit = unit * np.sign(unit[np.argmax(np.abs(unit))])
    return "(" + ", ".join(f"{value + 0.0:.2f}" for value in unit) + ")"


def _number(count: int, name: str) -> str:
    return f"{count or 'no'} {name}{'' if count == 1 else 's'}"


def _listed(name: str, indices: Sequence[int] | NDArray[np.intp]) -> str:
    """Return "markers 1, 2 and 4"; people count from 1."""
    names = [str(int(index) + 1) for index in indices]
    if len(names) == 1:
        return f"{name} {names[0]}"
    return f"{name}s {', '.join(names[:-1])} and {names[-1]}"
