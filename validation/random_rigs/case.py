"""Case random-rigs: share of rigs that calibrate, and honesty of the covariance."""

from collections import Counter
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from compute.calibration.calibrate import calibrate
from compute.calibration.settings import CalibrationSettings
from compute.camera.model import SensorGeometry
from compute.errors import LumilineError
from compute.measurement.measurement_model import MeasurementModel
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
QUANTILES: Final = 400
"""Quantiles of each rig's expected distribution."""
MAX_NEES: Final = 5.0
MEDIAN_RANGE: Final = (2.7, 3.5)


@dataclass(frozen=True)
class Outcome:
    """One rig.

    Args:
        fewest_readings: of any sensor.
        distorted: whether its lenses distort.
        nees: mean normalised error squared of points that calibration never saw; None: refused.
        dof: degrees of freedom of that mean were the covariance exact: 3 chi2(dof) / dof; None:
            refused.
        refusal: the error's kind and text; empty where it was calibrated.
    """

    fewest_readings: int
    distorted: bool
    nees: float | None
    dof: float | None
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
    settings = CalibrationSettings("auto", trial.position_sigma_mm or None)
    try:
        found = calibrate(trial.control_mm, trial.readings_px, sensors, sigma, settings)
    except LumilineError as error:
        text = f"{type(error).__name__}: {error.detail}"
        return Outcome(trial.fewest_readings, trial.distorted, None, None, text)
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
    dof = mean_nees_dof(
        MeasurementModel.of(found.models, covariance),
        ours.position_mm[rows],
        np.isfinite(readings[rows]),
        noise,
    )
    return Outcome(trial.fewest_readings, trial.distorted, float(squares.mean()), dof, "")


def mean_nees_dof(
    model: MeasurementModel, points_mm: Array, used: NDArray[np.bool_], sigma_px: Array
) -> float:
    """Return the degrees of freedom of the mean of the points' normalised errors squared.

    The points share the calibration's error, so that their mean scatters though its covariance is
    exact. It is a quadratic form of normal errors with mean 3; a scaled chi-square with the same
    variance V has 18 / V degrees of freedom (Satterthwaite, doi:10.2307/3002019).

    Args:
        model: the cameras with their covariance.
        points_mm: shape (N, 3).
        used: which sensors read them, shape (N, S).
        sigma_px: standard deviations of the readings, shape (S,) [px].
    """
    count = len(points_mm)
    whitening = model.whitening(points_mm, np.tile(sigma_px**2, (count, 1)), used)
    jacobian = np.where(used[..., None], model.linearise(points_mm)[1], 0.0)
    common = np.where(used[..., None], model.common_jacobian(points_mm), 0.0)
    # Whitened errors of a point by those of its readings.
    errors = np.linalg.qr(whitening @ jacobian)[0].transpose(0, 2, 1) @ whitening
    by_calibration, by_noise = errors @ common, errors * sigma_px
    noise = by_noise @ by_noise.transpose(0, 2, 1)
    shared = np.einsum("nki,nkj->ij", by_calibration, by_calibration) / count
    mixed = float(np.einsum("nki,nkl,nli->", by_calibration, noise, by_calibration))
    own = float((noise**2).sum())
    return float(18.0 / (2.0 * (shared**2).sum() + (4.0 * mixed + 2.0 * own) / count**2))


def expected_quantile(dofs: Array, probability: float) -> float:
    """Return the quantile of mean NEES over rigs whose covariances are exact.

    Args:
        dofs: of the rigs' means, shape (R,).
        probability: between 0 and 1.
    """
    levels = (np.arange(QUANTILES) + 0.5) / QUANTILES
    each = 3.0 * chi2.ppf(levels[:, None], dofs) / dofs
    return float(np.quantile(each, probability))


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
    return summarise(run_trials(trials, seed))


def summarise(outcomes: list[Outcome]) -> tuple[tuple[ResultTable, ...], tuple[str, ...]]:
    """Summarise rigs by the fewest readings of a sensor."""
    rows: list[tuple[Cell, ...]] = []
    honest = True
    for name, low, high in CLASSES:
        of_class = [one for one in outcomes if low <= one.fewest_readings < high]
        nees = np.array([one.nees for one in of_class if one.nees is not None])
        if len(nees) == 0:
            rows.append((name, len(of_class), 0, *[None] * 6))
            continue
        median, below = float(np.median(nees)), 100.0 * float((nees < MAX_NEES).mean())
        honest &= MEDIAN_RANGE[0] <= median <= MEDIAN_RANGE[1] and below >= 95.0
        tail, largest = float(np.quantile(nees, 0.95)), float(nees.max())
        exact = expected_quantile(np.array([o.dof for o in of_class if o.dof is not None]), 0.95)
        mean = float(nees.mean())
        rows.append((name, len(of_class), len(nees), mean, median, tail, exact, largest, below))
    table = ResultTable(
        "Mean normalised error squared of held-out points, by the fewest readings of a sensor",
        (
            "readings",
            "rigs",
            "calibrated",
            "mean",
            "median",
            "95 %",
            "95 %, exact covariance",
            "largest",
            "below 5, %",
        ),
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
            'points share one calibration: "95 %, exact covariance" is how far they would reach '
            "if every covariance were exact."
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
