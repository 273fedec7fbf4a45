"""Tools in front of the rig, and what its sensors read of them as they move."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.measurement.measurements import Measurements
from compute.pose.rigid_body import RigidBody, ToolPose
from compute.pose.tool_tracking.tool_tracker import ToolTracker
from compute.reconstruction.point_batch import PointBatch
from compute.reconstruction.triangulation import reconstruct
from compute.transform import rotation_matrix
from tests.compute.rig import PIXELS, rig

Array = NDArray[np.float64]

SIGMA_PX = 0.05
CAMERAS = CameraStack.of(rig())
PIXELS_OF_ALL = (PIXELS,) * 4
MIDDLE_MM = np.array([0.0, 0.0, 1500.0])
MARKERS_MM = np.array([[0.0, 0, 0], [60, 0, 5], [20, 50, 0], [-30, 30, 25]])
OTHER_MM = np.array([[0.0, 0, 0], [75, 10, 0], [10, 40, 10], [-45, 15, -20]])
CALIBRATION = np.diag(np.tile([1.0, 0.5, 1e-4, 1e-4, 1e-4, 0.05, 0.1], 4) ** 2)
"""Covariance of the cameras' parameters."""


def pointer(name: str = "pointer", *, strobed: bool = False) -> RigidBody:
    """A tool with its tip 150 mm from its markers."""
    return RigidBody(name, MARKERS_MM, (0, 1, 2, 3) if strobed else None, (0.0, 0.0, -150.0))


def other() -> RigidBody:
    """A tool of another geometry."""
    return RigidBody("other", OTHER_MM)


def random_rotation(rng: np.random.Generator) -> Array:
    """Evenly over all turns."""
    q = rng.standard_normal(4)
    q /= np.linalg.norm(q)
    angle = 2.0 * np.arctan2(np.linalg.norm(q[1:]), q[0])
    return rotation_matrix(q[1:] / np.linalg.norm(q[1:]) * angle)


@dataclass
class Body:
    """A tool that moves at constant velocities, or by white noise of them.

    Args:
        tool: its markers.
        rotation: R_world_tool.
        centroid_mm: of its markers.
        velocity_mm_s: of the centroid.
        angular_velocity_rad_s: about the world's axes.
    """

    tool: RigidBody
    rotation: Array
    centroid_mm: Array
    velocity_mm_s: Array = field(default_factory=lambda: np.zeros(3))
    angular_velocity_rad_s: Array = field(default_factory=lambda: np.zeros(3))

    def move(self, step_s: float) -> None:
        """Move on."""
        self.rotation = rotation_matrix(self.angular_velocity_rad_s * step_s) @ self.rotation
        self.centroid_mm = self.centroid_mm + self.velocity_mm_s * step_s

    @property
    def translation_mm(self) -> Array:
        """Of the tool's origin."""
        return self.centroid_mm - self.rotation @ self.tool.markers_mm.mean(axis=0)

    @property
    def markers_mm(self) -> Array:
        """In the world, shape (M, 3)."""
        return self.tool.markers_mm @ self.rotation.T + self.translation_mm

    @property
    def tip_world_mm(self) -> Array:
        """In the world, shape (3,)."""
        tip = np.zeros(3) if self.tool.tip_mm is None else np.array(self.tool.tip_mm)
        return self.rotation @ tip + self.translation_mm


def body(tool: RigidBody, seed: int = 0, place_mm: Array = MIDDLE_MM) -> Body:
    """A tool at rest, turned at random."""
    return Body(tool, random_rotation(np.random.default_rng(seed)), np.array(place_mm))


@dataclass
class Scene:
    """Bodies in front of true cameras; ``tracker`` knows calibrated ones.

    Args:
        bodies: the tools.
        tracker: takes what is read.
        cameras: the true ones.
        rate_hz: of frames.
        seed: of the noise.
        covariance: of the calibrated cameras, for the points.
    """

    bodies: list[Body]
    tracker: ToolTracker
    cameras: CameraStack = CAMERAS
    rate_hz: float = 1000.0
    seed: int = 0
    covariance: Array | None = None
    sequence: int = 0

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)

    @property
    def time_ns(self) -> int:
        """Of the next frame."""
        return round(1e9 * self.sequence / self.rate_hz)

    def readings(self, hidden: tuple[tuple[int, int | None], ...] = ()) -> list[Array]:
        """What the sensors read of each body, (M, S), NaN of hidden (marker, sensor or all)."""
        found = []
        for one in self.bodies:
            exact = self.cameras.project(one.markers_mm)
            reading = exact + SIGMA_PX * self.rng.standard_normal(exact.shape)
            reading[(reading < -0.5) | (reading > PIXELS - 0.5)] = np.nan
            for marker, sensor in hidden:
                reading[marker, slice(None) if sensor is None else sensor] = np.nan
            found.append(reading)
        return found

    def strobed(self, *, blind: bool = False, off_px: float = 0.0) -> tuple[ToolPose, ...]:
        """The next frame, which lights one marker of the first body."""
        marker = self.sequence % len(self.bodies[0].tool)
        (reading,) = self.readings()
        one = reading[marker] + off_px
        return self._step(np.where(blind, np.nan, one)[:, None], marker, None)

    def together(
        self,
        hidden: tuple[tuple[int, int | None], ...] = (),
        clutter: Array | None = None,
        *,
        with_points: bool = True,
        merging: bool = False,
    ) -> tuple[ToolPose, ...]:
        """The next frame, which lights all markers; ``clutter`` are more peaks, (S, k).

        With ``merging``, lines nearer than a pixel to one another are one peak between them.
        """
        readings = np.concatenate(self.readings(hidden))
        peaks = readings.T if clutter is None else np.hstack([readings.T, clutter])
        if merging:
            peaks = np.sort(peaks, axis=1)
            for row in peaks:
                for k in np.flatnonzero(np.diff(row) < 1.0):
                    row[k : k + 2] = row[k : k + 2].mean(), np.nan
        points = None
        if with_points:
            points = reconstruct(
                CAMERAS, readings, np.full(4, SIGMA_PX), parameter_covariance=self.covariance
            )
        return self._step(np.sort(peaks, axis=1), None, points)

    def _step(
        self, peaks: Array, marker: int | None, points: PointBatch | None
    ) -> tuple[ToolPose, ...]:
        found = self.tracker.step(
            self.time_ns,
            self.sequence,
            Measurements.of(
                peaks, np.full(peaks.shape, SIGMA_PX), np.zeros(peaks.shape, dtype=np.int32)
            ),
            marker,
            points,
        )
        self.sequence += 1
        for one in self.bodies:
            one.move(1.0 / self.rate_hz)
        return found


def normalised(pose: ToolPose, true: Body) -> tuple[float, float]:
    """Normalised error squared of a pose (6) and of its tip (3)."""
    assert pose.rotation is not None
    assert pose.translation_mm is not None
    assert pose.covariance is not None
    assert pose.tip_mm is not None
    assert pose.tip_covariance_mm2 is not None
    return pose_square(pose.rotation, pose.translation_mm, pose.covariance, true), float(
        (true.tip_world_mm - pose.tip_mm)
        @ np.linalg.solve(pose.tip_covariance_mm2, true.tip_world_mm - pose.tip_mm)
    )


def pose_square(rotation: Array, translation_mm: Array, covariance: Array, true: Body) -> float:
    """Normalised error squared of a pose."""
    from compute.transform import rotation_vector

    turn = rotation_vector(true.rotation @ rotation.T)
    off = np.concatenate([turn, true.translation_mm - translation_mm])
    return float(off @ np.linalg.solve(covariance, off))
