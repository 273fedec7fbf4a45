"""Benchmark of tool poses against SciPy: ``python -m benchmarks.pose [--json]``.

Ten tools of four markers before four sensors, as a tracking server has them each frame:

* fit: the pose of one tool from the 16 readings of its markers, from the pose of the frame before.
  The peer is ``scipy.optimize.least_squares`` on the same residuals from the same start, as a user
  would write it: a rotation vector and a translation, NumPy arrays of all markers at once, with
  slopes by differences and with analytic ones. Both end at the same minimum; ours also works
  out the covariance, tests the residuals and whether the pose is observable at all.
* without a start: ours tries all rotations. The peer searches from 24 rotations, as few as find the
  pose most of the time.
* step: a frame of all ten tools through ``ToolTracker.step``, their markers lit together or one by
  one: prediction, association, update, covariance, status. One by one also with a single mode of
  motion instead of all (``compute.pose.filtering.imm_state``), turn by turn of the strobe in
  alternation.

Methods take turns, and the least time of each counts: what else a machine does only adds to it.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from benchmarks.triangulation import rig
from compute.camera.stack import CameraStack
from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements
from compute.pose.estimation.pose_fit import fit_pose
from compute.pose.rigid_body import PoseStatus, RigidBody, ToolPose
from compute.pose.settings import ImmSettings, MotionMode, ToolTrackerSettings
from compute.pose.tool_tracking.tool_tracker import ToolTracker
from compute.reconstruction.triangulation import reconstruct
from compute.transform import Transform, rotation_matrix

Array = NDArray[np.float64]
Row = dict[str, str | float]

TOOLS: Final = 10
SIGMA_PX: Final = 0.05
FRAMES: Final = 60
RATE_HZ: Final = 200.0
PEER_STARTS: Final = 24
OURS: Final = "lumiline"
SIGMA: Final = np.full((4, 4), SIGMA_PX)


@dataclass(frozen=True, eq=False)
class Task:
    """One fit: a tool, its true pose, its readings (M, S), and the previous frame's pose."""

    tool: RigidBody
    rotation: Array
    translation_mm: Array
    readings_px: Array
    start: Transform


@dataclass(frozen=True, eq=False)
class Found:
    """Result of a method: the translation (3,) [mm] and the weighted sum of squares."""

    translation_mm: Array
    chi2: float


def tools() -> list[RigidBody]:
    """Return ten tools of four markers within 60 mm, all of different shape."""
    rng = np.random.default_rng(0)
    found: list[RigidBody] = []
    while len(found) < TOOLS:
        markers = rng.uniform(-60.0, 60.0, (4, 3)) * [1.0, 1.0, 0.4]
        apart = np.linalg.norm(markers[:, None] - markers[None], axis=-1)[np.triu_indices(4, 1)]
        if apart.min() > 30.0:
            found.append(RigidBody(f"tool{len(found)}", markers, None, (0.0, 0.0, -150.0)))
    return found


def tasks(cameras: CameraStack) -> list[Task]:
    """Return one fit per tool, starting 2 mm and one degree from the truth."""
    rng = np.random.default_rng(1)
    made = []
    for tool in tools():
        rotation = Rotation.random(random_state=rng).as_matrix()
        shift = np.array([0.0, 0.0, 1500.0]) + rng.uniform(-150.0, 150.0, 3)
        exact = cameras.project(tool.markers_mm @ rotation.T + shift)
        readings = exact + SIGMA_PX * rng.standard_normal(exact.shape)
        off = Transform(rotation_matrix(np.full(3, 0.01)) @ rotation, shift + 1.2)
        made.append(Task(tool, rotation, shift, readings, off))
    return made


def ours(model: MeasurementModel, task: Task, start: Transform | None) -> Found:
    """Fit by Lumiline."""
    found = fit_pose(model, task.tool, task.readings_px, SIGMA, start=start)
    if found.status is not PoseStatus.OK:
        raise RuntimeError(f"no pose of {task.tool.name}: {found.reason}")
    assert found.translation_mm is not None
    assert found.chi2 is not None
    return Found(found.translation_mm, found.chi2)


def by_scipy(cameras: CameraStack, task: Task, start: Transform, *, analytic: bool) -> Found:
    """Fit by SciPy's Levenberg-Marquardt, MINPACK's."""
    markers, readings = task.tool.markers_mm, task.readings_px

    def residuals(x: Array) -> Array:
        positions = markers @ rotation_matrix(x[:3]).T + x[3:]
        return np.asarray(((cameras.project(positions) - readings) / SIGMA_PX).ravel())

    def jacobian(x: Array) -> Array:
        rotation = rotation_matrix(x[:3])
        arms = markers @ rotation.T
        _, by_place = cameras.linearise(arms + x[3:])
        # d (R b) / d x of a rotation vector: -[R b]x times the left Jacobian of the rotation.
        turned = np.cross(arms[:, None, :], by_place) @ _left_jacobian(x[:3])
        return np.asarray(np.concatenate([turned, by_place], axis=2).reshape(-1, 6) / SIGMA_PX)

    x = np.concatenate([Rotation.from_matrix(start.rotation).as_rotvec(), start.translation_mm])
    if analytic:
        found = least_squares(residuals, x, jacobian, method="lm", x_scale="jac")
    else:
        found = least_squares(residuals, x, method="lm", x_scale="jac")
    return Found(np.asarray(found.x[3:]), 2.0 * float(found.cost))


def _left_jacobian(vector: Array) -> Array:
    """Return the left Jacobian of SO(3), shape (3, 3)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-6:
        return np.eye(3) + 0.5 * cross
    first = (1.0 - np.cos(angle)) / angle**2
    second = (angle - np.sin(angle)) / angle**3
    return np.asarray(np.eye(3) + first * cross + second * cross @ cross)


def by_many_starts(cameras: CameraStack, task: Task) -> Found:
    """Fit by SciPy from many start rotations, without an initial pose."""
    rotations = Rotation.random(PEER_STARTS, random_state=np.random.default_rng(2)).as_matrix()
    position = np.array([0.0, 0.0, 1500.0])
    found = [
        by_scipy(cameras, task, Transform(rotation, position), analytic=True)
        for rotation in rotations
    ]
    return min(found, key=lambda one: one.chi2)


@dataclass(frozen=True, eq=False)
class Frame:
    """Input of a tracker for a frame: peaks (4, K), and the lit marker."""

    peaks_px: Array
    marker: int | None
    readings_px: Array | None


def frames(cameras: CameraStack, *, strobed: bool) -> tuple[list[RigidBody], list[Frame]]:
    """Return the tools and frames of them in slow motion."""
    rng = np.random.default_rng(3)
    bodies = tools()
    if strobed:
        bodies = [
            RigidBody(one.name, one.markers_mm, tuple(range(4 * k, 4 * k + 4)), one.tip_mm)
            for k, one in enumerate(bodies)
        ]
    rotations = [Rotation.random(random_state=rng).as_matrix() for _ in bodies]
    # In two rows, 120 mm apart.
    positions = [
        np.array([120.0 * (k % 5 - 2), 140.0 * (k // 5) - 70.0, 1500.0 + 15.0 * k])
        for k in range(TOOLS)
    ]
    axes = rng.standard_normal((TOOLS, 3))
    made = []
    for index in range(FRAMES * (4 * TOOLS if strobed else 1)):
        rate = RATE_HZ * (4 * TOOLS if strobed else 1)
        readings = []
        marker = index % (4 * TOOLS)
        for k, body in enumerate(bodies):
            if strobed and k != marker // 4:
                continue
            turn = rotation_matrix(0.5 * index / rate * axes[k]) @ rotations[k]
            exact = cameras.project(body.markers_mm @ turn.T + positions[k])
            readings.append(exact + SIGMA_PX * rng.standard_normal(exact.shape))
        whole = np.concatenate(readings)
        if strobed:
            made.append(Frame(whole[marker % 4][:, None], marker, None))
        else:
            made.append(Frame(np.sort(whole.T, axis=1), None, whole))
    return bodies, made


@dataclass(frozen=True, eq=False)
class Steps:
    """A tracker's run: thread time per frame [s], and the final poses."""

    seconds: float
    poses: tuple[ToolPose, ...]


def track(
    cameras: CameraStack, trackers: Sequence[ToolTracker], made: Sequence[Frame], cycle: int
) -> list[Steps]:
    """Run frames through trackers alternately; the initial acquisition is not timed.

    Args:
        cameras: the frames are of.
        trackers: of the same tools.
        made: the frames.
        cycle: number of frames that each takes at a turn.
    """
    rate = RATE_HZ * cycle
    took: list[list[float]] = [[] for _ in trackers]
    poses: list[tuple[ToolPose, ...]] = [() for _ in trackers]
    for first in range(0, len(made), cycle):
        for index, tracker in enumerate(trackers):
            before = time.thread_time()
            for number in range(first, first + cycle):
                frame = made[number]
                points = None
                # Where lines cross a tool may not be found in the first frame.
                if number < len(made) // 4 and frame.readings_px is not None:
                    points = reconstruct(cameras, frame.readings_px, SIGMA[0])
                poses[index] = tracker.step(
                    round(1e9 * number / rate),
                    number,
                    Measurements.of(
                        frame.peaks_px,
                        np.full(frame.peaks_px.shape, SIGMA_PX),
                        np.zeros(frame.peaks_px.shape, dtype=np.int32),
                    ),
                    frame.marker,
                    points,
                )
            took[index].append((time.thread_time() - before) / cycle)
    return [
        Steps(float(np.median(one[len(one) // 2 :])), last)
        for one, last in zip(took, poses, strict=True)
    ]


def steps(cameras: CameraStack, *, strobed: bool) -> list[Row]:
    """Return rows of the time per frame of all tools [us]."""
    bodies, made = frames(cameras, strobed=strobed)
    methods = {OURS: ToolTrackerSettings()}
    if strobed:
        methods[f"{OURS}, a single mode"] = ToolTrackerSettings(imm=ImmSettings((MotionMode(1.0),)))
    trackers = [ToolTracker(cameras, bodies, settings) for settings in methods.values()]
    found = track(cameras, trackers, made, 4 * TOOLS if strobed else 1)
    return [
        {
            "job": f"step, {TOOLS} tools, " + ("one marker lit" if strobed else "all lit"),
            "method": name,
            "us_per_tool": 1e6 * one.seconds / TOOLS,
            "us_per_step": 1e6 * one.seconds,
            "times_ours": one.seconds / found[0].seconds,
            "valid_poses": float(sum(pose.valid for pose in one.poses)),
        }
        for name, one in zip(methods, found, strict=True)
    ]


def run(seconds: float = 0.5) -> list[Row]:
    """Measure all methods; times per tool [us]."""
    cameras = rig()
    model = MeasurementModel.of(cameras)
    made = tasks(cameras)
    fits: dict[tuple[str, str], Callable[[Task], Found]] = {
        ("fit", OURS): lambda task: ours(model, task, task.start),
        ("fit", "scipy least_squares, analytic slopes"): lambda task: by_scipy(
            cameras, task, task.start, analytic=True
        ),
        ("fit", "scipy least_squares, by differences"): lambda task: by_scipy(
            cameras, task, task.start, analytic=False
        ),
        ("without a start", OURS): lambda task: ours(model, task, None),
        (
            "without a start",
            f"scipy least_squares, {PEER_STARTS} starts",
        ): lambda task: by_many_starts(cameras, task),
    }
    least = dict.fromkeys(fits, np.inf)
    found: dict[tuple[str, str], list[Found]] = {}
    end = time.perf_counter() + seconds * len(fits)
    while True:
        for key, method in fits.items():
            before = time.perf_counter()
            found[key] = [method(task) for task in made]
            least[key] = min(least[key], (time.perf_counter() - before) / len(made))
        if time.perf_counter() > end:
            break
    rows: list[Row] = []
    for (job, name), took in least.items():
        off = [
            float(np.linalg.norm(one.translation_mm - task.translation_mm))
            for one, task in zip(found[job, name], made, strict=True)
        ]
        rows.append(
            {
                "job": job,
                "method": name,
                "us_per_tool": 1e6 * took,
                "times_ours": took / least[job, OURS],
                "worst_error_mm": max(off),
                "mean_chi2": float(np.mean([one.chi2 for one in found[job, name]])),
            }
        )
    for strobed in (False, True):
        rows += steps(cameras, strobed=strobed)
    return rows


def main(argv: Sequence[str] | None = None) -> int:
    """Print the rows as a table, or as JSON."""
    parser = argparse.ArgumentParser(prog="benchmarks.pose", description=__doc__)
    parser.add_argument("--seconds", type=float, default=0.5, help="time for each method")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(argv)
    rows = run(options.seconds)
    if options.json:
        json.dump(rows, sys.stdout, indent=2)
        print()
        return 0
    print(f"{'job':32} {'method':38} {'us/tool':>9} {'x ours':>7} {'worst mm':>9}")
    for row in rows:
        times = f"{row['times_ours']:7.2f}" if "times_ours" in row else " " * 7
        worst = f"{row['worst_error_mm']:9.3f}" if "worst_error_mm" in row else ""
        print(f"{row['job']:32} {row['method']:38} {row['us_per_tool']:9.1f} {times} {worst}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
