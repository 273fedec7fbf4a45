"""Case map-holes: tables over volumes with holes, judged wherever they are valid."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, cKDTree

from compute.errors import TooFewPoints
from compute.mapping.build import build_table
from compute.mapping.measurements import MappingMeasurements
from compute.mapping.table import Corrections
from validation.map_holes.volumes import (
    CENTRE_MM,
    HALF_MM,
    LAYOUTS,
    SHAPES,
    Field,
    Layout,
    Shape,
    cameras,
    places,
    random_field,
    random_hole,
    read,
)
from validation.progress import report_progress
from validation.result_tables import Cell, ResultTable, TablesCase

Array = NDArray[np.float64]

SEED: Final = 1
TRIALS: Final = 28
SENSORS: Final = 2
"""The first has the feature in the middle of the hole, the second anywhere in it."""
COUNT: Final = (150, 400)
SIZE: Final = (0.4, 0.85)
SIGMA_PX: Final = (0.02, 0.05)
FEATURE_PX: Final = (0.1, 0.5)
WIDTH: Final = (0.25, 1.5)
"""Full width of a feature at half maximum, relative to the resolution that the table claims."""
WIDTH_CLASSES: Final = (0.25, 0.5, 0.75, 1.0, 1.5)
PROBES: Final = 5000
INNER: Final = 0.9
"""Share of the box's edges that excludes the cells of its surface."""
MAX_RATIO: Final = 3.0


@dataclass(frozen=True, eq=False)
class Trial:
    """One map, with and without features.

    Args:
        layout: of the measurements.
        shape: of the hole.
        resolution_mm: that the table claims, the coarser of the sensors' [mm].
        width: of each sensor's feature, relative to the resolution, shape (S,); 0 without one.
        error_sigma: error over stated sigma at probes, shape (N, S); NaN where not valid.
        feature_sigma: the feature's part of that error, shape (N, S); NaN where not valid.
        hidden_px: largest error inside the hole without regard to validity, shape (S,) [px].
        in_hole: probes in the hole, shape (N,).
        inner: probes not at the surface of the box, shape (N,).
    """

    layout: Layout
    shape: Shape
    resolution_mm: float
    width: Array
    error_sigma: Array
    feature_sigma: Array
    hidden_px: Array
    in_hole: NDArray[np.bool_]
    inner: NDArray[np.bool_]

    @property
    def largest_feature(self) -> Array:
        """The feature's largest error over stated sigma where the table is valid, shape (S,)."""
        return np.asarray(np.nanmax(np.abs(self.feature_sigma), axis=0, initial=0.0))


def run_trial(layout: Layout, shape: Shape, rng: np.random.Generator) -> Trial:
    """Map a volume with a hole and features in it, and the same without the features.

    Args:
        layout: of the measurements.
        shape: of the hole.
        rng: draws everything else.

    Raises:
        TooFewPoints: the measurements support no cell.
    """
    count = int(np.exp(rng.uniform(*np.log(COUNT))))
    sigma = float(rng.uniform(*SIGMA_PX))
    hole = random_hole(shape, float(rng.uniform(*SIZE)), rng)
    unit = places(layout, count, rng)
    unit = unit[~hole.contains(unit)]
    points = CENTRE_MM + HALF_MM * unit
    probes = rng.uniform(-1.0, 1.0, (PROBES, 3))
    inside = hole.contains(probes)
    noise = sigma * rng.standard_normal((len(points), SENSORS))
    smooth = [random_field(np.zeros(3), np.ones(3), 0.0, rng) for _ in range(SENSORS)]

    def build(given: Sequence[Field]) -> tuple[Corrections, Array, float]:
        readings = read(points)[:, :SENSORS] - _at(given, unit) + noise
        measured = MappingMeasurements(points, readings, np.full(readings.shape, sigma))
        result = build_table(cameras()[:SENSORS], "", measured)
        found = result.table.at(CENTRE_MM + HALF_MM * probes)
        resolution = max(one.resolution_mm or 0.0 for one in result.validation.sensors)
        return found, found.value_px - _at(given, probes), resolution

    # The resolution follows from the positions alone.
    found, plain, resolution = build(smooth)
    error, width = plain, np.zeros(SENSORS)
    if shape != "none":
        width = rng.uniform(*WIDTH, SENSORS)
        # What lies outside the measurements' hull is no hole.
        enclosed = inside & (Delaunay(unit).find_simplex(probes) >= 0)
        empty = np.asarray(cKDTree(points).query(CENTRE_MM + HALF_MM * probes)[0]) * enclosed
        centres = (int(np.argmax(empty)), int(rng.choice(np.flatnonzero(inside))))
        found, error, _ = build(
            [
                replace(
                    field,
                    centre=probes[centre],
                    width_mm=np.full(3, part * resolution),
                    feature_px=float(rng.uniform(*FEATURE_PX)),
                )
                for field, centre, part in zip(smooth, centres, width, strict=True)
            ]
        )
    stated = np.where(found.inside, np.sqrt(found.variance_px2), np.nan)
    return Trial(
        layout,
        shape,
        resolution,
        width,
        error / stated,
        (error - plain) / stated,
        np.abs(error[inside]).max(axis=0, initial=0.0),
        inside,
        np.abs(probes).max(axis=1) < INNER,
    )


def _at(fields: Sequence[Field], unit: Array) -> Array:
    return np.stack([one.at(unit) for one in fields], axis=1)


def compute_tables(
    trials: int = TRIALS, seed: int = SEED
) -> tuple[tuple[ResultTable, ...], tuple[str, ...]]:
    """Map ``trials`` volumes with a hole, and half as many without one."""
    holed, sound, refused = [], [], 0
    for number in range(trials):
        layout = LAYOUTS[number % len(LAYOUTS)]
        shape = SHAPES[(number + number // len(LAYOUTS)) % len(SHAPES)]
        report_progress(0.8 * number / trials, f"{shape}, {layout}")
        try:
            holed.append(run_trial(layout, shape, np.random.default_rng([seed, 0, number])))
        except TooFewPoints:
            refused += 1
    without = max(trials // 2, 1)
    for number in range(without):
        layout = LAYOUTS[number % len(LAYOUTS)]
        report_progress(0.8 + 0.2 * number / without, f"no hole, {layout}")
        sound.append(run_trial(layout, "none", np.random.default_rng([seed, 1, number])))
    tables = (
        _by_width(holed),
        _table("maps with a hole, by its shape", holed, lambda one: one.shape),
        _table("the same by layout of the measurements", holed, lambda one: one.layout),
        _table("no hole", sound, lambda one: one.layout),
    )
    return tables, _findings(holed, sound, refused)


def _by_width(trials: Sequence[Trial]) -> ResultTable:
    rows: list[tuple[Cell, ...]] = []
    for low, high in pairwise(WIDTH_CLASSES):
        largest = _features(trials, low, high)
        rows.append(
            (
                f"{low:g} to {high:g}",
                len(largest),
                int((largest > MAX_RATIO).sum()),
                _rounded(float(np.median(largest))) if len(largest) else None,
                _rounded(float(largest.max())) if len(largest) else None,
            )
        )
    return ResultTable(
        "features in holes, by their width relative to the resolution that the table claims: "
        "largest error over stated sigma where it is valid",
        ("width", "features", f"above {MAX_RATIO:g}", "median", "largest"),
        tuple(rows),
    )


def _features(trials: Sequence[Trial], low: float, high: float) -> Array:
    """Return the largest error over sigma of each feature with a width of ``low`` to ``high``."""
    found = [one.largest_feature[(one.width >= low) & (one.width < high)] for one in trials]
    return np.concatenate([np.empty(0), *found])


def _table(title: str, trials: Sequence[Trial], key: Callable[[Trial], str]) -> ResultTable:
    rows: list[tuple[Cell, ...]] = []
    for name in dict.fromkeys(key(one) for one in trials):
        own = [one for one in trials if key(one) == name]
        holed = [one for one in own if one.shape != "none"]
        in_hole = [np.isfinite(one.error_sigma[one.in_hole]).mean() for one in holed]
        rows.append(
            (
                name,
                len(own),
                _rounded(np.mean([np.isfinite(one.error_sigma).mean() for one in own])),
                _rounded(np.mean(in_hole)) if in_hole else None,
                _rounded(max(one.hidden_px.max() for one in own)) if in_hole else None,
                _rounded(_rms(own)),
                _rounded(100.0 * _share(own)),
                _rounded(_largest(own, inner=True)),
                _rounded(_largest(own)),
            )
        )
    headings = (
        "",
        "maps",
        "valid",
        "valid in hole",
        "worst error in hole, px",
        "RMS error / sigma",
        f"above {MAX_RATIO:g}, %",
        "largest inside",
        "largest",
    )
    return ResultTable(title, headings, tuple(rows))


def _largest(trials: Sequence[Trial], *, inner: bool = False) -> float:
    values = [np.abs(one.error_sigma[one.inner if inner else slice(None)]) for one in trials]
    return float(np.nanmax(np.concatenate(values), initial=0.0))


def _rms(trials: Sequence[Trial]) -> float:
    return float(np.sqrt(np.nanmean(np.concatenate([one.error_sigma**2 for one in trials]))))


def _share(trials: Sequence[Trial]) -> float:
    """Return the share of valid probes beyond MAX_RATIO."""
    ratio = np.concatenate([np.abs(one.error_sigma) for one in trials])
    return float((ratio[np.isfinite(ratio)] > MAX_RATIO).mean())


def _findings(holed: Sequence[Trial], sound: Sequence[Trial], refused: int) -> tuple[str, ...]:
    wide, narrow = _features(holed, 1.0, np.inf), _features(holed, 0.0, 1.0)
    return (
        (
            f"Features as wide as the resolution that the table claims, or wider: {len(wide)}; "
            f"{int((wide > MAX_RATIO).sum())} are more than {MAX_RATIO:g} stated standard "
            f"deviations off at a valid place. Narrower: {int((narrow > MAX_RATIO).sum())} of "
            f"{len(narrow)}; the table says that it may miss these. {refused} maps were refused: "
            "their measurements support no cell."
        ),
        (
            "Fields of waves longer than the box and 0.2 to 0.8 px high, with a feature of "
            f"{FEATURE_PX[0]:g} to {FEATURE_PX[1]:g} px in the hole whose full width at half "
            f"maximum is {WIDTH[0]:g} to {WIDTH[1]:g} of the resolution; "
            f"{COUNT[0]} to {COUNT[1]} measurements before the hole, noise of {SIGMA_PX[0]:g} to "
            f"{SIGMA_PX[1]:g} px. Largest errors inside leave out the outermost "
            f"{100.0 * (1.0 - INNER):.0f} % of the box."
        ),
        (
            "Errors of one map are alike over distances of the spacing, so that each map has tens "
            "of independent ones: the largest of these is above 3 standard deviations by chance in "
            "maps without a hole, too. What a feature adds is told apart by a second map with the "
            "same noise and without the feature. Maps without holes: RMS error over sigma "
            f"{_rms(sound):.2f}; above {MAX_RATIO:g} are {100.0 * _share(sound):.2f} % of the "
            "valid volume."
        ),
    )


def _rounded(value: float) -> float:
    return float(f"{value:.3g}")


CASE: Final = TablesCase(
    "map-holes",
    "correction tables over volumes with holes: errors over stated sigma wherever they are valid",
    "end of section 5.6",
    compute_tables,
)
