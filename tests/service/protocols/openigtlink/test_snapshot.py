"""What is sent of an entry of the board: relative poses, metadata, what is withheld."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compute.pose.rigid_body import PoseStatus, ToolPose
from compute.transform import rotation_matrix
from service.api.tools.frame_conversion import pose_in_frame
from service.api.tools.tip_limit import TipLimit
from service.protocols.openigtlink.host import WireTool
from service.protocols.openigtlink.message import BadMessage
from service.protocols.openigtlink.snapshot import FULL_NAME, Snapshot
from service.protocols.openigtlink.transforms import name_tools
from tests.service.protocols.openigtlink.readers import read_tdata, read_transform
from tests.service.protocols.openigtlink.test_client import entry, pose

REFERENCED = name_tools([WireTool("probe", "sim", "ref"), WireTool("ref", "sim")])
PLAIN = name_tools([WireTool("probe", "sim"), WireTool("ref", "sim")])

TIP_MM = np.array([-150.0, 20.0, 7.0])
_ROOT = np.random.default_rng(4).normal(size=(6, 6)) * ([[1e-3]] * 3 + [[0.2]] * 3)
COVARIANCE = _ROOT @ _ROOT.T
"""As poses have them: what a turn does and the shift are correlated."""

vectors = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)


def moved(tool: str, turn: np.ndarray, shift: np.ndarray, status: PoseStatus) -> ToolPose:
    return pose(
        tool, 0, status, rotation=rotation_matrix(turn), translation_mm=100.0 * shift,
        covariance=COVARIANCE, tip_mm=rotation_matrix(turn) @ TIP_MM + 100.0 * shift,
    )  # fmt: skip


STATUSES = st.sampled_from([PoseStatus.OK, PoseStatus.HIGH_ERROR, PoseStatus.OUT_OF_VOLUME])


shares = st.floats(0.5, 2.0).filter(lambda share: abs(share - 1.0) > 1e-9)
"""Of the tip's standard deviation; at the limit itself rounding decides."""


@given(vectors, vectors, vectors, vectors, STATUSES, STATUSES, shares)
def test_relative_poses_are_those_of_the_rest_side(turn, shift, other, away, first, second, share):
    probe, ref = moved("probe", turn, shift, first), moved("ref", other, away, second)
    tip = np.diag([0.01, 0.04, 0.09])
    spread = pose_in_frame(probe, ref, tip_covariance_mm2=tip).tip_covariance_mm2
    assert spread is not None
    most = share * float(np.sqrt(np.trace(spread)))
    limits = {"probe": TipLimit(most, tip)}
    found = Snapshot(entry(0, [probe, ref]), REFERENCED, limits=limits).poses[0]
    wanted = pose_in_frame(probe, ref, None, tip, most)
    assert found.tip_sd_mm == pytest.approx(most / share)
    assert (PoseStatus.HIGH_ERROR in (first, second) or share < 1.0) == (
        found.status is PoseStatus.HIGH_ERROR
    )
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


def test_a_relative_pose_above_the_limit_is_withheld():
    """Each pose is below the limit; the one relative to the other, by both together, is not."""
    at = pose("probe").translation_mm
    here = {"covariance": np.diag([0.0] * 3 + [0.1] * 3), "tip_mm": at}
    poses = [pose("probe", **here), pose("ref", **here)]
    limits = dict.fromkeys(("probe", "ref"), TipLimit(0.6))
    snapshot = Snapshot(entry(0, poses), REFERENCED, limits=limits)
    probe, ref = snapshot.poses
    assert (probe.status, ref.status) == (PoseStatus.HIGH_ERROR, PoseStatus.OK)
    assert (
        probe.reason == "the tip's standard deviation in this frame is 0.775 mm; 0.6 mm is the most"
    )
    sent = snapshot.messages("TRANSFORM", 2, invalid=False)
    assert [message.device for message in sent] == ["refToTracker"]
    marked = snapshot.messages("TRANSFORM", 2, invalid=True)[0]
    assert (marked.metadata["TransformStatus"], marked.metadata["TipSigmaMm"]) == (
        "HIGH_ERROR", "0.7746",
    )  # fmt: skip
    # In the tracker's frame it is good enough.
    assert [one.status for one in snapshot.poses_in("Tracker")] == [PoseStatus.OK, PoseStatus.OK]
    assert read_tdata(snapshot.tracking("TDATA", 1, "x", "ref").content) == ()
    wider = {"probe": TipLimit(0.8)}
    assert Snapshot(entry(0, poses), REFERENCED, limits=wider).poses[0].status is PoseStatus.OK


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_error_that_is_no_number_is_too_high(value: float):
    wrong = pose("probe", covariance=np.full((6, 6), value), tip_mm=np.zeros(3))
    snapshot = Snapshot(entry(0, [wrong]), PLAIN, limits={"probe": TipLimit(1.0)})
    assert snapshot.poses[0].status is PoseStatus.HIGH_ERROR


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
    spread = np.diag([1.0, 1.0, 1.0, 0.01, 0.02, 0.06])
    naming = name_tools([WireTool("a-pointer-of-a-long-name", "sim")])
    one = pose("a-pointer-of-a-long-name", 5)
    one = replace(one, covariance=spread, tip_mm=one.translation_mm)
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
