"""The newest pose over REST: in any frame, and with the reason where there is none."""

import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from compute.pose.rigid_body import PoseStatus, ToolPose
from compute.transform import rotation_matrix
from service.api.correction_tables import upload_process
from service.api.tools import pose_query
from service.api.tools.pose_query import STALE_S
from service.database.models import RegistrationRow
from service.pipeline.device_status import DeviceStatus
from service.pipeline.frame_batch import PoseEntry
from tests.service.api.correction_tables.tables import content
from tests.service.api.correction_tables.test_correction_tables import nominal_hash, send
from tests.service.api.tools.batches import pose
from tests.service.api.tools.test_tools_api import PATIENT, POINTER, code, made
from tests.service.fake_pipeline import FakePipeline

TURN = rotation_matrix(np.array([0.3, -0.4, 0.5]))
AT = np.array([100.0, -50.0, 1500.0])


def put(
    live: FakePipeline,
    *poses: ToolPose,
    age_s: float = 0.0,
    rate_hz: float = 100.0,
    calibration: str = "sim-nominal",
    table: str | None = None,
) -> None:
    now = time.time_ns() - int(age_s * 1e9)
    poses = tuple(replace(one, exposure_ns=now) for one in poses)
    by_name = {one.tool: one for one in poses}
    entry = PoseEntry("sim", 7, now, by_name, calibration, rate_hz, table_id=table)
    live.poses.put(entry)


def asked(client: Any, **query: str) -> Any:
    answer = client.get("/api/v1/tools/pointer/pose", params=query)
    assert answer.status_code == 200, answer.text
    return answer.json()


@pytest.fixture
def tools(sqlite_client: Any) -> Any:
    assert made(sqlite_client, PATIENT).status_code == 201
    assert made(sqlite_client, POINTER, reference_id="patient").status_code == 201
    return sqlite_client


def test_a_pose_in_the_trackers_frame(tools: Any, live: FakePipeline):
    put(live, pose("pointer", 7, TURN, AT))
    found = asked(tools, frame_id="tracker")
    assert (found["status"], found["reason"]) == ("OK", None)
    assert (found["tool_id"], found["device_id"], found["frame_id"]) == (
        "pointer",
        "sim",
        "tracker",
    )
    assert (found["sequence"], found["calibration_id"]) == (7, "sim-nominal")
    assert found["age_s"] >= 0.0
    np.testing.assert_allclose(found["translation_mm"], AT)
    np.testing.assert_allclose(found["rotation"], TURN, atol=1e-12)
    matrix = np.array(found["matrix"])
    np.testing.assert_allclose(matrix[:3, :3], TURN, atol=1e-12)
    np.testing.assert_allclose(matrix[:, 3], [*AT, 1.0])
    w, *xyz = found["quaternion_wxyz"]
    angle = np.linalg.norm([0.3, -0.4, 0.5])
    assert w == pytest.approx(np.cos(angle / 2))
    np.testing.assert_allclose(xyz, np.sin(angle / 2) / angle * np.array([0.3, -0.4, 0.5]))
    np.testing.assert_allclose(found["tip_mm"], TURN @ [-150, 0, 0] + AT)
    assert np.array(found["covariance"]).shape == (6, 6)


def test_a_clock_that_is_set_back_makes_no_pose_young(tools: Any, live: FakePipeline):
    put(live, pose("pointer", 7, TURN, AT))
    assert asked(tools, frame_id="tracker")["status"] == "OK"
    entry = live.poses.newest()["sim"]
    # A thousand seconds later by the clock that runs evenly, an hour earlier by the wall's.
    late = entry.poses["pointer"].exposure_ns + 3600 * 10**9
    late_pose = replace(entry.poses["pointer"], exposure_ns=late)
    live.poses.put(
        replace(
            entry,
            arrived_s=entry.arrived_s - 1000.0,
            exposure_ns=late,
            poses={"pointer": late_pose},
        )
    )
    found = asked(tools, frame_id="tracker")
    assert found["status"] == "MISSING"
    assert "its last frame is 1" in found["reason"]
    assert found["matrix"] is None
    assert 1000.0 <= found["age_s"] < 3600.0


def test_by_default_relative_to_its_reference(tools: Any, live: FakePipeline):
    put(live, pose("pointer", 7, TURN, AT), pose("patient", 7, TURN, AT - TURN @ [10.0, 0.0, 0.0]))
    found = asked(tools)
    assert found["frame_id"] == "patient"
    np.testing.assert_allclose(found["rotation"], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(found["translation_mm"], [10.0, 0.0, 0.0], atol=1e-9)
    lost = ToolPose("patient", PoseStatus.MISSING, "1 of 4 markers was seen", 0, 7)
    put(live, pose("pointer", 7, TURN, AT), lost)
    found = asked(tools)
    assert found["status"] == "MISSING"
    assert found["reason"] == 'its reference "patient": 1 of 4 markers was seen'
    assert found["matrix"] is found["translation_mm"] is found["covariance"] is None
    assert asked(tools, frame_id="tracker")["status"] == "OK"


def test_in_the_frame_of_an_image(tools: Any, live: FakePipeline):
    """The image lies 500 mm beside the patient's reference, turned by 90 degrees about Z."""
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    image = np.array([[0, 0, 0], [100, 0, 0], [0, 100, 0], [0, 0, 100]], float)
    measured = image @ turn.T + [500.0, 0.0, 0.0]
    pairs = [
        {"name": str(n), "frame_mm": one.tolist(), "measured_mm": other.tolist()}
        for n, (one, other) in enumerate(zip(image, measured, strict=True))
    ]
    request = {
        "id": "ct", "device_id": "sim", "reference_id": "patient", "fiducials": pairs,
        "measured_sigma_mm": 0.01,
    }  # fmt: skip
    answer = tools.post("/api/v1/registrations", json=request)
    assert answer.status_code == 201, answer.text
    # The tip is at the image's (10, 20, 30), wherever the patient is.
    at = TURN @ (turn @ [10.0, 20.0, 30.0] + [500.0, 0.0, 0.0]) + AT
    pointer = pose("pointer", 7, TURN, at - TURN @ [-150.0, 0.0, 0.0])
    put(live, pointer, pose("patient", 7, TURN, AT))
    found = asked(tools, frame_id="ct")
    assert (found["frame_id"], found["status"]) == ("ct", "OK")
    np.testing.assert_allclose(found["tip_mm"], [10.0, 20.0, 30.0], atol=1e-6)
    refused = tools.delete("/api/v1/tools/patient")
    assert code(refused) == (409, "tool-in-use")
    assert tools.delete("/api/v1/registrations/ct").status_code == 204
    gone = tools.get("/api/v1/tools/pointer/pose", params={"frame_id": "ct"})
    assert code(gone) == (404, "unknown-tool")


def test_a_stale_pose_is_none(tools: Any, live: FakePipeline, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(pose_query, "STALE_S", STALE_S)
    put(live, pose("pointer", 7, TURN, AT), age_s=1.5)
    found = asked(tools, frame_id="tracker")
    assert found["status"] == "MISSING"
    assert found["reason"] == f"its last frame is {found['age_s']:.1f} s old"
    assert found["translation_mm"] is None
    assert found["age_s"] >= 1.5
    # Of a device with a frame every 1000 s it is the newest.
    put(live, pose("pointer", 7, TURN, AT), age_s=3600.0, rate_hz=0.001)
    assert asked(tools, frame_id="tracker")["status"] == "OK"


def test_without_frames_the_reason_is_the_devices(tools: Any, live: FakePipeline):
    live.states["sim"] = DeviceStatus("stopped")
    found = asked(tools, frame_id="tracker")
    assert (found["status"], found["reason"]) == ("UNKNOWN", 'device "sim" is stopped')
    assert found["exposure_ns"] is found["age_s"] is found["sequence"] is None
    live.states["sim"] = DeviceStatus("disconnected", "its cable is out")
    assert (
        asked(tools, frame_id="tracker")["reason"]
        == 'device "sim" is disconnected: its cable is out'
    )
    live.states["sim"] = DeviceStatus("running")
    assert "has not sent a frame" in asked(tools, frame_id="tracker")["reason"]
    put(live, pose("patient", 7, TURN, AT))
    assert asked(tools, frame_id="tracker")["reason"] == "the device does not track it yet"
    assert asked(tools)["status"] == "UNKNOWN"


def test_a_frame_that_there_is_not(tools: Any):
    for frame, expected in (
        ("nothing", (404, "unknown-tool")),
        ("pointer", (422, "invalid-parameter")),
        ("No Slug", (422, "invalid-request")),
    ):
        answer = tools.get("/api/v1/tools/pointer/pose", params={"frame_id": frame})
        assert code(answer) == expected
    assert code(tools.get("/api/v1/tools/nothing/pose")) == (404, "unknown-tool")


def registered(client: Any, **members: Any) -> Any:
    points = [[0, 0, 0], [100, 0, 0], [0, 100, 0], [0, 0, 100]]
    pairs = [{"name": str(n), "frame_mm": one, "measured_mm": one} for n, one in enumerate(points)]
    request = {"id": "ct", "device_id": "sim", "fiducials": pairs, "measured_sigma_mm": 0.01}
    answer = client.post("/api/v1/registrations", json=request | members)
    assert answer.status_code == 201, answer.text
    return answer.json()


def test_a_frame_in_the_world_of_another_calibration_is_none(tools: Any, live: FakePipeline):
    assert registered(tools)["calibration_id"] == "sim-nominal"
    assert tools.get("/api/v1/registrations/ct").json()["calibration_id"] == "sim-nominal"
    close = TURN @ np.array([150.0, 0.0, 0.0])
    put(live, pose("pointer", 7, TURN, close), pose("patient", 7, TURN, close))
    assert asked(tools, frame_id="ct")["status"] == "OK"
    put(live, pose("pointer", 8, TURN, close), calibration="moved")
    found = asked(tools, frame_id="ct")
    assert (found["status"], found["sequence"]) == ("INVALID", 8)
    assert '"sim-nominal"' in found["reason"]
    assert '"moved"' in found["reason"]
    assert found["matrix"] is found["translation_mm"] is found["tip_mm"] is None
    # In the frame of the new calibration there is a pose, and again with the old one.
    assert asked(tools, frame_id="tracker")["status"] == "OK"
    put(live, pose("pointer", 9, TURN, close))
    assert asked(tools, frame_id="ct")["status"] == "OK"


def test_a_frame_that_goes_with_a_tool_outlives_the_calibration(tools: Any, live: FakePipeline):
    registered(tools, reference_id="patient")
    at = TURN @ np.array([150.0, 0.0, 0.0])
    poses = pose("pointer", 7, TURN, at), pose("patient", 7, TURN, at)
    put(live, *poses, calibration="moved")
    assert asked(tools, frame_id="ct")["status"] == "OK"


@pytest.mark.parametrize("reference", [None, "patient"])
def test_a_frame_that_was_measured_with_another_table_is_none(
    tools: Any, live: FakePipeline, reference: str | None
):
    """What a table corrects moves points, those of a reference tool by another amount."""
    assert registered(tools, reference_id=reference)["table_id"] is None
    at = TURN @ np.array([150.0, 0.0, 0.0])
    poses = pose("pointer", 7, TURN, at), pose("patient", 7, TURN, at)
    put(live, *poses)
    assert asked(tools, frame_id="ct")["status"] == "OK"
    put(live, *poses, table="map")
    found = asked(tools, frame_id="ct")
    assert (found["status"], found["table_id"]) == ("INVALID", "map")
    assert 'registration "ct" was measured without a correction table, and "map"' in found["reason"]
    assert found["matrix"] is found["translation_mm"] is found["tip_mm"] is None
    assert asked(tools, frame_id="tracker")["status"] == "OK"
    put(live, *poses)
    assert asked(tools, frame_id="ct")["status"] == "OK"


def test_a_frame_knows_the_table_that_it_was_measured_with(
    tools: Any, live: FakePipeline, monkeypatch: pytest.MonkeyPatch
):
    here = lambda function, data, **_: function(lambda *_: None, data)  # noqa: E731
    monkeypatch.setattr(upload_process, "call_in_process", here)
    assert send(tools, content(nominal_hash(tools)), id="map").status_code == 201
    assert tools.post("/api/v1/correction-tables/map/activate").status_code == 200
    assert registered(tools)["table_id"] == "map"
    close = TURN @ np.array([150.0, 0.0, 0.0])
    put(live, pose("pointer", 7, TURN, close), table="map")
    assert asked(tools, frame_id="ct")["status"] == "OK"
    put(live, pose("pointer", 7, TURN, close))
    found = asked(tools, frame_id="ct")
    assert found["status"] == "INVALID"
    assert 'with correction table "map", and none is active' in found["reason"]
    # One that was stored before tables were kept: the history of activations tells.
    with tools.app.state.database.write() as session:
        row = session.get(RegistrationRow, "ct")
        members = {name: getattr(row, name) for name in RegistrationRow.__table__.c.keys()}  # noqa: SIM118
        members["result"] = {k: value for k, value in row.result.items() if k != "table"}
        session.add(RegistrationRow(**members | {"id": "older"}))
    assert 'with correction table "map"' in asked(tools, frame_id="older")["reason"]
    put(live, pose("pointer", 7, TURN, close), table="map")
    assert asked(tools, frame_id="older")["status"] == "OK"


def test_the_limit_holds_in_the_frame_that_is_asked_for(tools: Any, live: FakePipeline):
    """The reference is 1.5 m away, and known to 0.2 mrad: 0.4 mm at the pointer's tip."""
    put(live, pose("pointer", 7, TURN, AT), pose("patient", 7, TURN, np.zeros(3)))
    assert asked(tools)["status"] == "OK"  # the default is 1 mm
    change = tools.patch("/api/v1/tools/pointer", json={"limits": {"tip_sd_mm": 0.2}})
    assert change.status_code == 200, change.text
    found = asked(tools)
    assert found["status"] == "HIGH_ERROR"
    sd = float(np.sqrt(np.trace(found["tip_covariance_mm2"])))
    assert f"{sd:.3g} mm; 0.2 mm" in found["reason"]
    assert asked(tools, frame_id="tracker")["status"] == "OK"
    tools.patch("/api/v1/tools/pointer", json={"limits": {}})
    assert asked(tools)["status"] == "OK"
    tools.patch("/api/v1/devices/sim", json={"tracking": {"tool_tip_sd_mm": 0.2}})
    assert asked(tools)["status"] == "HIGH_ERROR"
