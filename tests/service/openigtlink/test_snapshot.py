"""What is sent of an entry of the board: relative poses, metadata, what is withheld."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compute.camera.rotation import rotation_matrix
from compute.pose.tool_pose import PoseStatus, ToolPose
from service.openigtlink.errors import BadMessage
from service.openigtlink.host import WireTool
from service.openigtlink.names import name_tools
from service.openigtlink.pose_contents import read_tdata, read_transform
from service.openigtlink.snapshot import FULL_NAME, Snapshot
from service.tools.frames import in_frame
from tests.service.openigtlink.wire import entry, pose

REFERENCED = name_tools([WireTool("probe", "sim", "ref"), WireTool("ref", "sim")])
PLAIN = name_tools([WireTool("probe", "sim"), WireTool("ref", "sim")])

vectors = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)


def moved(tool: str, turn: np.ndarray, shift: np.ndarray, status: PoseStatus) -> ToolPose:
    return pose(
        tool, 0, status, rotation=rotation_matrix(turn), translation_mm=100.0 * shift,
        covariance=np.eye(6),
    )  # fmt: skip


STATUSES = st.sampled_from([PoseStatus.OK, PoseStatus.HIGH_ERROR, PoseStatus.OUT_OF_VOLUME])


@given(vectors, vectors, vectors, vectors, STATUSES, STATUSES)
def test_relative_poses_are_those_of_the_rest_side(turn, shift, other, away, first, second):
    probe, ref = moved("probe", turn, shift, first), moved("ref", other, away, second)
    found = Snapshot(entry(0, [probe, ref]), REFERENCED).poses[0]
    wanted = in_frame(probe, ref)
    assert found.status is wanted.status
    assert found.placed is not None
    assert wanted.rotation is not None
    assert found.placed[0] == pytest.approx(wanted.rotation, abs=1e-12)
    assert found.placed[1] == pytest.approx(wanted.translation_mm, abs=1e-9)


@pytest.mark.parametrize("status", [PoseStatus.MISSING, PoseStatus.OUT_OF_VIEW, PoseStatus.INVALID])
def test_without_its_reference_a_tool_has_no_pose(status: PoseStatus):
    given_poses = [pose("probe"), pose("ref", status=status)]
    found = Snapshot(entry(0, given_poses), REFERENCED).poses[0]
    assert (found.status, found.placed) == (status, None)
    assert found.reason is not None
    assert '"ref"' in found.reason
    alone = Snapshot(entry(0, given_poses[:1]), REFERENCED).poses[0]
    assert (alone.status, alone.placed) == (PoseStatus.MISSING, None)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e39])
def test_a_pose_that_float32_does_not_hold_is_none(value: float):
    for wrong in (
        pose("probe", translation_mm=np.array([0.0, value, 0.0])),
        pose("probe", rotation=np.diag([1.0, value, 1.0])),
    ):
        found = Snapshot(entry(0, [wrong]), PLAIN).poses[0]
        assert (found.status, found.placed) == (PoseStatus.INVALID, None)


def test_a_status_of_ok_without_a_pose_is_not_ok():
    found = Snapshot(entry(0, [pose("probe", rotation=None)]), PLAIN).poses[0]
    assert (found.status, found.placed) == (PoseStatus.MISSING, None)


def test_invalid_poses_are_withheld_unless_marked_ones_are_wanted():
    poses = [pose("probe", status=PoseStatus.HIGH_ERROR), pose("ref", status=PoseStatus.MISSING)]
    snapshot = Snapshot(entry(0, poses), PLAIN)
    for version in (1, 2):
        assert snapshot.messages("TRANSFORM", version, invalid=False) == []
        assert snapshot.encoded("POSITION", version, invalid=False) == b""
    # Version 1 has no place for the mark.
    assert snapshot.messages("TRANSFORM", 1, invalid=True) == []
    (marked,) = snapshot.messages("TRANSFORM", 2, invalid=True)
    assert marked.metadata["TransformValid"] == "0"
    assert marked.metadata["TransformStatus"] == "HIGH_ERROR"
    assert marked.metadata["TransformReason"] == "probe is HIGH_ERROR"


def test_metadata():
    spread = np.diag([0.01, 0.02, 0.06])
    naming = name_tools([WireTool("a-pointer-of-a-long-name", "sim")])
    one = replace(pose("a-pointer-of-a-long-name", 5), tip_covariance_mm2=spread)
    snapshot = Snapshot(entry(5, [one]), naming)
    (message,) = snapshot.messages("TRANSFORM", 2, invalid=False)
    late = float(message.metadata["LatencyMs"])
    assert late > 0.0
    assert dict(message.metadata) == {
        "TransformValid": "1",
        "TransformStatus": "OK",
        "MarkersUsed": "4",
        FULL_NAME: "a-pointer-of-a-long-nameToTracker",
        "ResidualSigma": "1.25",
        "TipSigmaMm": "0.3",
        "FrameNumber": "5",
        "LatencyMs": message.metadata["LatencyMs"],
    }
    assert (message.number, message.time_ns) == (5, one.exposure_ns)
    (plain,) = snapshot.messages("TRANSFORM", 1, invalid=False)
    assert plain.metadata == {}
    assert read_transform(plain.content)[1].tolist() == [5.0, 24.0, -7.5]


def test_frames_of_tdata():
    snapshot = Snapshot(entry(3), REFERENCED)
    own = read_tdata(snapshot.tracking("TDATA", 1, "x", "").content)
    world = read_tdata(snapshot.tracking("TDATA", 1, "x", "Tracker").content)
    assert [tool.name for tool in own] == ["probeToRef", "refToTracker"]
    assert world[0].translation_mm.tolist() == [3.0, 5.0, -7.5]
    for name in ("ref", "Ref"):
        (relative,) = read_tdata(snapshot.tracking("TDATA", 1, "x", name).content)
        assert np.array_equal(relative.rotation, own[0].rotation)
        assert np.array_equal(relative.translation_mm, own[0].translation_mm)
    with pytest.raises(BadMessage, match="Tracker, Probe, Ref"):
        snapshot.tracking("TDATA", 1, "x", "Ras")


def test_tools_that_are_not_seen_are_not_in_tdata():
    snapshot = Snapshot(entry(3, [pose("probe", 3), pose("ref", 3, PoseStatus.MISSING)]), PLAIN)
    message = snapshot.tracking("TDATA", 2, "x", "")
    assert [tool.name for tool in read_tdata(message.content)] == ["probeToTracker"]
    assert message.metadata["refToTrackerStatus"] == "MISSING"
