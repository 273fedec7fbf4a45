"""Case map-holes: tables over volumes with holes, judged wherever they are valid."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, cKDTree

from compute.mapping.build import build_table
from compute.mapping.measurements import MappingMeasurements
from compute.mapping.table import Corrections
from validation.map_holes.volumes import (
    CENTRE_MM,
    HALF_MM,
    LAYOUTS,
    SHAPES,
    Field,
    Hole,
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
WIDTH: Final = (0.4, 1.0)
"""Full width of a feature at half maximum, relative to the hole's largest empty ball."""
PROBES: Final = 5000
INNER: Final = 0.9
"""Share of the box's edges that excludes the cells of its surface."""
MAX_RATIO: Final = 3.0


@dataclass(frozen=True, eq=False)
class Trial:
    """One map, with and without its feature.

    Args:
        layout: of the measurements.
        shape: of the hole.
        hole_mm: diameter of the largest empty ball in it, centred within the measurements' hull
            [mm]; 0 without a hole.
        resolution_mm: that the table claims, the coarser of the sensors' [mm].
        error_sigma: error over stated sigma at probes, shape (N, S); NaN where not valid.
        feature_sigma: the feature's part of that error, shape (N, S); NaN where not valid.
        hidden_px: largest error inside the hole without regard to validity, shape (S,) [px].
        in_hole: probes in the hole, shape (N,).
        inner: probes not at the surface of the box, shape (N,).
    """

    layout: Layout
    shape: Shape
    hole_mm: float
    resolution_mm: float
    error_sigma: Array
    feature_sigma: Array
    hidden_px: Array
    in_hole: NDArray[np.bool_]
    inner: NDArray[np.bool_]

    @property
    def resolved(self) -> bool:
        """Whether the hole is wider than the resolution that the table claims."""
        return self.hole_mm > self.resolution_mm


def run_trial(layout: Layout, shape: Shape, rng: np.random.Generator) -> Trial:
    """Map a volume with a hole and a feature in it, and the same without the feature.

    Args:
        layout: of the measurements.
        shape: of the hole.
        rng: draws everything else.
    """
    count = int(np.exp(rng.uniform(*np.log(COUNT))))
    sigma = float(rng.uniform(*SIGMA_PX))
    hole = random_hole(shape, float(rng.uniform(*SIZE)), rng)
    unit = places(layout, count, rng)
    unit = unit[~hole.contains(unit)]
    points = CENTRE_MM + HALF_MM * unit
    probes = rng.uniform(-1.0, 1.0, (PROBES, 3))
    inside = hole.contains(probes)
    # What lies outside the measurements' hull is no hole.
    enclosed = inside & (Delaunay(unit).find_simplex(probes) >= 0)
    distance = np.asarray(cKDTree(points).query(CENTRE_MM + HALF_MM * probes)[0]) * enclosed
    hole_mm = 2.0 * float(distance.max())
    fields = [_field(k, hole, probes, distance, rng) for k in range(SENSORS)]
    noise = sigma * rng.standard_normal((len(points), SENSORS))

    def build(given: Sequence[Field]) -> tuple[Corrections, Array, float]:
        readings = read(points)[:, :SENSORS] - _at(given, unit) + noise
        measured = MappingMeasurements(points, readings, np.full(readings.shape, sigma))
        result = build_table(cameras()[:SENSORS], "", measured)
        found = result.table.at(CENTRE_MM + HALF_MM * probes)
        resolution = max(one.resolution_mm or 0.0 for one in result.validation.sensors)
        return found, found.value_px - _at(given, probes), resolution

    found, error, resolution = build(fields)
    plain = error
    if shape != "none":
        plain = build([one.without_feature() for one in fields])[1]
    stated = np.where(found.inside, np.sqrt(found.variance_px2), np.nan)
    return Trial(
        layout,
        shape,
        hole_mm,
        resolution,
        error / stated,
        (error - plain) / stated,
        np.abs(error[inside]).max(axis=0, initial=0.0),
        inside,
        np.abs(probes).max(axis=1) < INNER,
    )


def _field(
    sensor: int, hole: Hole, probes: Array, distance: Array, rng: np.random.Generator
) -> Field:
    """Draw one sensor's field with its feature in the hole."""
    centre, width = np.zeros(3), 1.0
    if hole.shape != "none":
        inside = np.flatnonzero(hole.contains(probes))
        chosen = int(np.argmax(distance)) if sensor == 0 else int(rng.choice(inside))
        centre = probes[chosen]
        width = 2.0 * float(distance.max()) * float(rng.uniform(*WIDTH))
    height = float(rng.uniform(*FEATURE_PX)) if hole.shape != "none" else 0.0
    return random_field(centre, np.full(3, width), height, rng)


def _at(fields: Sequence[Field], unit: Array) -> Array:
    return np.stack([one.at(unit) for one in fields], axis=1)


def compute_tables(
    trials: int = TRIALS, seed: int = SEED
) -> tuple[tuple[ResultTable, ...], tuple[str, ...]]:
    """Map ``trials`` volumes with a hole, and half as many without one."""
    holed, sound = [], []
    for number in range(trials):
        layout = LAYOUTS[number % len(LAYOUTS)]
        shape = SHAPES[(number + number // len(LAYOUTS)) % len(SHAPES)]
        report_progress(0.8 * number / trials, f"{shape}, {layout}")
        holed.append(run_trial(layout, shape, np.random.default_rng([seed, 0, number])))
    without = max(trials // 2, 1)
    for number in range(without):
        layout = LAYOUTS[number % len(LAYOUTS)]
        report_progress(0.8 + 0.2 * number / without, f"no hole, {layout}")
        sound.append(run_trial(layout, "none", np.random.default_rng([seed, 1, number])))
    wide = [one for one in holed if one.resolved]
    narrow = [one for one in holed if not one.resolved]
    tables = (
        _table("holes wider than the table's resolution, by shape", wide, lambda one: one.shape),
        _table("the same by layout of the measurements", wide, lambda one: one.layout),
        _table("holes narrower than the table's resolution", narrow, lambda one: one.shape),
        _table("no hole", sound, lambda one: one.layout),
    )
    return tables, _findings(wide, narrow, sound)


def _table(title: str, trials: Sequence[Trial], key: Callable[[Trial], str]) -> ResultTable:
    rows: list[tuple[Cell, ...]] = []
    for name in dict.fromkeys(key(one) for one in trials):
        own = [one for one in trials if key(one) == name]
        in_hole = [np.isfinite(one.error_sigma[one.in_hole]).mean() for one in own if one.hole_mm]
        rows.append(
            (
                name,
                len(own),
                _rounded(np.mean([np.isfinite(one.error_sigma).mean() for one in own])),
                _rounded(np.mean(in_hole)) if in_hole else None,
                _rounded(max(one.hidden_px.max() for one in own)) if in_hole else None,
                _rounded(_largest(own, "feature_sigma")) if in_hole else None,
                _rounded(_rms(own)),
                _rounded(100.0 * _share(own)),
                _rounded(_largest(own, "error_sigma", inner=True)),
                _rounded(_largest(own, "error_sigma")),
            )
        )
    headings = (
        "",
        "maps",
        "valid",
        "valid in hole",
        "worst error in hole, px",
        "feature / sigma",
        "RMS error / sigma",
        f"above {MAX_RATIO:g}, %",
        "largest inside",
        "largest",
    )
    return ResultTable(title, headings, tuple(rows))


def _largest(trials: Sequence[Trial], name: str, *, inner: bool = False) -> float:
    values = [np.abs(getattr(one, name)[one.inner if inner else slice(None)]) for one in trials]
    return float(np.nanmax(np.concatenate(values), initial=0.0))


def _rms(trials: Sequence[Trial]) -> float:
    return float(np.sqrt(np.nanmean(np.concatenate([one.error_sigma**2 for one in trials]))))


def _share(trials: Sequence[Trial]) -> float:
    """Return the share of valid probes beyond MAX_RATIO."""
    ratio = np.concatenate([np.abs(one.error_sigma) for one in trials])
    return float((ratio[np.isfinite(ratio)] > MAX_RATIO).mean())


def _findings(
    wide: Sequence[Trial], narrow: Sequence[Trial], sound: Sequence[Trial]
) -> tuple[str, ...]:
    setting = (
        "Fields of waves longer than the box and 0.2 to 0.8 px high, with a feature of "
        f"{FEATURE_PX[0]:g} to {FEATURE_PX[1]:g} px in the hole whose full width at half maximum "
        f"is {WIDTH[0]:g} to {WIDTH[1]:g} of the hole's largest empty ball; "
        f"{COUNT[0]} to {COUNT[1]} measurements before the hole, noise of {SIGMA_PX[0]:g} to "
        f"{SIGMA_PX[1]:g} px. Largest errors inside leave out the outermost "
        f"{100.0 * (1.0 - INNER):.0f} % of the box."
    )
    by_chance = (
        "Errors of one map are alike over distances of the spacing, so that each map has tens of "
        "independent ones: the largest of these is above 3 standard deviations by chance in maps "
        "without a hole, too. What a feature adds is told apart by a second map with the same "
        "noise and without the feature."
    )
    findings = [setting, by_chance]
    if wide:
        beyond = sum(_largest([one], "feature_sigma") > MAX_RATIO for one in wide)
        findings.append(
            f"Holes wider than the table's resolution: {len(wide)}; a feature in them is more "
            f"than {MAX_RATIO:g} stated standard deviations at a valid place in {beyond}. RMS "
            f"error over sigma {_rms(wide):.2f}, without holes {_rms(sound):.2f}; above "
            f"{MAX_RATIO:g} are {100.0 * _share(wide):.2f} % and {100.0 * _share(sound):.2f} % of "
            "the valid volume."
        )
    if narrow:
        findings.append(
            f"Holes narrower than the resolution: {len(narrow)}; the table assumes that there are "
            "no features so narrow, and does not see these."
        )
    return tuple(findings)


def _rounded(value: float) -> float:
    return float(f"{value:.3g}")


CASE: Final = TablesCase(
    "map-holes",
    "correction tables over volumes with holes: errors over stated sigma wherever they are valid",
    "end of section 5.6",
    compute_tables,
)
