"""Case bad-inputs: share of bad inputs that are answered rightly, and of sound rigs refused."""

from collections import Counter
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.assessment.diagnosis import diagnose
from compute.calibration.calibrate import calibrate
from compute.calibration.result import Calibration
from compute.calibration.settings import CalibrationSettings, Distortion
from compute.camera.model import SensorGeometry
from compute.errors import LumilineError
from compute.reconstruction.triangulation import reconstruct
from validation.bad_inputs.inputs import KINDS, Kind, sound_rig
from validation.progress import report_progress
from validation.random_rigs.rigs import Rig, random_trial
from validation.result_tables import Cell, ResultTable, TablesCase

Array = NDArray[np.float64]

SEED: Final = 1
TRIALS: Final = 8
"""Rigs of each kind of bad input."""
SOUND_FACTOR: Final = 12
"""Sound rigs for each rig of a kind."""
MIN_READINGS: Final = 8
"""Fewest readings of each sensor of a sound rig."""
NOISE_PX: Final = 0.5
HELD_OUT: Final = 200
HELD_OUT_NOISE_PX: Final = 0.02
MAX_NEES: Final = 5.0
"""Largest mean normalised error squared of an honest covariance; 3 on the mean over rigs."""
DISTORTIONS: Final[tuple[Distortion, ...]] = ("none", "auto")


def answer(
    points_mm: Array,
    readings_px: Array,
    pixels: int,
    settings: CalibrationSettings,
    sigma_px: float | None,
) -> tuple[Calibration | None, str]:
    """Calibrate; return the calibration, or None if that was refused, and the error or the remarks.

    Args:
        points_mm: control points, shape (N, 3) [mm].
        readings_px: shape (N, S) [px].
        pixels: of each sensor.
        settings: of the calibration.
        sigma_px: standard deviation of the readings; None: not given.
    """
    sensors = [SensorGeometry(f"s{k + 1}", pixels) for k in range(readings_px.shape[1])]
    sigma = None if sigma_px is None else np.full(readings_px.shape, sigma_px)
    try:
        found = calibrate(points_mm, readings_px, sensors, sigma, settings)
    except LumilineError as error:
        return None, f"{type(error).__name__}: {error.detail}"
    return found, " ".join(diagnose(found, points_mm, readings_px).remarks)


def is_honest(found: Calibration, rig: Rig, rng: np.random.Generator) -> bool:
    """Return whether points that calibration never saw lie within their covariance.

    Args:
        found: the calibration.
        rig: the rig, whose readings are exact.
        rng: draws the points.
    """
    points = rig.points(rng, HELD_OUT, 0.8)
    noise = np.full(rig.sensors, HELD_OUT_NOISE_PX)
    readings = rig.read(points) + noise * rng.standard_normal((HELD_OUT, rig.sensors))
    ours = reconstruct(found.models, readings, noise, np.array(found.covariance))
    errors = ours.position_mm - points
    rows = np.isfinite(errors).all(axis=1)
    weighted = np.linalg.solve(ours.covariance_mm2[rows], errors[rows, :, None])[..., 0]
    return bool((errors[rows] * weighted).sum(axis=1).mean() < MAX_NEES)


def is_right(kind: Kind, refused: bool, text: str) -> bool:
    """Return whether an answer is what a kind of bad input must get.

    Args:
        kind: of bad input.
        refused: whether it was refused.
        text: the error or the remarks.
    """
    # A refusal is right where a remark would be: points on a curve may leave no camera at all.
    return refused >= kind.refused and any(one in text for one in kind.expected)


def run_kind(kind: Kind, trials: int, seed: int) -> tuple[int, list[str], str]:
    """Return the number of right answers, the wrong ones, and a right one.

    Args:
        kind: of bad input.
        trials: number of rigs; settings alternate.
        seed: of the random numbers.
    """
    right, wrong, example = 0, list[str](), ""
    for number in range(trials):
        rng = np.random.default_rng([seed, number])
        rig = sound_rig(rng)
        points, readings = kind.make(rig, rng)
        settings = CalibrationSettings(DISTORTIONS[number % 2])
        sigma = NOISE_PX if number // 2 % 2 else None
        found, text = answer(points, readings, rig.pixels, settings, sigma)
        if kind.honest and found is not None and is_honest(found, rig, rng):
            right += 1
        elif is_right(kind, found is None, text):
            right += 1
            index = min(text.find(one) for one in kind.expected if one in text)
            example = example or text[max(0, index - 60) : index + 60]
        else:
            wrong.append(text)
    return right, wrong, example


def false_refusals(trials: int, seed: int) -> tuple[int, list[str]]:
    """Return the number of sound rigs, and the refusals among them.

    Args:
        trials: number of rigs.
        seed: of the random numbers.
    """
    count, refusals = 0, list[str]()
    for number in range(trials):
        report_progress(number / trials, f"sound rig {number + 1} of {trials}")
        trial = random_trial(np.random.default_rng([seed, number]))
        if trial.fewest_readings < MIN_READINGS:
            continue
        count += 1
        sigma = trial.noise_px if trial.noise_given else None
        distortion: Distortion = "auto" if trial.distorted or number % 2 else "none"
        settings = CalibrationSettings(distortion, trial.position_sigma_mm or None)
        arrays = trial.control_mm, trial.readings_px
        found, text = answer(*arrays, trial.rig.pixels, settings, sigma)
        if found is None:
            refusals.append(text)
    return count, refusals


def compute_tables(
    trials: int = TRIALS, seed: int = SEED
) -> tuple[tuple[ResultTable, ...], tuple[str, ...]]:
    """Give bad inputs of each kind, then sound rigs.

    Args:
        trials: rigs of each kind.
        seed: of their random numbers.
    """
    rows: list[tuple[Cell, ...]] = []
    total = 0
    for number, kind in enumerate(KINDS):
        report_progress(number / len(KINDS), kind.label)
        right, wrong, example = run_kind(kind, trials, seed)
        total += right
        answered = "refused" if kind.refused else "remark"
        rows.append((kind.label, answered, trials, right, f"... {example} ..."))
        rows.extend((f"- wrong: {kind.label}", "", None, None, text[:200]) for text in wrong[:3])
    count, refusals = false_refusals(SOUND_FACTOR * trials, seed)
    kinds = Counter(text.split(":")[0] for text in refusals)
    refused = ResultTable(
        "Refusals among sound rigs",
        ("error", "rigs", "for example"),
        tuple(
            (kind, number, next(text for text in refusals if text.startswith(kind)))
            for kind, number in sorted(kinds.items())
        ),
    )
    table = ResultTable(
        "Bad inputs: answers",
        ("input", "must be", "rigs", "right", "with these words"),
        tuple(rows),
    )
    findings = (
        f"{total} of {trials * len(KINDS)} bad inputs were answered rightly.",
        (
            f"{len(refusals)} of {count} sound rigs were refused (random-rigs' own, of which each "
            f"sensor has {MIN_READINGS} readings or more)."
        ),
    )
    return (table, refused), findings


CASE: Final = TablesCase(
    "bad-inputs",
    "what calibration refuses or remarks, and that it refuses nothing sound",
    "ours; the thesis has no such inputs",
    compute_tables,
)
