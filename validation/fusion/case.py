"""Case fusion: points and poses of two bars with clocks of their own, against one clock."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from compute.calibration.result import Calibration
from compute.camera.stack import CameraStack
from compute.fusion.bar_history import BarExposure, BarHistory
from compute.fusion.clock_errors import PointReadings, clock_sensitivity, correct_points
from compute.fusion.clock_refinement import ClockRefinement
from compute.fusion.motion_clock_errors import add_clock_errors_to_pose
from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements
from compute.pose.rigid_body import ToolPose
from compute.pose.tool_tracking.tool_tracker import ToolTracker
from compute.reconstruction.point_batch import PointBatch
from compute.reconstruction.triangulation import reconstruct
from compute.transform import rotation_vector
from validation.fusion.scene import (
    RATE_HZ,
    SIGMA_PX,
    TOOL,
    HallRun,
    draw_run,
    hall,
    joint_calibration,
    tool_pose,
)
from validation.progress import report_progress
from validation.result_tables import Cell, ResultTable, TablesCase

Array = NDArray[np.float64]

RUNS: Final = 10
SECONDS: Final = 1.6
LEARNING_S: Final = 0.8
"""Of a run, before it counts: the tool is found, and the clock refined."""
BLOCK_S: Final = 0.2
"""The clock is refined from that much at once."""
SEED: Final = 210
SPEEDS_MM_S: Final = (0.0, 2000.0)
CLOCKS_S: Final = (1e-6, 20e-6, 50e-6)
"""Standard deviations: PTP, round trips in a quiet network, and in a busy one."""
REFERENCE_BAR: Final = np.array([-1] * 4 + [0] * 4)
MAX_TIP_SD_MM: Final = 1.0


@dataclass(frozen=True, eq=False)
class Scores:
    """Errors of N points or poses.

    Args:
        off_mm2: squared errors, of the point or the tip [mm^2].
        nees: normalised errors squared.
    """

    off_mm2: Array
    nees: Array

    @property
    def rms_mm(self) -> float:
        """RMS error [mm]."""
        return float(np.sqrt(self.off_mm2.mean()))

    @classmethod
    def concatenate(cls, parts: "list[Scores]") -> "Scores":
        """Return those of several runs."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts])
                     for name in ("off_mm2", "nees")))  # fmt: skip


@dataclass(frozen=True, eq=False)
class Fused:
    """Readings of both bars at the first one's exposures, and what is known of the clock then.

    Args:
        readings: of N exposures.
        points: of these.
        refined: points with the clock's uncertainty in their covariance.
        clock_variance_s2: shape (N,) [s^2].
        waited_s: until the second bar's exposure behind the nearest one, shape (N,) [s].
    """

    readings: PointReadings
    points: PointBatch
    refined: PointBatch
    clock_variance_s2: Array
    waited_s: Array


def fuse(run: HallRun, model: MeasurementModel, clock_sigma_s: float, *, refined: bool) -> Fused:
    """Fuse a run as it comes, block by block; ``refined``: learn the clock from it meanwhile."""
    clock = ClockRefinement(np.array([clock_sigma_s]))
    history: BarHistory[None] = BarHistory(len(run.time_s))
    stated = np.round(1e9 * run.second_time_s).astype(np.int64)
    for at, slot, reading in zip(stated.tolist(), run.slot.tolist(), run.second_px, strict=True):
        raw = reading[:, None]
        history.add(slot, BarExposure(at, raw, np.full(raw.shape, SIGMA_PX**2), None))
    size = round(BLOCK_S * RATE_HZ)
    parts = []
    for first in range(0, len(run.time_s), size):
        block = range(first, min(first + size, len(run.time_s)))
        applied = clock.estimate
        readings, waited = _readings(run, history, block, applied.error_s[0])
        points = reconstruct(
            model.cameras, readings.position_px, readings.sigma_px, model.parameter_covariance
        )
        sensitivity = clock_sensitivity(
            model, points, readings, REFERENCE_BAR, with_common_errors=True
        )
        grown = correct_points(points, sensitivity, np.zeros(1), applied.covariance_s2)
        variance = np.full(len(points), applied.covariance_s2[0, 0])
        parts.append((readings, points, grown, variance, waited))
        if refined:
            clock.predict(BLOCK_S)
            clock.update(sensitivity, applied.error_s)
    every = [one[0] for one in parts]
    return Fused(
        PointReadings(
            *(np.concatenate([getattr(one, name) for one in every]) for name in vars(every[0]))
        ),
        PointBatch.concatenate([one[1] for one in parts]),
        PointBatch.concatenate([one[2] for one in parts]),
        np.concatenate([one[3] for one in parts]),
        np.concatenate([one[4] for one in parts]),
    )


def _readings(
    run: HallRun, history: BarHistory[None], block: range, shift_s: float
) -> tuple[PointReadings, Array]:
    """Return the readings of both bars at some exposures of the first, and the time waited."""
    found = np.full((5, len(block), 8), np.nan)
    waited = np.full(len(block), np.nan)
    first, last = block.start, block.stop
    found[0, :, :4], found[1, :, :4] = run.first_px[first:last], SIGMA_PX**2
    found[2:, :, :4] = 0.0
    cycle_s = len(TOOL) / RATE_HZ
    for row, k in enumerate(block):
        at = history.at(round(1e9 * run.time_s[k]), int(run.slot[k]), round(1e9 * shift_s))
        if at is not None:
            nearest, aligned = at
            found[:, row, 4:] = np.stack([*vars(aligned).values()])[..., 0]
            waited[row] = nearest.time_ns * 1e-9 + cycle_s - run.time_s[k]
    found[1] = np.sqrt(found[1])
    return PointReadings(*found), waited


def score_points(run: HallRun, points: PointBatch) -> Scores:
    """Compare points with the truth, once the clock had time to be refined."""
    counts = (run.time_s >= LEARNING_S) & np.isfinite(points.position_mm[:, 0])
    # The last ones have no neighbours behind them.
    counts[-2 * len(TOOL) :] = False
    error = (points.position_mm - run.marker_mm)[counts]
    inverse = np.linalg.inv(points.covariance_mm2[counts])
    return Scores((error**2).sum(axis=1), np.einsum("ni,nij,nj->n", error, inverse, error))


def track(
    calibration: Calibration,
    times_s: Array,
    slots: NDArray[np.intp],
    position_px: Array,
    sigma_px: Array,
) -> list[ToolPose]:
    """Return the tool's pose after each exposure."""
    cameras = CameraStack.of(calibration.models)
    tracker = ToolTracker(cameras, [TOOL], None, np.array(calibration.covariance))
    poses: list[ToolPose] = []
    for k, (time_s, slot) in enumerate(zip(times_s.tolist(), slots.tolist(), strict=True)):
        sigma = np.where(np.isfinite(sigma_px[k]), sigma_px[k], 1.0)
        measurements = Measurements.of(position_px[k][:, None], sigma[:, None])
        poses += tracker.step(round(1e9 * (time_s + 1.0)), k, measurements, slot)
    return poses


def score_poses(times_s: Array, poses: list[ToolPose], speed_mm_s: float) -> Scores:
    """Compare poses with the truth, once the clock had time to be refined."""
    rotations, origins = tool_pose(times_s, speed_mm_s)
    tip = np.array(TOOL.tip_mm)
    off, nees = [], []
    last = len(poses) - 2 * len(TOOL)
    for k, pose in enumerate(poses):
        if times_s[k] < LEARNING_S or k >= last or pose.covariance is None:
            continue
        assert pose.rotation is not None
        assert pose.translation_mm is not None
        assert pose.tip_mm is not None
        turn = rotation_vector(rotations[k] @ pose.rotation.T)
        error = np.concatenate([turn, origins[k] - pose.translation_mm])
        nees.append(error @ np.linalg.solve(pose.covariance, error))
        off.append(((pose.tip_mm - rotations[k] @ tip - origins[k]) ** 2).sum())
    return Scores(np.array(off), np.array(nees))


def _alternating(run: HallRun, calibration: Calibration) -> tuple[Array, list[ToolPose]]:
    """Return the poses of a filter that takes each bar's exposures when they were made."""
    none = np.full(run.first_px.shape, np.nan)
    times = np.concatenate([run.time_s, run.second_time_s])
    order = np.argsort(times, kind="stable")
    position = np.concatenate([np.hstack([run.first_px, none]), np.hstack([none, run.second_px])])[
        order
    ]
    slots = np.concatenate([run.slot, run.slot])[order]
    sigma = np.full(position.shape, SIGMA_PX)
    poses = track(calibration, times[order], slots, position, sigma)
    of_first = np.flatnonzero(order < len(run.time_s))
    return run.time_s, [poses[index] for index in of_first]


@dataclass(frozen=True, eq=False)
class Comparison:
    """Points and poses of some runs at one speed, with one uncertainty of the clock."""

    points: dict[str, Scores]
    poses: dict[str, Scores]
    waited_s: float


def compare(
    speed_mm_s: float, clock_sigma_s: float, runs: int, seconds: float, seed: int
) -> Comparison:
    """Fuse the same runs in all ways."""
    rng = np.random.default_rng((seed, round(speed_mm_s), round(1e9 * clock_sigma_s)))
    true = CameraStack.of(hall())
    points: dict[str, list[Scores]] = {}
    poses: dict[str, list[Scores]] = {}
    waited = []
    # Clock errors of a normal distribution, each part of it once.
    errors = clock_sigma_s * ndtri((rng.permutation(runs) + 0.5) / runs)
    for error_s in errors.tolist():
        calibration = joint_calibration(true, rng)
        covariance = np.array(calibration.covariance)
        model = MeasurementModel.of(calibration.models, covariance)
        run = draw_run(true, speed_mm_s, seconds, error_s, rng)
        sigma = np.full(run.together_px.shape, SIGMA_PX)
        together = reconstruct(model.cameras, run.together_px, sigma, covariance)
        plain = fuse(run, model, clock_sigma_s, refined=False)
        learned = fuse(run, model, clock_sigma_s, refined=True)
        waited.append(np.nanmean(plain.waited_s))
        for name, found in (
            ("one clock", together),
            ("left out", plain.points),
            ("stated", plain.refined),
            ("refined", learned.refined),
        ):
            points.setdefault(name, []).append(score_points(run, found))
        tracked = {
            "one clock": track(
                calibration, run.time_s, run.slot, run.together_px, sigma
            ),
            "left out": track(
                calibration, run.time_s, run.slot, plain.readings.position_px,
                plain.readings.sigma_px,
            ),
            "refined": track(
                calibration, run.time_s, run.slot, learned.readings.position_px,
                learned.readings.sigma_px,
            ),
            "each bar's exposures": _alternating(run, calibration)[1],
        }  # fmt: skip
        tracked["stated"] = _grown(tracked["left out"], model, plain.clock_variance_s2)
        tracked["refined"] = _grown(tracked["refined"], model, learned.clock_variance_s2)
        for name, found_poses in tracked.items():
            poses.setdefault(name, []).append(score_poses(run.time_s, found_poses, speed_mm_s))
    return Comparison(
        {name: Scores.concatenate(parts) for name, parts in points.items()},
        {name: Scores.concatenate(parts) for name, parts in poses.items()},
        float(np.mean(waited)),
    )


def _grown(
    poses: list[ToolPose], model: MeasurementModel, clock_variance_s2: Array
) -> list[ToolPose]:
    return [
        add_clock_errors_to_pose(
            pose, TOOL, model, REFERENCE_BAR, np.array([[variance]]), MAX_TIP_SD_MM
        )
        for pose, variance in zip(poses, clock_variance_s2.tolist(), strict=True)
    ]


def compute_tables(
    trials: int = RUNS, seconds: float = SECONDS, seed: int = SEED
) -> tuple[tuple[ResultTable, ...], tuple[str, ...]]:
    """Return the tables of points and poses, and what they show."""
    kinds = [(speed, sigma) for speed in SPEEDS_MM_S for sigma in CLOCKS_S]
    compared = []
    for done, (speed, sigma) in enumerate(kinds):
        report_progress(done / len(kinds), f"{speed:g} mm/s, clock {1e6 * sigma:g} us")
        compared.append((speed, sigma, compare(speed, sigma, trials, seconds, seed)))
    headings = (
        "mm/s",
        "clock us",
        "one clock",
        "left out",
        "refined",
        "refined, ratio",
        "squared, one clock",
        "squared, left out",
        "squared, stated",
        "squared, refined",
    )
    points = ResultTable(
        f"points of both bars, {SIGMA_PX:g} px of noise: RMS [mm], normalised error squared (3)",
        headings,
        tuple((speed, 1e6 * sigma, *_row(one.points)) for speed, sigma, one in compared),
    )
    poses = ResultTable(
        "poses of a strobed tool, tip 150 mm from its markers: RMS of the tip [mm], normalised "
        "error squared (6)",
        (*headings, "each bar's exposures", "squared, each"),
        tuple(
            (
                speed,
                1e6 * sigma,
                *_row(one.poses),
                _rounded(one.poses["each bar's exposures"].rms_mm),
                _rounded(float(one.poses["each bar's exposures"].nees.mean())),
            )
            for speed, sigma, one in compared
        ),
    )
    worst = {
        name: max(
            getattr(one, name)["refined"].rms_mm / getattr(one, name)["one clock"].rms_mm
            for _, _, one in compared
        )
        for name in ("points", "poses")
    }
    waited = float(np.mean([one.waited_s for _, _, one in compared]))
    return (points, poses), (
        (
            "One clock: all eight sensors exposed together. Left out: the second bar's readings at "
            "the first one's times by its clock, corrected but for an error of the stated "
            "deviation, of which points and poses know nothing; stated: they know the deviation; "
            "refined: the error is estimated from the readings, and they know what is left of it. "
            "Each run has a joint calibration of its own."
        ),
        (
            f"With refined clocks the RMS of points is at most {worst['points']:.3f} times that on "
            f"one clock, that of tips {worst['poses']:.3f} times."
        ),
        (
            "Each bar's exposures: a filter that takes both bars' exposures when they were made, "
            "with the clock as it is; it has no later readings of the second bar."
        ),
        (
            f"The readings of both sides of an exposure are there {1e3 * waited:.1f} ms after it "
            f"on the mean, with {len(TOOL)} strobed markers at {RATE_HZ:g} exposures a second."
        ),
    )


def _row(scores: dict[str, Scores]) -> list[Cell]:
    one, left_out, refined = (scores[name] for name in ("one clock", "left out", "refined"))
    values = [
        one.rms_mm,
        left_out.rms_mm,
        refined.rms_mm,
        refined.rms_mm / one.rms_mm,
        *(
            float(scores[name].nees.mean())
            for name in ("one clock", "left out", "stated", "refined")
        ),
    ]
    return [_rounded(value) for value in values]


def _rounded(value: float) -> float | None:
    return float(f"{value:.4g}") if np.isfinite(value) else None


CASE: Final = TablesCase(
    "fusion",
    "points and poses of two bars with clocks of their own, fused, at rest and at 2 m/s",
    "time stamps and their uncertainty: Kelly and Sukhatme, doi:10.1007/978-3-642-28572-1_14",
    compute_tables,
)
