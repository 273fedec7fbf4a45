"""World frame of a self-calibration."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from compute.calibration.bundle_adjustment.gauge import transform_world
from compute.calibration.bundle_adjustment.pose_set import PoseSet
from compute.calibration.bundle_adjustment.solver import adjust
from compute.calibration.bundle_adjustment.target_shape import body_shape
from compute.calibration.self_calibration.datum import (
    align_to_start,
    to_first_pose_frame,
    to_start_frame,
)
from compute.camera.stack import CameraStack
from tests.compute.calibration.bundle_adjustment.scenes import posed
from tests.compute.calibration.self_calibration.scenes import BODY
from tests.compute.rig import control_points, rig


def test_first_pose_s_frame_is_that_of_its_markers_as_control_points() -> None:
    """The same solution and covariance as with the first pose's markers known exactly."""
    shape = body_shape(BODY)
    poses = posed(shape, 12, np.random.default_rng(3), rig())
    free = adjust(rig(), [poses], free_datum=True)
    origin = BODY.mean(axis=0)
    placed = to_first_pose_frame(free, origin)
    markers = placed.pose_sets[0].marker_positions()
    assert markers[0] == pytest.approx(BODY, abs=1e-9)
    known = PoseSet.points(
        BODY,
        poses.readings_px[0],
        poses.sigma_px[0],
        BODY,
        np.broadcast_to(1e-10 * np.eye(3), (4, 3, 3)),
    )
    moved = placed.pose_sets[0]
    rest = PoseSet(
        shape,
        moved.translation_mm[1:],
        moved.rotation[1:],
        moved.readings_px[1:],
        moved.sigma_px[1:],
    )
    held = adjust(placed.models, [known, rest])
    expected = np.sqrt(np.diagonal(held.sensor_covariance))
    assert np.sqrt(np.diagonal(placed.covariance)) == pytest.approx(expected, rel=1e-3)
    away = (placed.covariance - held.sensor_covariance) / np.outer(expected, expected)
    assert away == pytest.approx(0.0, abs=2e-3)


def test_start_s_frame_is_found_from_anywhere() -> None:
    """Cameras and cloud turned away together come back to where the start has them."""
    poses = posed(body_shape(BODY), 10, np.random.default_rng(4), rig(), noise_px=0.0)
    turn = Rotation.from_rotvec([0.1, -0.2, 0.15]).as_matrix()
    shift = np.array([40.0, -20.0, 60.0])
    away = adjust(rig(), [poses], free_datum=True)
    start = tuple(align_to_start(away.models, rig()))
    placed = to_start_frame(away, start)
    points = control_points(10)
    assert CameraStack.of(placed.models).project(points) == pytest.approx(
        CameraStack.of(rig()).project(points), abs=1e-5
    )
    elsewhere = [transform_world(model, turn, shift) for model in rig()]
    back = align_to_start(elsewhere, rig())
    assert CameraStack.of(back).project(points) == pytest.approx(
        CameraStack.of(rig()).project(points), abs=1e-6
    )
