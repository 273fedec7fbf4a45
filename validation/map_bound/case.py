"""Case map-bound: errors of a calibrated and mapped bar beside the bound by noise."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.settings import Distortion
from compute.camera.field_distortion import power_terms
from validation.map_bound.optotrak import optotrak_table
from validation.map_bound.point_errors import (
    ErrorParts,
    Fit,
    PointErrors,
    error_parts,
    fit,
    mapped,
    noise_bound,
    point_errors,
)
from validation.map_bound.scene import (
    HIGH_MM,
    LOW_MM,
    STOP_MM,
    Readings,
    Scene,
    bar_scene,
    random_points_in_box,
)
from validation.result_tables import Cell, ResultTable, TablesCase

Array = NDArray[np.float64]

SEED: Final = 1
CONTROL: Final = 300
TEST: Final = 2000
EXPOSURES: Final = 3
"""Of the control points, to tell the calibration's part of the errors from the model's."""
DETERMINED_MM: Final = 5.0
"""Points whose bound is larger lie where three sensors' planes all but meet in a line: they are
left out, and counted."""
MODELS: Final[tuple[tuple[str, Distortion], ...]] = (
    ("7 parameters", "none"),
    ("u^3 to u^7", power_terms(7, odd_only=False)),
    ("terms in u and v", "auto"),
)
MAX_RATIO: Final = 1.2
SQUARE_RANGE: Final = (2.7, 3.3)


@dataclass(frozen=True, eq=False)
class Row:
    """One camera with or without a map."""

    model: str
    with_map: bool
    fit: Fit
    errors: PointErrors
    parts: ErrorParts


@dataclass(frozen=True, eq=False)
class Comparison:
    """All cameras over the same points.

    Args:
        rows: cameras, each without and with a map.
        test: readings of the points that no fit saw.
        control: how many control points there were.
        undetermined: points that were left out for their bound, of so many drawn.
    """

    rows: tuple[Row, ...]
    test: Readings
    control: int
    undetermined: tuple[int, int]

    def row(self, model: str, *, with_map: bool) -> Row:
        """Return one of the rows."""
        return next(row for row in self.rows if (row.model, row.with_map) == (model, with_map))


def compare(
    scene: Scene,
    control: int,
    test: int,
    exposures: int,
    models: tuple[tuple[str, Distortion], ...],
    seed: int = SEED,
) -> Comparison:
    """Calibrate and map with ``control`` points, and reconstruct ``test`` others.

    Args:
        scene: the device.
        control: control points, seen by three sensors or more, spread evenly over the field.
        test: independent points, anywhere in it.
        exposures: of the control points, 2 or more.
        models: names of the cameras and their distortion; the last is the one whose slopes serve
            for the bound.
        seed: of the control points; the next two are of the other points and of the noise.
    """
    rng = np.random.default_rng(seed + 2)
    low, high = np.array(LOW_MM), np.array(HIGH_MM)
    known = _control(scene, control, rng, seed)
    anywhere = np.random.default_rng(seed + 1).uniform(low, high, (test * 5 // 4, 3))
    seen = _enough(scene.read(anywhere, rng))
    takes = [known, *(known.drawn(rng) for _ in range(exposures - 1))]

    fits: dict[tuple[str, bool], list[Fit]] = {}
    for name, distortion in models:
        plain = [fit(take, scene.geometry, distortion) for take in takes]
        fits[name, False] = plain
        fits[name, True] = [mapped(one, take) for one, take in zip(plain, takes, strict=True)]
    cameras = fits[models[-1][0], False][0].cameras
    bound = noise_bound(cameras, seen)
    well = np.sqrt(np.trace(bound, axis1=1, axis2=2)) <= DETERMINED_MM
    drawn = int(np.flatnonzero(well)[:test].max()) + 1
    chosen = np.flatnonzero(well)[:test]
    seen, bound = seen.of(chosen), bound[chosen]
    rows = tuple(
        Row(
            name,
            with_map,
            some[0],
            point_errors(some[0], seen, bound),
            error_parts(some, seen, cameras, bound),
        )
        for (name, with_map), some in fits.items()
    )
    return Comparison(rows, seen, control, (drawn - len(chosen), drawn))


def _control(scene: Scene, count: int, rng: np.random.Generator, seed: int) -> Readings:
    """Read control points until there are enough that three sensors see."""
    positions = random_points_in_box(2 * count, np.array(LOW_MM), np.array(HIGH_MM), seed)
    first = count * 5 // 4
    known = _enough(scene.read(positions[:first], rng))
    if len(known.points_mm) < count:
        known = known.and_(_enough(scene.read(positions[first:], rng)))
    return known.of(np.arange(count))


def _enough(readings: Readings) -> Readings:
    """Return the points that three sensors see or more."""
    return readings.of(readings.sensors >= 3)


def compute_tables(seed: int = SEED) -> tuple[tuple[ResultTable, ...], tuple[str, ...]]:
    """Return the tables of the bound and what they show.

    Args:
        seed: of the bar's points and noise.
    """
    found = compare(bar_scene(), CONTROL, TEST, EXPOSURES, MODELS, seed)
    optotrak, optotrak_finding = optotrak_table()
    tables = (_whole(found), _by_sensors(found), _figures_of_map(found), optotrak)
    return tables, (*_findings(found), optotrak_finding)


def _whole(found: Comparison) -> ResultTable:
    every = np.ones(len(found.test.points_mm), dtype=np.bool_)
    rows: list[tuple[Cell, ...]] = [
        (
            row.model,
            "yes" if row.with_map else "no",
            _rounded(row.errors.rms_mm(every)),
            _rounded(row.errors.rms_mm(every) / row.errors.bound_rms_mm(every)),
            _rounded(row.errors.mean_square(every)),
            *(_rounded(value) for value in vars(row.parts).values()),
            int(row.errors.found.sum()),
        )
        for row in found.rows
    ]
    return ResultTable(
        f"over the whole field, {found.control} control points, {len(every)} others [mm]",
        (
            "camera",
            "map",
            "3D RMS",
            "over bound",
            "error squared",
            "noise",
            "calibration",
            "model",
            "points",
        ),
        tuple(rows),
    )


def _by_sensors(found: Comparison) -> ResultTable:
    """Tell points apart by how many sensors see them, and by whether the map supports them."""
    rows: list[tuple[Cell, ...]] = []
    sensors = found.test.sensors
    for row in found.rows[-2:]:
        for label, which in (
            ("four sensors", sensors == 4),
            ("three sensors", sensors == 3),
            ("supported", row.errors.supported),
            ("not supported", ~row.errors.supported),
        ):
            if not (which & row.errors.found).any():
                continue
            rms, bound = row.errors.rms_mm(which), row.errors.bound_rms_mm(which)
            rows.append(
                (
                    row.model + (", map" if row.with_map else ""),
                    label,
                    int((which & row.errors.found).sum()),
                    _rounded(rms),
                    _rounded(bound),
                    _rounded(rms / bound),
                    _rounded(row.errors.mean_square(which)),
                )
            )
    return ResultTable(
        "by the sensors that see a point, and by the map [mm]",
        ("camera", "points that are", "points", "3D RMS", "bound", "over bound", "error squared"),
        tuple(rows),
    )


def _figures_of_map(found: Comparison) -> ResultTable:
    rows: list[tuple[Cell, ...]] = [
        (
            row.model,
            sensor.sensor,
            *(
                None if value is None else _rounded(value)
                for value in (
                    sensor.sigma_px,
                    sensor.before_rms_px,
                    sensor.after_rms_px,
                    sensor.left_out_rms_px,
                    sensor.normalised_squared_error,
                    sensor.effective_parameters,
                )
            ),
        )
        for row in found.rows
        if row.fit.mapping is not None
        for sensor in row.fit.mapping.validation.sensors
    ]
    return ResultTable(
        "the maps, by sensor [px]",
        ("camera", "sensor", "noise", "before", "after", "left out", "squared", "parameters"),
        tuple(rows),
    )


def _findings(found: Comparison) -> tuple[str, ...]:
    every = np.ones(len(found.test.points_mm), dtype=np.bool_)
    name = found.rows[-1].model
    best = found.row(name, with_map=True)
    ratio = best.errors.rms_mm(every) / best.errors.bound_rms_mm(every)
    low, high = SQUARE_RANGE
    distortion = best.fit.calibration.models[0].distortion
    terms = 0 if distortion is None else len(distortion.terms)
    left, drawn = found.undetermined
    noise = found.test.sigma_px / found.test.bound_px
    sigma = np.nanmedian(found.test.sigma_px)
    return (
        (
            f"Four sensors of Figure 5.2, the lens stopped to {STOP_MM:g} mm on its plane face, "
            "1300 x 1300 mm at 1500 to 1900 mm. Every line is traced, exposed with photon, dark, "
            "read and rounding noise, and read by its centre of gravity; the pixels are alike, as "
            f"after a flat-field correction. A reading's deviation is {sigma:.3g} px (median), "
            f"{np.nanmedian(noise):.2g} times the Cramer-Rao bound of its line: a centre of "
            "gravity weighs the pixels far out most, which have noise alone."
        ),
        (
            f"Calibrated and mapped with the same {found.control} points, {name} ({terms} chosen "
            f"for the first sensor): {ratio:.3f} times the bound (at most {MAX_RATIO} was "
            f"asked), normalised error squared {best.errors.mean_square(every):.2f} (from {low} "
            f"to {high})."
        ),
        (
            "Points that at least three sensors see, whole lines of them. Of "
            f"{drawn} such points {left} are left out, because their bound itself is above "
            f"{DETERMINED_MM:g} mm: sensor 1 measures across, and sensors 3 and 4 together "
            "measure the same from the same height, so that those three say nothing of the depth."
        ),
        (
            "Noise, calibration and model: what the point's own readings, the control points' "
            "noise, and the form of camera and map contribute, propagated linearly; the first two "
            "are there however good the model is."
        ),
    )


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")


CASE: Final = TablesCase(
    "map-bound",
    "calibrated and mapped over the whole field: errors beside the bound by the noise",
    "sections 3.4, 5.2 and 5.6, Figure 5.2; the Optotrak's published noise, Table 1.1",
    compute_tables,
)
