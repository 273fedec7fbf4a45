"""Case wand-from-readings: does a wand calibrate a device of which nothing is known?"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from compute.calibration.self_calibration.result import SelfCalibration
from compute.calibration.self_calibration.self_calibrate import self_calibrate
from compute.calibration.self_calibration.targets import Recording, Wand
from compute.camera.field_distortion import FieldDistortion, Term
from compute.camera.model import SensorGeometry, SensorModel, vector3
from compute.errors import LumilineError
from compute.reconstruction.triangulation import reconstruct
from validation.progress import report_progress
from validation.result_tables import Cell, ResultTable, TablesCase
from validation.wand_from_readings.scene import Bar, Directions, Wave, random_bar, random_wave

Array = NDArray[np.float64]

SEED: Final = 18
TRIALS: Final = 10
"""Rigs of each row."""
POSES: Final = 100
TERMS: Final[tuple[Term, ...]] = ((3, 0), (1, 2), (5, 0))
COST_TOLERANCE: Final = 0.02
"""Largest relative excess of chi2 per degree of freedom over that from the true cameras."""
ERROR_TOLERANCE: Final = 0.1
"""Largest relative difference of the markers' error from that of the same solution."""
DEGENERATE: Final[dict[Directions, str]] = {
    "all parallel": "all parallel",
    "all in one plane": "all in one plane",
    "on a cone": "on a cone",
    "flat cloud": "in one plane",
}
"""Degenerate waves, and what their refusal says."""
Verdict = Literal["same", "lower", "near", "other", "refused", "truth refused"]
VERDICTS: Final[tuple[Verdict, ...]] = get_args(Verdict)


@dataclass(frozen=True)
class Row:
    """One kind of rigs.

    Args:
        label: what is special about it.
        sensors: smallest and largest number.
        distorted: whether the lenses distort.
        missing: largest share of missing readings; it is drawn evenly from 0, or is always this
            where ``always`` is set.
        always: see ``missing``.
        wrong: share of wrong readings.
        exchanged: share of exchanged ends.
        directions: of the wand.
    """

    label: str
    sensors: tuple[int, int]
    distorted: bool = False
    missing: float = 0.2
    always: bool = False
    wrong: float = 0.01
    exchanged: float = 0.0
    directions: Directions = "all"


ROWS: Final = (
    Row("4 to 8 sensors, no distortion", (4, 8)),
    Row("4 to 8 sensors, lenses distort", (4, 8), distorted=True),
    Row("5 to 8 sensors, 1 % of ends exchanged", (5, 8), exchanged=0.01),
    Row("4 sensors, 30 % missing", (4, 4), missing=0.3, always=True),
    Row("5 to 8 sensors, one end fixed", (5, 8), directions="one end fixed"),
)


@dataclass(frozen=True)
class Outcome:
    """What became of one rig.

    Args:
        verdict: "same" cameras as from the truth; "lower": a cost below it; "near": a higher cost,
            but cameras within the standard deviations of those from the truth, since other poses
            at the limit of contradiction count; "other": cameras with a higher cost; "refused";
            "truth refused": the start from the truth is refused, and these cameras are not.
        mirrored: whether space came out mirrored.
        error_mm: RMS distance of the reconstructed markers, read exactly, from the true ones, after
            the best rigid motion; None where refused.
        reason: why it was refused, or the start from the truth.
        warned: whether the result says that it may be wrong.
    """

    verdict: Verdict
    mirrored: bool
    error_mm: float | None
    reason: str = ""
    warned: bool = False


def draw_wave(row: Row, seed: int, trial: int) -> Wave:
    """Return one rig's readings, the same for the same numbers."""
    rng = np.random.default_rng([seed, trial, *row.label.encode()])
    sensors = int(rng.integers(row.sensors[0], row.sensors[1] + 1))
    bar = random_bar(rng, sensors, distorted=row.distorted)
    return random_wave(
        rng,
        bar,
        poses=POSES,
        sigma_px=float(rng.uniform(0.1, 0.5)),
        missing=row.missing if row.always else float(rng.uniform(0.0, row.missing)),
        wrong=row.wrong,
        exchanged=row.exchanged,
        directions=row.directions,
    )


def draw_degenerate_wave(kind: Directions, seed: int, trial: int) -> Wave:
    """Return the readings of one degenerate wave of five sensors, one of DEGENERATE."""
    rng = np.random.default_rng([seed, trial, list(DEGENERATE).index(kind)])
    bar = random_bar(rng, 5, distorted=False)
    return random_wave(
        rng, bar, poses=POSES, sigma_px=float(rng.uniform(0.1, 0.5)), missing=0.1,
        wrong=0.0, exchanged=0.0, directions=kind,
    )  # fmt: skip


def judge(wave: Wave) -> Outcome:
    """Calibrate from nothing and from the true cameras, and compare."""
    bar = wave.bar
    recording = Recording(
        Wand((0.0, bar.wand_mm)),
        wave.readings_px,
        np.full(wave.readings_px.shape, wave.sigma_px),
    )
    distorted = bool(bar.distortion.any())
    sensors = [SensorGeometry(f"s{k}", bar.pixels) for k in range(len(bar.distance_px))]
    try:
        found = self_calibrate(
            sensors,
            [recording],
            directions_deg=wave.directions_deg,
            distortion=TERMS if distorted else "none",
        )
    except LumilineError as problem:
        return Outcome("refused", False, None, problem.detail)
    error, mirrored = marker_error(found.calibration.models, wave)
    warned = bool(found.warnings)
    try:
        right = self_calibrate(true_models(bar), [recording])
    except LumilineError as problem:
        return Outcome("truth refused", mirrored, error, problem.detail, warned)
    right_error, _ = marker_error(right.calibration.models, wave)
    verdict: Verdict = "other"
    if found.chi2_per_dof <= right.chi2_per_dof * (1.0 + COST_TOLERANCE):
        alike = abs(error - right_error) <= ERROR_TOLERANCE * right_error
        verdict = "same" if alike else "lower"
    elif inner_difference(found, right) <= 1.0:
        verdict = "near"
    return Outcome(verdict, mirrored, error, warned=warned)


def inner_difference(found: SelfCalibration, right: SelfCalibration) -> float:
    """Return how far cameras are apart, over the standard deviations of the second.

    Args:
        found: one calibration.
        right: another of the same sensors.

    Returns:
        Root mean square over the sensors' principal distances and points.
    """
    sigma = np.sqrt(np.diag(np.array(right.calibration.covariance)))
    squares = []
    first = 0
    for one, other in zip(found.calibration.models, right.calibration.models, strict=True):
        difference = (
            one.principal_distance_px - other.principal_distance_px,
            one.principal_point_px - other.principal_point_px,
        )
        squares.append((np.array(difference) / sigma[first : first + 2]) ** 2)
        first += other.parameter_count
    return float(np.sqrt(np.mean(squares)))


def true_models(bar: Bar) -> list[SensorModel]:
    """Return the true cameras as starting cameras."""
    models = []
    for k, rotation in enumerate(bar.rotation):
        offset = -rotation @ bar.lens_mm[k]
        lens = None
        if bar.distortion.any():
            lens = FieldDistortion(TERMS, tuple(bar.distortion[k].tolist()), float(offset[1]))
        models.append(
            SensorModel(
                f"s{k}",
                bar.pixels,
                float(bar.distance_px[k]),
                float(bar.point_px[k]),
                vector3(Rotation.from_matrix(rotation).as_rotvec()),
                float(offset[0]),
                float(offset[2]),
                distortion=lens,
            )
        )
    return models


def marker_error(models: Sequence[SensorModel], wave: Wave) -> tuple[float, bool]:
    """Return the RMS error of the markers' exact readings after a rigid motion, and mirroring."""
    exact = wave.bar.read(wave.markers_mm.reshape(-1, 3))
    complete = np.isfinite(exact).all(axis=1)
    true = wave.markers_mm.reshape(-1, 3)[complete]
    found = reconstruct(models, exact[complete], np.ones(len(models))).position_mm
    good = np.isfinite(found).all(axis=1)
    found, true = found[good], true[good]
    found, true = found - found.mean(axis=0), true - true.mean(axis=0)
    left, _, right = np.linalg.svd(found.T @ true)
    motion = left @ right
    error = float(np.sqrt(((found @ motion - true) ** 2).sum(axis=1).mean()))
    return error, bool(np.linalg.det(motion) < 0.0)


def compute_tables(
    seed: int = SEED, trials: int = TRIALS
) -> tuple[tuple[ResultTable, ...], tuple[str, ...]]:
    """Work out the tables.

    Args:
        seed: of the rigs.
        trials: rigs of each row.
    """
    rows: list[tuple[Cell, ...]] = []
    reasons: list[str] = []
    mirrored = 0
    for index, row in enumerate(ROWS):
        outcomes = []
        for trial in range(trials):
            report_progress((index + trial / trials) / len(ROWS), row.label)
            outcomes.append(judge(draw_wave(row, seed, trial)))
        verdicts = [one.verdict for one in outcomes]
        errors = [one.error_mm for one in outcomes if one.error_mm is not None]
        mirrored += sum(one.mirrored for one in outcomes)
        reasons += [
            f"{one.verdict.capitalize()}, {row.label}: {one.reason}"
            for one in outcomes
            if one.reason
        ]
        rows.append(
            (
                row.label,
                trials,
                *(verdicts.count(name) for name in VERDICTS),
                sum(one.warned for one in outcomes),
                float(np.median(errors)) if errors else None,
                max(errors, default=None),
            )
        )
    table = ResultTable(
        f"cameras from a wand's readings and its length alone, {POSES} poses, beside a start from "
        f"the truth; errors of the markers in mm, seed {seed}",
        ("rigs", "trials", *VERDICTS, "warned", "median error", "largest error"),
        tuple(rows),
    )
    return (table, degenerate_waves(seed, trials)), (
        _ASSUMED,
        f"{mirrored} of {trials * len(ROWS)} came out mirrored.",
        *reasons,
    )


def degenerate_waves(seed: int, trials: int) -> ResultTable:
    """Return how many degenerate waves are refused, and how many by their name.

    Args:
        seed: of the rigs.
        trials: rigs of each kind.
    """
    rows: list[tuple[Cell, ...]] = []
    for kind, name in DEGENERATE.items():
        outcomes = [judge(draw_degenerate_wave(kind, seed, trial)) for trial in range(trials)]
        refused = [one.reason for one in outcomes if one.verdict == "refused"]
        rows.append((kind, trials, len(refused), sum(name in reason for reason in refused)))
    return ResultTable(
        f"degenerate waves, five sensors, seed {seed}",
        ("directions of the wand", "trials", "refused", "by name"),
        tuple(rows),
    )


_ASSUMED: Final = (
    "Assumed: bars of 0.6 to 1.2 m with sensors of 2048 to 4096 pixels and 15 to 35 degrees half a "
    "field, slits at mixed angles, 1.5 to 2.5 m before the volume; noise of 0.1 to 0.5 px, 0 to "
    "20 % of the readings missing, 1 % anywhere on the pixels; two markers 200 to 500 mm apart. "
    "Known are the readings, the length, the pixels, and the directions of the pixels to 11 "
    "degrees (standard deviation), which settle the mirror image. Same: chi2 per degree of freedom "
    "at most 2 % above that of a start from the true cameras and errors within 10 %. Near: a "
    "higher chi2, since another selection of poses at the limit of contradiction counts, but "
    "principal distances and points that differ by at most a standard deviation (RMS)."
)


CASE: Final = TablesCase(
    "wand-from-readings",
    "calibration by a wand without initial cameras, beside a start from the truth",
    "ours; the thesis calibrates with known points only",
    compute_tables,
)
