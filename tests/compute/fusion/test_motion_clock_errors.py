"""Clock errors of tracks and poses: what a filter of late readings is off by; its covariance."""

import numpy as np
import pytest

from compute.fusion.motion_clock_errors import (
    add_clock_errors_to_pose,
    add_clock_errors_to_tracks,
)
from compute.measurement.measurements import Measurements
from compute.pose.rigid_body import PoseStatus, RigidBody, ToolPose
from compute.pose.tool_tracking.tool_tracker import ToolTracker
from compute.tracking.tracker import Tracker
from compute.transform import rotation_matrix, rotation_vector
from tests.compute.fusion.hall import BAR, SIGMA_PX, model
from tests.oracles.two_bars import CENTRE, read, sensors

CLOCK_S = 100e-6
STEP_S = 2e-3
VELOCITY = np.array([1500.0, 600.0, -900.0])
TURNING = np.array([3.0, -2.0, 4.0])
MARKERS = np.array([[0.0, 0.0, 0.0], [60.0, 0.0, 5.0], [20.0, 50.0, 0.0], [-30.0, 30.0, 25.0]])


def late_readings(positions: np.ndarray, before: np.ndarray) -> Measurements:
    """Readings of markers (M, 3), where the second bar saw them ``before``: one or more peaks."""
    both = sensors()
    now = np.hstack([read(both[:4], positions), read(both[4:], before)]).T
    return Measurements.of(np.sort(now, axis=1), np.full(now.shape, SIGMA_PX))


def test_a_track_is_off_by_the_share_of_the_late_bar() -> None:
    cameras = model()
    tracker = Tracker(cameras.cameras)
    for k in range(100):
        at_s = (k - 50) * STEP_S
        where = CENTRE + VELOCITY * at_s
        tracks = tracker.step(
            1 + round(k * STEP_S * 1e9),
            late_readings(where[None], (where - VELOCITY * CLOCK_S)[None]),
            0,
        )
    off = tracks.position_mm[0] - where
    grown = add_clock_errors_to_tracks(tracks, cameras, BAR, np.array([[CLOCK_S**2]]))
    added = grown.covariance[0, :3, :3] - tracks.covariance[0, :3, :3]
    np.testing.assert_allclose(added, np.outer(off, off), atol=0.1 * (off**2).max())
    np.testing.assert_array_equal(grown.covariance[0, 3:], tracks.covariance[0, 3:])
    assert add_clock_errors_to_tracks(tracks, cameras, BAR, np.zeros((1, 1))) is tracks


def late_pose() -> tuple[ToolPose, RigidBody, np.ndarray]:
    """The pose of a tool that moves and turns, the tool, and the error of the pose."""
    tool = RigidBody("tool", MARKERS, (0, 1, 2, 3), (0.0, 0.0, -150.0))
    tracker = ToolTracker(model().cameras, [tool])
    start = rotation_matrix(np.array([0.3, -0.2, 0.5]))

    def markers(at_s: float) -> np.ndarray:
        rotation = rotation_matrix(TURNING * at_s) @ start
        return MARKERS @ rotation.T + CENTRE + VELOCITY * at_s

    for k in range(200):
        at_s = (k - 100) * STEP_S / 2.0
        lit = k % 4
        (pose,) = tracker.step(
            1 + round(k * STEP_S / 2.0 * 1e9),
            k,
            late_readings(markers(at_s)[[lit]], markers(at_s - CLOCK_S)[[lit]]),
            lit,
        )
    assert pose.rotation is not None
    assert pose.translation_mm is not None
    turn = rotation_vector(pose.rotation @ (rotation_matrix(TURNING * at_s) @ start).T)
    return pose, tool, np.concatenate([turn, pose.translation_mm - CENTRE - VELOCITY * at_s])


def test_a_pose_is_off_by_the_share_of_the_late_bar() -> None:
    pose, tool, off = late_pose()
    assert pose.covariance is not None
    assert pose.tip_covariance_mm2 is not None
    cameras = model()
    grown = add_clock_errors_to_pose(pose, tool, cameras, BAR, np.array([[CLOCK_S**2]]), 1.0)
    added = grown.covariance - pose.covariance
    size = np.abs(off)
    # To a tenth of the shift of the centroid: the rotation is small beside what moves the origin.
    assert added[3:, 3:] == pytest.approx(
        np.outer(off[3:], off[3:]), abs=0.15 * (size[3:] ** 2).max()
    )
    tip = np.trace(grown.tip_covariance_mm2 - pose.tip_covariance_mm2)
    assert tip == pytest.approx((off[3:] ** 2).sum(), rel=0.3)
    assert grown.status is PoseStatus.OK


def test_a_pose_that_the_clock_makes_too_uncertain_is_of_a_high_error() -> None:
    pose, tool, _ = late_pose()
    grown = add_clock_errors_to_pose(pose, tool, model(), BAR, np.array([[1e-6]]), 0.3)
    assert grown.status is PoseStatus.HIGH_ERROR
    assert "clocks" in str(grown.reason)


def test_what_has_no_pose_stays_as_it_is() -> None:
    pose = ToolPose("tool", PoseStatus.MISSING, "nothing is seen", 0, 1)
    tool = RigidBody("tool", MARKERS, (0, 1, 2, 3))
    assert add_clock_errors_to_pose(pose, tool, model(), BAR, np.eye(1), 1.0) is pose
