"""Poses in other frames: the algebra of the motions, and of their uncertainty."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compute.pose.rigid_body import PoseStatus, ToolPose
from compute.transform import Transform, rotation_matrix, rotation_vector
from service.api.tools.frame_conversion import pose_in_frame

vector = st.tuples(*[st.floats(-2.0, 2.0)] * 3).map(np.array)
place = st.tuples(*[st.floats(-2000.0, 2000.0)] * 3).map(np.array)
TIP = np.array([-150.0, 10.0, 5.0])


def spread(seed: int) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(6, 6)) * np.array([[1e-4] * 3 + [0.02] * 3]).T
    return root @ root.T


def pose(
    name: str, turn: np.ndarray, at: np.ndarray, seed: int = 0, status: PoseStatus = PoseStatus.OK
) -> ToolPose:
    rotation = rotation_matrix(turn)
    reason = None if status is PoseStatus.OK else f"{name} is {status}"
    return ToolPose(
        name, status, reason, 123, 4, rotation, at, spread(seed), rotation @ TIP + at,
        np.eye(3), 1.1, 4, 16, np.ones(3), np.ones(3),
    )  # fmt: skip


def matrix(one: ToolPose) -> np.ndarray:
    return one.transform().matrix


@given(turn=vector, at=place, ref_turn=vector, ref_at=place, frame_turn=vector, frame_at=place)
def test_the_motions_are_chained(
    turn: np.ndarray,
    at: np.ndarray,
    ref_turn: np.ndarray,
    ref_at: np.ndarray,
    frame_turn: np.ndarray,
    frame_at: np.ndarray,
):
    tool, reference = pose("tool", turn, at), pose("ref", ref_turn, ref_at)
    frame = Transform.from_rotation_vector(frame_turn, frame_at)
    found = pose_in_frame(tool, reference, frame)
    expected = frame.matrix @ np.linalg.inv(matrix(reference)) @ matrix(tool)
    np.testing.assert_allclose(matrix(found), expected, atol=1e-8)
    assert found.tip_mm is not None
    np.testing.assert_allclose(found.tip_mm, (expected @ [*TIP, 1.0])[:3], atol=1e-8)
    assert (found.tool, found.sequence, found.exposure_ns, found.markers_used) == (
        "tool", 4, 123, 4,
    )  # fmt: skip
    assert found.velocity_mm_s is None


@pytest.mark.slow
def test_the_uncertainty_is_that_of_errors_of_both():
    """Against the spread of thousands of poses that err as the covariances say."""
    rng = np.random.default_rng(3)
    turn, at = np.array([0.3, -0.5, 0.9]), np.array([100.0, -50.0, 1500.0])
    ref_turn, ref_at = np.array([-0.7, 0.2, 0.1]), np.array([-60.0, 80.0, 1400.0])
    tool, reference = pose("tool", turn, at, 1), pose("ref", ref_turn, ref_at, 2)
    right = pose_in_frame(tool, reference)

    def erring(one: ToolPose) -> ToolPose:
        assert one.rotation is not None
        assert one.translation_mm is not None
        assert one.covariance is not None
        error = rng.multivariate_normal(np.zeros(6), one.covariance)
        rotation = rotation_matrix(error[:3]) @ one.rotation
        moved = one.translation_mm + error[3:]
        return ToolPose(
            one.tool, one.status, None, 0, 0, rotation, moved, one.covariance,
            rotation @ TIP + moved, np.eye(3),
        )  # fmt: skip

    errors, tips = [], []
    for _ in range(4000):
        found = pose_in_frame(erring(tool), erring(reference))
        turned = rotation_vector(found.rotation @ right.rotation.T)
        errors.append(np.concatenate([turned, found.translation_mm - right.translation_mm]))
        tips.append(found.tip_mm - right.tip_mm)
    for seen, stated in ((errors, right.covariance), (tips, right.tip_covariance_mm2)):
        # Whitened by what is stated, the errors have unit covariance, each element to 1/sqrt(N).
        white = np.linalg.solve(np.linalg.cholesky(stated), np.array(seen).T)
        np.testing.assert_allclose(np.cov(white), np.eye(len(white)), atol=6.0 / np.sqrt(4000))


def test_the_tip_is_known_no_better_than_in_the_tool():
    tool = pose("tool", np.zeros(3), np.zeros(3))
    exact = pose_in_frame(tool)
    known = pose_in_frame(tool, tip_covariance_mm2=np.diag([4.0, 1.0, 0.0]))
    assert exact.tip_covariance_mm2 is not None
    assert known.tip_covariance_mm2 is not None
    np.testing.assert_allclose(
        known.tip_covariance_mm2 - exact.tip_covariance_mm2, np.diag([4.0, 1.0, 0.0]), atol=1e-12
    )


@pytest.mark.parametrize(
    ("own", "others", "expected"),
    [
        (PoseStatus.OK, PoseStatus.OK, PoseStatus.OK),
        (PoseStatus.OK, PoseStatus.HIGH_ERROR, PoseStatus.HIGH_ERROR),
        (PoseStatus.HIGH_ERROR, PoseStatus.OUT_OF_VOLUME, PoseStatus.HIGH_ERROR),
        (PoseStatus.OUT_OF_VOLUME, PoseStatus.OK, PoseStatus.OUT_OF_VOLUME),
    ],
)
def test_a_relative_pose_is_worth_no_more_than_either(
    own: PoseStatus, others: PoseStatus, expected: PoseStatus
):
    found = pose_in_frame(
        pose("tool", np.zeros(3), np.zeros(3), status=own),
        pose("ref", np.zeros(3), np.zeros(3), status=others),
    )
    assert found.status is expected
    assert found.rotation is not None
    if others is expected and own is not expected:
        assert found.reason == f'its reference "ref": ref is {others}'


@pytest.mark.parametrize("status", [PoseStatus.MISSING, PoseStatus.INVALID, PoseStatus.OUT_OF_VIEW])
def test_without_its_reference_there_is_no_pose(status: PoseStatus):
    lost = ToolPose("ref", status, "nothing was seen", 123, 4)
    found = pose_in_frame(pose("tool", np.zeros(3), np.zeros(3)), lost)
    assert (found.status, found.reason) == (status, 'its reference "ref": nothing was seen')
    assert found.rotation is None
    assert found.tip_mm is None
    # One that is lost itself says so, whatever its reference does.
    own = pose_in_frame(ToolPose("tool", PoseStatus.OUT_OF_VIEW, "it left", 123, 4), lost)
    assert (own.status, own.reason) == (PoseStatus.OUT_OF_VIEW, "it left")


def test_the_limit_judges_the_tip_in_the_frame():
    """A reference that is well known, and far away: its turn moves the tip by more."""
    tool = pose("tool", np.zeros(3), np.zeros(3))
    far = pose("ref", np.zeros(3), np.array([1500.0, 0.0, 0.0]))

    def sd(one: ToolPose) -> float:
        assert one.tip_covariance_mm2 is not None
        return float(np.sqrt(np.trace(one.tip_covariance_mm2)))

    alone, relative = sd(pose_in_frame(tool)), sd(pose_in_frame(tool, far))
    limit = (alone + relative) / 2
    assert alone < limit < relative
    assert pose_in_frame(tool, max_tip_sd_mm=limit).status is PoseStatus.OK
    found = pose_in_frame(tool, far, max_tip_sd_mm=limit)
    assert found.status is PoseStatus.HIGH_ERROR
    assert found.reason is not None
    assert f"{relative:.3g} mm; {limit:.3g} mm" in found.reason
    assert found.rotation is not None
    assert pose_in_frame(tool, far, max_tip_sd_mm=relative * 1.001).status is PoseStatus.OK
    # What is worth less already keeps its reason; so does what is not seen.
    bad = pose_in_frame(
        pose("tool", *[np.zeros(3)] * 2, status=PoseStatus.HIGH_ERROR), far, None, None, limit
    )
    assert (bad.status, bad.reason) == (PoseStatus.HIGH_ERROR, "tool is HIGH_ERROR")
    outside = pose_in_frame(
        pose("tool", *[np.zeros(3)] * 2, status=PoseStatus.OUT_OF_VOLUME), far, None, None, limit
    )
    assert outside.status is PoseStatus.HIGH_ERROR
