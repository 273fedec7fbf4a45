"""A device's frames over REST: what connects them now, and the transforms between them."""

from typing import Any

import numpy as np
import pytest

from compute.pose.rigid_body import PoseStatus, ToolPose
from compute.transform import Transform, rotation_matrix
from service.pipeline.device_status import DeviceStatus
from tests.service.api.tools.batches import COVARIANCE, pose
from tests.service.api.tools.test_pose_query import AT, TURN, put, registered
from tests.service.api.tools.test_tools_api import PATIENT, POINTER, code, made
from tests.service.fake_pipeline import FakePipeline

URL = "/api/v1/devices/sim/frames"
OTHER = rotation_matrix(np.array([-0.2, 0.1, 0.4]))


@pytest.fixture
def tools(sqlite_client: Any) -> Any:
    assert made(sqlite_client, PATIENT).status_code == 201
    assert made(sqlite_client, POINTER).status_code == 201
    return sqlite_client


def listed(client: Any) -> dict[str, Any]:
    answer = client.get(URL)
    assert answer.status_code == 200, answer.text
    return {one["id"]: one for one in answer.json()["frames"]}


def between(client: Any, frame: str, to: str | None = None) -> Any:
    answer = client.get(f"{URL}/{frame}", params={} if to is None else {"to_frame_id": to})
    assert answer.status_code == 200, answer.text
    return answer.json()


def both(live: FakePipeline) -> None:
    put(live, pose("pointer", 7, TURN, AT), pose("patient", 7, OTHER, -AT))


def test_frames_and_what_they_are_connected_by(tools: Any, live: FakePipeline):
    registered(tools, reference_id="patient")
    registered(tools, id="room")
    both(live)
    answer = tools.get(URL).json()
    assert (answer["device_id"], answer["sequence"]) == ("sim", 7)
    assert (answer["calibration_id"], answer["table_id"]) == ("sim-nominal", None)
    assert answer["age_s"] >= 0.0
    frames = listed(tools)
    assert {name: (one["kind"], one["to_frame_id"]) for name, one in frames.items()} == {
        "tracker": ("tracker", None),
        "patient": ("tool", "tracker"),
        "pointer": ("tool", "tracker"),
        "ct": ("registration", "patient"),
        "room": ("registration", "tracker"),
    }
    assert all(one["connected"] and one["root_frame_id"] == "tracker" for one in frames.values())
    assert {one["status"] for one in frames.values()} == {"OK"}
    put(
        live,
        pose("pointer", 8, TURN, AT),
        ToolPose("patient", PoseStatus.MISSING, "1 of 4 markers was seen", 0, 8),
    )
    frames = listed(tools)
    assert (frames["patient"]["connected"], frames["patient"]["status"]) == (False, "MISSING")
    assert frames["patient"]["reason"] == "1 of 4 markers was seen"
    # The image still goes with the patient, wherever that is.
    assert (frames["ct"]["connected"], frames["ct"]["root_frame_id"]) == (True, "patient")
    assert frames["pointer"]["root_frame_id"] == "tracker"


def test_a_transform_over_all_of_the_way(tools: Any, live: FakePipeline):
    """From the pointer over the tracker and the patient to the image."""
    image = np.array(registered(tools, reference_id="patient")["matrix"])
    both(live)
    found = between(tools, "pointer", "ct")
    assert found["path_frame_ids"] == ["pointer", "tracker", "patient", "ct"]
    assert (found["status"], found["reason"], found["sequence"]) == ("OK", None, 7)
    own = Transform(TURN, AT, COVARIANCE)
    patient = Transform(OTHER, -AT, COVARIANCE)
    wanted = np.linalg.inv(image) @ patient.inverse().matrix @ own.matrix
    np.testing.assert_allclose(found["matrix"], wanted, atol=1e-9)
    np.testing.assert_allclose(found["rotation"], wanted[:3, :3], atol=1e-9)
    np.testing.assert_allclose(found["translation_mm"], wanted[:3, 3], atol=1e-9)
    # It is the pose of the tool in that frame, with its covariance.
    posed = tools.get("/api/v1/tools/pointer/pose", params={"frame_id": "ct"}).json()
    np.testing.assert_allclose(found["matrix"], posed["matrix"], atol=1e-9)
    np.testing.assert_allclose(found["covariance"], posed["covariance"], rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(found["quaternion_wxyz"], posed["quaternion_wxyz"], atol=1e-9)
    back = between(tools, "ct", "pointer")
    np.testing.assert_allclose(np.array(back["matrix"]) @ wanted, np.eye(4), atol=1e-9)
    assert back["path_frame_ids"] == found["path_frame_ids"][::-1]


def test_a_transform_to_the_tracker_and_to_itself(tools: Any, live: FakePipeline):
    both(live)
    found = between(tools, "pointer")
    assert (found["to_frame_id"], found["path_frame_ids"]) == ("tracker", ["pointer", "tracker"])
    np.testing.assert_allclose(found["covariance"], COVARIANCE, rtol=1e-9, atol=1e-18)
    same = between(tools, "pointer", "pointer")
    np.testing.assert_allclose(same["matrix"], np.eye(4))
    assert not np.array(same["covariance"]).any()


def test_it_is_worth_no_more_than_the_worst_of_its_poses(tools: Any, live: FakePipeline):
    put(
        live,
        pose("pointer", 7, TURN, AT),
        pose("patient", 7, OTHER, AT, PoseStatus.HIGH_ERROR, "its residual is 4"),
    )
    found = between(tools, "pointer", "patient")
    assert (found["status"], found["reason"]) == ("HIGH_ERROR", 'tool "patient": its residual is 4')
    assert found["matrix"] is not None
    assert between(tools, "pointer")["status"] == "OK"


def test_without_a_way_there_is_a_reason(tools: Any, live: FakePipeline):
    registered(tools, reference_id="patient")
    put(
        live,
        pose("pointer", 7, TURN, AT),
        ToolPose("patient", PoseStatus.OUT_OF_VIEW, "it left", 0, 7),
    )
    for frame, to in (("pointer", "ct"), ("ct", "pointer"), ("patient", "tracker")):
        found = between(tools, frame, to)
        assert (found["status"], found["reason"]) == ("OUT_OF_VIEW", 'tool "patient": it left')
        names = (
            "path_frame_ids",
            "matrix",
            "translation_mm",
            "rotation",
            "quaternion_wxyz",
            "covariance",
        )
        assert {found[name] for name in names} == {None}
    # What does not go over the patient's pose is there.
    assert between(tools, "ct", "patient")["status"] == "OK"
    put(live, pose("pointer", 7, TURN, AT), pose("patient", 7, OTHER, AT), age_s=3600.0)
    found = between(tools, "pointer")
    assert found["status"] == "MISSING"
    assert found["age_s"] >= 3600.0
    assert f"its last frame is {found['age_s']:.1f} s old" in found["reason"]


def test_in_the_world_of_another_calibration_there_is_none(tools: Any, live: FakePipeline):
    registered(tools)
    put(live, pose("pointer", 7, TURN, AT), calibration="moved")
    found = between(tools, "pointer", "ct")
    assert found["status"] == "INVALID"
    assert '"sim-nominal"' in found["reason"]
    assert '"moved"' in found["reason"]
    assert listed(tools)["ct"]["connected"] is False
    put(live, pose("pointer", 7, TURN, AT))
    assert between(tools, "pointer", "ct")["status"] == "OK"


def test_of_a_device_that_does_not_run(tools: Any, live: FakePipeline):
    registered(tools)
    live.states["sim"] = DeviceStatus("stopped")
    assert tools.get(URL).json()["exposure_ns"] is None
    found = between(tools, "pointer")
    assert found["status"] == "UNKNOWN"
    assert found["reason"] == 'tool "pointer": device "sim" is stopped'
    # A registration in the tracker's frame needs no pose.
    assert between(tools, "ct")["status"] == "OK"


def test_frames_that_there_are_not(tools: Any):
    assert code(tools.get("/api/v1/devices/nobody/frames")) == (404, "unknown-device")
    answer = tools.get(f"{URL}/nowhere")
    assert code(answer) == (404, "unknown-frame")
    assert '"tracker", "patient", "pointer"' in answer.json()["detail"]
    assert code(tools.get(f"{URL}/pointer", params={"to_frame_id": "nowhere"})) == (
        404,
        "unknown-frame",
    )
    assert code(tools.get(f"{URL}/No Slug")) == (422, "invalid-request")
