"""Case reliability: detection, identification and exclusion of wrong readings beside the theory."""

from typing import Final

import numpy as np

from compute.pose.settings import PoseFitSettings
from compute.reconstruction.outlier_exclusion import min_sensors
from validation.progress import report_progress
from validation.reliability import point_errors, pose_errors
from validation.result_tables import Cell, ResultTable, TablesCase

SEED: Final = 18
TRIALS: Final = 4000
SENSORS: Final = (4, 5, 6, 8)
SIZES: Final = (0.0, 5.0, 7.0, 10.0, 20.0, 50.0, 500.0)
READINGS: Final = (7, 8, 9, 12, 16)
POSE_SIZES: Final = (0.0, 10.0, 30.0)
POSE_SHARE: Final = 20
"""For each so many points one pose of each kind."""


def compute_tables(
    trials: int = TRIALS, seed: int = SEED
) -> tuple[tuple[ResultTable, ...], tuple[str, ...]]:
    """Return the tables of points and poses, and what they show.

    Args:
        trials: points of each kind; poses are a twentieth.
        seed: of places, noise and errors.
    """
    rng = np.random.default_rng(seed)
    points, worst, wrong = _points(trials, rng)
    poses = max(trials // POSE_SHARE, 10)
    tools, misled = _poses(poses, rng)
    before, misled_before = _poses(
        poses, rng, PoseFitSettings(max_detectable_sigma=None, min_redundancy_after_exclusion=1)
    )
    mirrored, mirrored_ok = _mirrored(poses, rng)
    return (points, tools, before, mirrored), (
        (
            f"Points: measured shares differ from the theory's (non-central chi-square for the "
            f"detection, correlated normal residuals for the rest) by {100.0 * worst:.2g} per cent "
            f"of the points at most; a good reading was left out of {100.0 * wrong:.2g} per cent "
            "at most in any row."
        ),
        (
            f"Four sensors detect and never identify; identification takes {min_sensors(1)} for "
            f"one wrong reading and {min_sensors(2)} for two."
        ),
        (
            f"Poses that are OK and off by a normalised error squared above "
            f"{pose_errors.MAX_NEES:g}: at most {100.0 * misled:.2g} per cent in any row by "
            f"default, {100.0 * misled_before:.2g} without the limit on detectable errors and "
            "with one reading to spare after an exclusion."
        ),
        f"Mirrored tools: {mirrored_ok} poses of {poses * len(READINGS)} are OK.",
    )


def _percent(share: float) -> float:
    return float(f"{100.0 * share:.3g}")


def _number(value: float | None) -> Cell:
    return None if value is None or np.isnan(value) else float(f"{value:.4g}")


def _points(trials: int, rng: np.random.Generator) -> tuple[ResultTable, float, float]:
    """Return the table of points, the largest difference from theory, and of wrong exclusions."""
    rows: list[tuple[Cell, ...]] = []
    worst = wrong = 0.0
    for index, sensors in enumerate(SENSORS):
        for step, size in enumerate(SIZES):
            report_progress(
                (index + step / len(SIZES)) / len(SENSORS) * 0.3, f"points of {sensors} sensors"
            )
            one = point_errors.run(sensors, size, trials, rng)
            worst = max(
                worst,
                abs(one.detected - one.detected_theory),
                abs(one.identified - one.identified_theory),
            )
            wrong = max(wrong, one.wrongly_excluded)
            rows.append(
                (
                    sensors,
                    size,
                    _percent(one.detected),
                    _percent(one.detected_theory),
                    _percent(one.identified),
                    _percent(one.identified_theory),
                    _percent(one.wrongly_excluded),
                    _percent(one.wrongly_excluded_theory),
                    _number(one.nees),
                    _number(one.before_mm),
                    _number(one.after_mm),
                )
            )
    table = ResultTable(
        f"one wrong reading of a point, {point_errors.SIGMA_PX:g} px of noise [% of points]",
        (
            "sensors",
            "error [sigma]",
            "detected",
            "theory",
            "identified",
            "theory ",
            "good one left out",
            "theory  ",
            "NEES unflagged",
            "largest error before [mm]",
            "unflagged after [mm]",
        ),
        tuple(rows),
    )
    return table, worst, wrong


def _poses(
    trials: int, rng: np.random.Generator, settings: PoseFitSettings | None = None
) -> tuple[ResultTable, float]:
    """Return the table of poses, and the largest share that is OK and wrong."""
    rows: list[tuple[Cell, ...]] = []
    misled = 0.0
    for readings in READINGS:
        for size in POSE_SIZES:
            begin = 0.3 if settings is None else 0.6
            report_progress(
                begin + 0.3 * READINGS.index(readings) / len(READINGS), f"{readings} readings"
            )
            one = pose_errors.run(readings, size, trials, rng, settings=settings)
            misled = max(misled, one.misled)
            rows.append(
                (
                    readings,
                    readings - 6,
                    size,
                    _percent(one.detected),
                    _percent(one.detected_theory),
                    _percent(one.excluded_right),
                    _percent(one.excluded_wrong),
                    *(_percent(share) for share in _shares(one, trials)),
                    _percent(one.misled),
                    _number(one.nees),
                )
            )
    what = "by default" if settings is None else "without the limit on detectable errors"
    return ResultTable(
        f"one wrong reading of a tool of four markers before four sensors, {what} [% of poses]",
        (
            "readings",
            "dof",
            "error [sigma]",
            "detected",
            "theory",
            "identified",
            "good one left out",
            "OK",
            "LOW_RELIABILITY",
            "INVALID",
            f"OK, NEES > {pose_errors.MAX_NEES:g}",
            "NEES of OK",
        ),
        tuple(rows),
    ), misled


def _shares(one: pose_errors.PoseOutcomes, trials: int) -> list[float]:
    return [one.statuses[name] / trials for name in ("OK", "LOW_RELIABILITY", "INVALID")]


def _mirrored(trials: int, rng: np.random.Generator) -> tuple[ResultTable, int]:
    """Return the table of mirrored tools, and how many poses are OK."""
    rows: list[tuple[Cell, ...]] = []
    total = 0
    for readings in READINGS:
        report_progress(0.9, f"mirrored, {readings} readings")
        one = pose_errors.run(readings, 0.0, trials, rng, mirrored=True)
        total += one.statuses["OK"]
        rows.append((readings, readings - 6, *(_percent(s) for s in _shares(one, trials))))
    table = ResultTable(
        "the true tool is the mirror image of the assumed one [% of poses]",
        ("readings", "dof", "OK", "LOW_RELIABILITY", "INVALID"),
        tuple(rows),
    )
    return table, total


CASE: Final = TablesCase(
    "reliability",
    "wrong readings of points and tools: detected, identified, left out, beside the theory",
    "ours; W. Baarda 1968, P. J. G. Teunissen 1990",
    compute_tables,
)
