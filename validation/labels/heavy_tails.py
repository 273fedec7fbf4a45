"""Case label-tails: label errors and outliers where the noise has heavy tails.

Rigs, projection and noise are this module's own: nothing here is shared with what it judges.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from compute.calibration.mislabels.detector import LabelReport, find_label_errors
from compute.camera.model import SensorGeometry
from validation.progress import report_progress
from validation.result_tables import Cell, ResultTable, TablesCase

Array = NDArray[np.float64]
GivenSigma = Literal["core", "rms", "none"]
LabelError = Literal["none", "exchanged", "wrong-label"]

SEED: Final = 1908
TRIALS: Final = 100
"""Rigs of each kind."""
STUDENT_DOF: Final = 3.0
MIN_READINGS: Final = 12
"""Smallest number of readings of a sensor."""
LABEL_ERROR_SIGMA: Final = 10.0
"""Smallest distance of a label's own reading from the other, in sigma of the noise's core."""
OUTLIER_SIGMA: Final = 5.0
"""Error from which a reading is an outlier, in the same unit."""
FAR_SIGMA: Final = 10.0
"""Error of a reading that must be found, in standard deviations of the noise's core."""
BINS: Final = (0.0, 0.5, 0.9, 0.99, 1.0)
"""Bounds of the classes of stated probability."""


@dataclass(frozen=True, eq=False)
class Rig:
    """Readings of one rig, with what was done to them.

    Args:
        points_mm: control points, shape (N, 3).
        readings_px: shape (N, S); NaN where not seen.
        sensors: the sensors.
        core_px: standard deviation of the noise's core.
        error_px: error of each reading at its own point, shape (N, S).
        label_error: kind, sensor and points, counted from 1, as a finding has them; None: labels
            are right.
    """

    points_mm: Array
    readings_px: Array
    sensors: tuple[SensorGeometry, ...]
    core_px: float
    error_px: Array
    label_error: tuple[str, str, tuple[int, int]] | None = None


def random_rigs(
    rng: np.random.Generator, count: int, dof: float, label_error: LabelError
) -> Iterator[Rig]:
    """Yield rigs of 3 to 6 sensors that read 14 to 40 points, with Student's noise.

    Args:
        rng: draws everything.
        count: rigs wanted.
        dof: degrees of freedom of the noise; infinite: normal.
        label_error: error of one sensor.
    """
    made = 0
    while made < count:
        rig = _random_rig(rng, dof)
        if label_error != "none" and rig is not None:
            rig = _with_label_error(rng, rig, label_error)
        if rig is not None:
            made += 1
            yield rig


def _random_rig(rng: np.random.Generator, dof: float) -> Rig | None:
    sensors, half_angle = int(rng.integers(3, 7)), np.deg2rad(np.exp(rng.uniform(2.1, 3.7)))
    pixels = int(rng.choice([1024, 2048, 4096]))
    size = np.exp(rng.uniform(np.log(200.0), np.log(1500.0)))
    points = size * rng.uniform(-0.5, 0.5, (int(np.exp(rng.uniform(2.64, 3.69))), 3))
    exact = np.empty((len(points), sensors))
    for column in range(sensors):
        view = np.array([*rng.uniform(-0.6, 0.6, 2), 1.0])
        view /= np.linalg.norm(view)
        roll = np.pi * column / sensors + rng.normal(0.0, 0.1)
        side = np.cross([np.sin(roll), -np.cos(roll), 0.0], view)
        across = np.cross(view, side / np.linalg.norm(side))
        distance = size * (0.7 / np.tan(half_angle) + 0.5) * rng.uniform(0.95, 1.15)
        u = points @ across / (points @ view + distance)
        exact[:, column] = 0.5 * (pixels - 1) + 0.5 * pixels / np.tan(half_angle) * u
    core = float(np.exp(rng.uniform(np.log(0.05), 0.0)))
    drawn = rng.standard_normal(exact.shape)
    if np.isfinite(dof):
        drawn *= np.sqrt(dof / rng.chisquare(dof, exact.shape))
    readings = exact + core * drawn
    readings[rng.random(exact.shape) < rng.uniform(0.0, 0.3)] = np.nan
    readings[(readings < 0.0) | (readings > pixels - 1.0)] = np.nan
    if np.isfinite(readings).sum(axis=0).min() < MIN_READINGS:
        return None
    names = tuple(SensorGeometry(f"s{column + 1}", pixels) for column in range(sensors))
    return Rig(points, readings, names, core, core * drawn)


def _with_label_error(rng: np.random.Generator, rig: Rig, kind: LabelError) -> Rig | None:
    """Return the rig with exchanged readings, or one under the label of another; None: too near."""
    column = int(rng.integers(len(rig.sensors)))
    readings = rig.readings_px.copy()
    seen = np.flatnonzero(np.isfinite(readings[:, column]))
    label, own = rng.choice(seen, 2, replace=False).tolist()
    here, there = readings[[label, own], column]
    if abs(here - there) < LABEL_ERROR_SIGMA * rig.core_px:
        return None
    if kind == "exchanged":
        label, own = sorted((label, own))
    readings[[label, own], column] = readings[[own, label], column]
    if kind == "wrong-label":
        readings[own, column] = np.nan
    error = kind, rig.sensors[column].name, (label + 1, own + 1)
    return replace(rig, readings_px=readings, label_error=error)


@dataclass
class Outcome:
    """What was found in rigs of one kind.

    Args:
        rigs: number of rigs.
        exact: rigs with just the label errors that they have.
        false_labels: rigs in which a label error was found that is none.
        with_outliers: rigs with an outlier found.
        far: readings with an error of ``FAR_SIGMA`` or more, right labels.
        far_found: those named as outliers.
        stated: findings by class of stated probability: how many, sum of probabilities, true ones.
    """

    rigs: int = 0
    exact: int = 0
    false_labels: int = 0
    with_outliers: int = 0
    far: int = 0
    far_found: int = 0
    stated: Counter[tuple[str, int, str]] = field(default_factory=Counter)

    def add(self, rig: Rig, report: LabelReport) -> None:
        """Judge what was found in one rig by its true errors."""
        self.rigs += 1
        labels, outliers = set(), set()
        for finding in report.findings:
            if finding.kind == "outlier":
                at = (finding.points[0] - 1, int(str(finding.sensor)[1:]) - 1)
                outliers.add(at)
                true = self._is_outlier(rig, report, at)
            else:
                named = finding.kind, finding.sensor, finding.points
                labels.add(named)
                true = named == rig.label_error
            kind = "outlier" if finding.kind == "outlier" else "label"
            index = min(int(np.searchsorted(BINS, finding.probability)), len(BINS) - 1)
            self.stated[kind, index, "count"] += 1
            self.stated[kind, index, "true"] += int(true)
        expected = set() if rig.label_error is None else {rig.label_error}
        self.exact += labels == expected
        self.false_labels += bool(labels - expected)
        self.with_outliers += bool(outliers)
        sigma = np.array(report.sigma_px)
        far = (np.abs(rig.error_px) >= FAR_SIGMA * sigma) & np.isfinite(rig.readings_px)
        if rig.label_error is not None:
            far[:, [s.name for s in rig.sensors].index(rig.label_error[1])] = False
        self.far += int(far.sum())
        self.far_found += sum((int(i), int(j)) in outliers for i, j in np.argwhere(far))

    @staticmethod
    def _is_outlier(rig: Rig, report: LabelReport, at: tuple[int, int]) -> bool:
        point, column = at
        sensor = rig.sensors[column].name
        error = rig.label_error
        if error is not None and error[1] == sensor and point + 1 in error[2]:
            return True
        return bool(abs(rig.error_px[at]) >= OUTLIER_SIGMA * report.sigma_px[column])


def judge(seed: int, rigs: int, dof: float, given: GivenSigma, label_error: LabelError) -> Outcome:
    """Search random rigs for label errors and judge what is found.

    Args:
        seed: of the rigs.
        rigs: number of rigs.
        dof: degrees of freedom of Student's noise; infinite: normal.
        given: standard deviation that the search is given: the core's, the noise's or none.
        label_error: error of one sensor of each rig.
    """
    outcome = Outcome()
    for rig in random_rigs(np.random.default_rng(seed), rigs, dof, label_error):
        sigma = None
        if given != "none":
            factor = 1.0 if given == "core" or np.isinf(dof) else np.sqrt(dof / (dof - 2.0))
            sigma = np.full(rig.readings_px.shape, rig.core_px * factor)
        outcome.add(rig, find_label_errors(rig.points_mm, rig.readings_px, rig.sensors, sigma))
    return outcome


QUESTIONS: Final[tuple[tuple[float, GivenSigma, LabelError], ...]] = (
    (np.inf, "core", "none"),
    (np.inf, "none", "none"),
    (STUDENT_DOF, "core", "none"),
    (STUDENT_DOF, "rms", "none"),
    (STUDENT_DOF, "none", "none"),
    (np.inf, "core", "exchanged"),
    (STUDENT_DOF, "core", "exchanged"),
    (STUDENT_DOF, "core", "wrong-label"),
)
"""Degrees of freedom of the noise, the sigma that is given, and the label error."""


def compute_tables(
    seed: int = SEED, trials: int = TRIALS
) -> tuple[tuple[ResultTable, ...], tuple[str, ...]]:
    """Judge clean rigs and rigs with a label error, of normal and of Student's noise.

    Args:
        seed: of the rigs.
        trials: rigs of each kind.
    """
    rows: list[tuple[Cell, ...]] = []
    stated: Counter[tuple[str, int, str]] = Counter()
    clean = false = 0
    for k, (dof, given, error) in enumerate(QUESTIONS):
        noise = "normal" if np.isinf(dof) else f"Student's, {dof:g} dof"
        report_progress(k / len(QUESTIONS), f"{noise} noise, sigma given: {given}")
        found = judge(seed + k, trials, dof, given, error)
        rows.append(
            (
                noise, given, error, found.rigs, found.exact,
                found.false_labels, found.with_outliers, found.far, found.far_found,
            )
        )  # fmt: skip
        if np.isfinite(dof):
            stated += found.stated
            if error == "none":
                clean, false = clean + found.rigs, false + found.false_labels
    headings = (
        "noise", "sigma given", "label error", "rigs", "labels exact", "false label",
        "with outliers", "errors > 10 sigma", "of them outliers",
    )  # fmt: skip
    share = 100.0 * false / max(clean, 1)
    return (
        ResultTable("label errors and outliers in random rigs", headings, tuple(rows)),
        _stated_table(stated),
    ), (
        (
            f"Clean rigs with Student's noise of {STUDENT_DOF:g} dof in which a label is called "
            f"exchanged or wrong: {false} of {clean} ({share:.2g} %)."
        ),
        (
            "An outlier is true where its error is five standard deviations of the noise's core "
            "or more, as the search estimates the core, or where its label is wrong."
        ),
    )


def _stated_table(stated: Counter[tuple[str, int, str]]) -> ResultTable:
    rows: list[tuple[Cell, ...]] = []
    for kind in ("label", "outlier"):
        for index in range(1, len(BINS)):
            count = stated[kind, index, "count"]
            if count:
                true = stated[kind, index, "true"]
                bounds = f"{BINS[index - 1]:g} to {BINS[index]:g}"
                rows.append((kind, bounds, count, true, round(true / count, 3)))
    headings = ("finding", "stated probability", "findings", "true", "share true")
    return ResultTable("stated probabilities at Student's noise", headings, tuple(rows))


CASE: Final = TablesCase(
    "label-tails",
    "label errors and outliers where the noise has heavy tails",
    "section 5.5; Hill, doi:10.1214/aos/1176343247",
    compute_tables,
)
