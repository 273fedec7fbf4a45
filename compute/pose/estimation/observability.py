"""Observability: which motions of a tool its readings determine, and which they do not."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from compute.pose.rigid_body import CentredMarkers, are_collinear
from compute.pose.settings import POSE_PARAMETERS, PoseFitSettings

Array = NDArray[np.float64]

RANK_RATIO = 1e-12
"""Smallest ratio of eigenvalues of a normal matrix in mm; below it a direction is undetermined."""


def missing_readings(
    centred: CentredMarkers, used: NDArray[np.bool_], settings: PoseFitSettings
) -> str | None:
    """Return why the pattern of readings cannot determine a pose; None if it may.

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
            f"only {_listed('marker', markers)} were seen, which are on a line: the rotation "
            "is not determined"
        )
    return None


def unobservable_motion(
    normal: Array, centred: CentredMarkers, used: NDArray[np.bool_], settings: PoseFitSettings
) -> str | None:
    """Return in words which motion readings do not determine well enough; None: they do all.

    Args:
        normal: inverse covariance of (rotation times radius, shift of the centroid), shape (6, 6)
            [1/mm^2].
        centred: the tool's markers.
        used: readings that the pose was fitted to, shape (M, S).
        settings: largest standard deviation of a motion.
    """
    values, vectors = np.linalg.eigh(normal)
    sigma_mm = np.inf
    if values[0] > RANK_RATIO * max(float(values[-1]), 0.0):
        sigma_mm = float(1.0 / np.sqrt(values[0]))
    limit_mm = settings.max_sigma_fraction * centred.radius_mm
    if sigma_mm <= limit_mm:
        return None
    rotation, shift = vectors[:3, 0], vectors[3:, 0]
    share = float(rotation @ rotation)
    parts = []
    if share > 0.1:
        parts.append(f"a rotation about {_direction(rotation)}")
    if share < 0.9:
        parts.append(f"a shift along {_direction(shift)}")
    size = "at all" if np.isinf(sigma_mm) else f"better than {sigma_mm:.3g} mm"
    if share > 0.5 and np.isfinite(sigma_mm):
        size = f"better than {sigma_mm / centred.radius_mm:.2g} rad"
    readings = "; ".join(
        f"marker {marker + 1} by {_listed('sensor', np.flatnonzero(row))}"
        for marker, row in enumerate(used)
        if row.any()
    )
    return (
        f"the readings do not determine {' with '.join(parts)} {size} (at most {limit_mm:.3g} mm "
        f"at the markers' radius of {centred.radius_mm:.3g} mm is allowed): {readings}"
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
    *first, last = (str(int(index) + 1) for index in indices)
    return f"{name}s {', '.join(first)} and {last}" if first else f"{name} {last}"
