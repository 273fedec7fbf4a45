"""Case random-rigs: share of rigs that calibrate, and honesty of the covariance."""

from collections import Counter
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.calibrate import calibrate
from compute.calibration.settings import CalibrationSettings
from compute.camera.model import SensorGeometry
from compute.errors import LumilineError
from compute.reconstruction.triangulation import reconstruct
from validation.progress import report_progress
from validation.random_rigs.rigs import Trial, random_trial
from validation.result_tables import Cell, ResultTable, TablesCase

Array = NDArray[np.float64]

SEED: Final = 1
TRIALS: Final = 100
CLASSES: Final = (
    ("below 12", 0, 12),
    ("12 to 19", 12, 20),
    ("20 to 59", 20, 60),
    ("60 and more", 60, 10**6),
)
HELD_OUT: Final = 300
HELD_OUT_SHARE: Final = 0.8
WELL_DETERMINED: Final = 8
"""Fewest readings of each sensor from which seven parameters have redundancy."""
MAX_NEES: Final = 5.0
MEDIAN_RANGE: Final = (2.7, 3.5)


@dataclass(frozen=True)
class Outcome:
    """One rig.

    Args:
        fewest_readings: of any sensor.
        distorted: whether its lenses distort.
        nees: mean normalised error squared of points that calibration never saw; None: refused.
        refusal: the error's kind and text; empty where it was calibrated.
    """

    fewest_readings: int
    distorted: bool
    nees: float | None
    refusal: str


def run_trial(trial: Trial, rng: np.random.Generator) -> Outcome:
    """Calibrate a rig with distortion "auto" and reconstruct points that it never saw.

    Args:
        trial: the rig and its control points.
        rng: draws the other points and their noise.
    """
    rig = trial.rig
    sensors = [SensorGeometry(f"s{k + 1}", rig.pixels) for k in range(rig.sensors)]
    sigma = np.full(trial.readings_px.shape, trial.noise_px) if trial.noise_given else None
    settings = CalibrationSettings("auto", trial.control_sigma_mm or None)
    try:
        found = calibrate(trial.control_mm, trial.readings_px, sensors, sigma, settings)
    except LumilineError as error:
        text = f"{type(error).__name__}: {error.detail}"
        return Outcome(trial.fewest_readings, trial.distorted, None, text)
    points = rig.points(rng, HELD_OUT, HELD_OUT_SHARE)
    readings = rig.read(points)
    readings = readings + rng.normal(0.0, trial.noise_px, readings.shape)
    covariance = np.array(found.covariance)
    noise = np.full(rig.sensors, trial.noise_px)
    ours = reconstruct(found.models, readings, noise, covariance)
    errors = ours.position_mm - points
    rows = np.isfinite(errors).all(axis=1)
    inverse = np.linalg.inv(ours.covariance_mm2[rows])
    squares = np.einsum("ni,nij,nj->n", errors[rows], inverse, errors[rows])
    return Outcome(trial.fewest_readings, trial.distorted, float(squares.mean()), "")


def run_trials(trials: int, seed: int) -> list[Outcome]:
    """Calibrate random rigs.

    Args:
        trials: number of rigs.
        seed: of the first; each rig has a generator of its own.
    """
    outcomes = []
    for number in range(trials):
        report_progress(number / trials, f"rig {number + 1} of {trials}")
        rng = np.random.default_rng([seed, number])
        outcomes.append(run_trial(random_trial(rng), rng))
    return outcomes


def compute_tables(
    trials: int = TRIALS, seed: int = SEED
) -> tuple[tuple[ResultTable, ...], tuple[str, ...]]:
    """Calibrate random rigs and summarise by the fewest readings of a sensor.

    Args:
        trials: number of rigs.
        seed: of their random numbers.
    """
    outcomes = run_trials(trials, seed)
    rows: list[tuple[Cell, ...]] = []
    honest = True
    for name, low, high in CLASSES:
        of_class = [one for one in outcomes if low <= one.fewest_readings < high]
        nees = np.array([one.nees for one in of_class if one.nees is not None])
        if len(nees) == 0:
            rows.append((name, len(of_class), 0, None, None, None, None))
            continue
        median, below = float(np.median(nees)), 100.0 * float((nees < MAX_NEES).mean())
        honest &= MEDIAN_RANGE[0] <= median <= MEDIAN_RANGE[1] and below >= 95.0
        tail, largest = float(np.quantile(nees, 0.95)), float(nees.max())
        rows.append((name, len(of_class), len(nees), median, tail, largest, below))
    table = ResultTable(
        "Mean normalised error squared of held-out points, by the fewest readings of a sensor",
        ("readings", "rigs", "calibrated", "median", "95 %", "largest", "below 5, %"),
        tuple(rows),
    )
    kinds = Counter(one.refusal.split(":")[0] for one in outcomes if one.refusal)
    examples = {one.refusal.split(":")[0]: one.refusal for one in outcomes if one.refusal}
    refused = ResultTable(
        "Refusals",
        ("kind", "rigs", "for example"),
        tuple((kind, count, examples[kind]) for kind, count in sorted(kinds.items())),
    )
    determined = [one for one in outcomes if one.fewest_readings >= WELL_DETERMINED]
    calibrated = sum(one.nees is not None for one in determined)
    findings = (
        (
            f"{calibrated} of {len(determined)} rigs of which each sensor has {WELL_DETERMINED} "
            "readings or more were calibrated; at least 99.9 % was the target."
        ),
        (
            f"In each class the median was to lie in {MEDIAN_RANGE[0]} to {MEDIAN_RANGE[1]}, and "
            f"95 % of the rigs below {MAX_NEES:g}: {'met' if honest else 'not met'}. An honest "
            "covariance gives 3 on the mean over many rigs; one rig's mean scatters, as all its "
            "points share one calibration."
        ),
        (
            "3 to 8 sensors of 8 to 50 degrees to either side, noise of 0.05 to 1 px, given or "
            "not, control points of 0 to 0.5 mm, 12 to 300 of them, 0 to 30 % of the readings "
            'missing, half of the rigs with true distortion; distortion "auto". Projection and '
            "noise are this case's own."
        ),
    )
    return (table, refused), findings


CASE: Final = TablesCase(
    "random-rigs",
    "calibration of random rigs: which are calibrated, and whether the covariance is honest",
    "ours; the thesis has one rig",
    compute_tables,
)
