"""Case map-outside: normalised errors of points inside and outside a table's measurements."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import TooFewPoints
from compute.mapping.build import build_table
from compute.mapping.measurements import MappingMeasurements
from compute.reconstruction.point_batch import PointBatch, PointFlag
from compute.reconstruction.triangulation import reconstruct
from validation.map_outside.rigs import (
    KINDS,
    REGIONS,
    Kind,
    Region,
    Scene,
    normalised_errors,
    random_scene,
)
from validation.progress import report_progress
from validation.result_tables import Cell, ResultTable, TablesCase

Array = NDArray[np.float64]

SEED: Final = 1
TRIALS: Final = 30
DISTANCES_MM: Final = (0.0, 15.0, 30.0, 60.0, 100.0, 150.0, 250.0)
MIN_POINTS: Final = 10
"""Fewest points of a rig that count as a class."""
MAX_NEES: Final = 5.0
FAR_MM: Final = 150.0
"""The corners of a valid cell, whose centre lies in the hull, are nearer."""


@dataclass(frozen=True, eq=False)
class PointClass:
    """Points of one rig in one class.

    Args:
        count: how many there are.
        nees: mean of their normalised squared errors; 3 is right.
        error_mm: RMS error [mm].
        stated_mm: RMS of the stated standard deviations in space [mm].
    """

    count: int
    nees: float
    error_mm: float
    stated_mm: float


@dataclass(frozen=True, eq=False)
class Trial:
    """One rig.

    Args:
        kind: of its field.
        region: of its measurements.
        classes: by name, those with MIN_POINTS points.
        beyond: points beyond the table.
        stated_beyond: those of them with a covariance.
        lost: share of the points up to 100 mm outside that have no position.
        misplaced: points more than FAR_MM outside that the table supports, of all these.
    """

    kind: Kind
    region: Region
    classes: dict[str, PointClass]
    beyond: PointClass
    stated_beyond: int
    lost: float
    misplaced: tuple[int, int]


def class_names() -> tuple[str, ...]:
    """Return the names of the classes in order."""
    outside = [f"{low:g} to {high:g} mm outside" for low, high in pairwise(DISTANCES_MM)]
    return ("inside, valid", "inside, not valid", "outside, valid", *outside)


def run_trial(scene: Scene) -> Trial:
    """Build the table of a scene and judge the points that are reconstructed with it.

    Raises:
        TooFewPoints: the measurements support no cell.
    """
    models = scene.rig.models
    sigma = np.full(scene.readings_px.shape, scene.sigma_px)
    measured = MappingMeasurements(scene.points_mm, scene.readings_px, sigma)
    table = build_table(models, "", measured).table
    sigma = np.full(scene.probe_readings_px.shape, scene.sigma_px)
    found = reconstruct(models, scene.probe_readings_px, sigma, corrections=table)
    published = found.published()
    error = found.position_mm - scene.probes_mm
    stated = np.isfinite(published.covariance_mm2[:, 0, 0])
    valid = stated & ((found.flags & int(PointFlag.OUTSIDE_MAP)) == 0)
    distance, outside = scene.distance_mm, scene.distance_mm >= 0.0
    masks = [valid & ~outside, stated & ~valid & ~outside, valid & outside]
    for low, high in pairwise(DISTANCES_MM):
        masks.append(stated & ~valid & (distance >= low) & (distance < high))
    classes = {
        name: _summarise(found, error, mask)
        for name, mask in zip(class_names(), masks, strict=True)
        if np.count_nonzero(mask) >= MIN_POINTS
    }
    beyond = (found.flags & int(PointFlag.NO_COVARIANCE)) != 0
    near, far = outside & (distance < 100.0), distance > FAR_MM
    return Trial(
        scene.kind,
        scene.region,
        classes,
        _summarise(found, error, beyond),
        int((beyond & stated).sum()),
        float(np.isnan(error[near, 0]).mean()),
        (int((valid & far).sum()), int(far.sum())),
    )


def _summarise(found: PointBatch, error_mm: Array, mask: NDArray[np.bool_]) -> PointClass:
    if not mask.any():
        return PointClass(0, np.nan, np.nan, np.nan)
    error, covariance = error_mm[mask], found.covariance_mm2[mask]
    return PointClass(
        len(error),
        float(normalised_errors(error, covariance).mean()),
        float(np.sqrt((error**2).sum(axis=1).mean())),
        float(np.sqrt(np.einsum("nii->n", covariance).mean())),
    )


def run_trials(trials: int, seed: int) -> tuple[list[Trial], int]:
    """Judge ``trials`` rigs; returns them, and how many were refused."""
    found, refused = [], 0
    for number in range(trials):
        kind = KINDS[number % len(KINDS)]
        region = REGIONS[number // len(KINDS) % len(REGIONS)]
        report_progress(number / trials, f"{kind}, {region}")
        scene = random_scene(kind, region, np.random.default_rng([seed, number]))
        try:
            found.append(run_trial(scene))
        except TooFewPoints:
            refused += 1
    return found, refused


def compute_tables(
    trials: int = TRIALS, seed: int = SEED
) -> tuple[tuple[ResultTable, ...], tuple[str, ...]]:
    """Judge ``trials`` rigs by the distance of points from the measurements, and by the field."""
    found, refused = run_trials(trials, seed)
    headings = (
        "points",
        "rigs",
        "NEES, median of rigs",
        "95 % below",
        f"rigs below {MAX_NEES:g}, %",
        "error, mm",
        "stated, mm",
    )
    tables = (
        ResultTable(
            "normalised squared errors, 3 is right, by the distance from the measurements' hull",
            headings,
            tuple(_row(name, found, (name,)) for name in class_names()),
        ),
        ResultTable(
            "outside and not valid, up to 100 mm, by the field",
            headings,
            tuple(
                _row(kind, [one for one in found if one.kind == kind], class_names()[3:7])
                for kind in KINDS
            ),
        ),
        ResultTable(
            "the same by the measured region",
            headings,
            tuple(
                _row(region, [one for one in found if one.region == region], class_names()[3:7])
                for region in REGIONS
            ),
        ),
    )
    return tables, _findings(found, refused)


def _row(label: str, trials: Sequence[Trial], names: Sequence[str]) -> tuple[Cell, ...]:
    """Return the figures of rigs, whose classes of these names are taken together."""
    chosen = [[one.classes[name] for name in names if name in one.classes] for one in trials]
    chosen = [classes for classes in chosen if classes]
    if not chosen:
        return (label, 0, None, None, None, None, None)

    def together(classes: Sequence[PointClass], name: str, power: int) -> float:
        weights = [one.count for one in classes]
        values = [getattr(one, name) ** power for one in classes]
        return float(np.average(values, weights=weights) ** (1.0 / power))

    nees = np.array([together(classes, "nees", 1) for classes in chosen])
    return (
        label,
        len(nees),
        _rounded(float(np.median(nees))),
        _rounded(float(np.quantile(nees, 0.95))),
        _rounded(100.0 * float((nees < MAX_NEES).mean())),
        _rounded(float(np.median([together(one, "error_mm", 2) for one in chosen]))),
        _rounded(float(np.median([together(one, "stated_mm", 2) for one in chosen]))),
    )


def _findings(trials: Sequence[Trial], refused: int) -> tuple[str, ...]:
    beyond = [one.beyond.nees for one in trials if one.beyond.count >= MIN_POINTS]
    growth = _rounded(float(np.median(beyond))) if beyond else "not known"
    far = np.array([one.misplaced for one in trials]).reshape(-1, 2).sum(axis=0)
    return (
        (
            f"{len(trials)} rigs of four to six sensors, {refused} refused; a table from 120 to "
            "300 measurements with noise of 0.02 to 0.2 px. Of a rig the mean over a class counts; "
            "errors and stated deviations are in space, medians of the rigs' RMS."
        ),
        (
            f"Beyond the table: {sum(one.beyond.count for one in trials)} points, of which "
            f"{sum(one.stated_beyond for one in trials)} have a covariance. By the one "
            f"that gates and weights take, their normalised squared error is {growth} (median)."
        ),
        (
            f"{100.0 * max(one.lost for one in trials):.2g} % of the points up to 100 mm outside "
            f"have no position in the worst rig. {far[0]} of {far[1]} points more than "
            f"{FAR_MM:g} mm outside are found at a place that the table supports."
        ),
    )


def _rounded(value: float) -> float:
    return float(f"{value:.3g}")


CASE: Final = TablesCase(
    "map-outside",
    "correction tables beyond their measurements: errors over stated covariances by distance",
    "end of section 5.6",
    compute_tables,
)
