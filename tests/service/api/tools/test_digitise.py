"""Points measured with a pointer's tip: where it is held still, in any frame, or why not."""

from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from compute.pose.rigid_body import PoseStatus, ToolPose
from compute.transform import rotation_matrix
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.settings import SimulationSettings
from service.api.tools import concurrency_limits
from tests.service.api.tools.batches import PIVOT_MM, pivoting, pose, resting, tool_batch
from tests.service.api.tools.test_capture_and_calibration import IMAGE, registration
from tests.service.api.tools.test_pose_query import registered
from tests.service.api.tools.test_tools_api import PATIENT, POINTER, code, made
from tests.service.fake_pipeline import FakePipeline

URL = "/api/v1/tools/pointer/points"
Poses = list[ToolPose]


@pytest.fixture
def running(live: FakePipeline) -> FakePipeline:
    live.records = SimulatedDriver("sim", SimulationSettings()).description
    return live


@pytest.fixture
def pointer(sqlite_client: Any, running: FakePipeline) -> Any:
    assert made(sqlite_client, PATIENT).status_code == 201
    assert made(sqlite_client, POINTER).status_code == 201
    return sqlite_client


def asked(client: Any, **body: Any) -> Any:
    answer = client.post(URL, json=body)
    assert answer.status_code == 200, answer.text
    return answer.json()


def test_a_point_is_the_mean_of_a_still_tip(pointer: Any, running: FakePipeline):
    running.batches = [tool_batch([resting("pointer", 700)])]
    found = asked(pointer, name="nasion")
    assert (found["name"], found["tool_id"], found["device_id"]) == ("nasion", "pointer", "sim")
    assert (found["frame_id"], found["calibration_id"], found["table_id"]) == (
        "tracker",
        "sim-nominal",
        None,
    )
    assert found["tool_calibration_id"] is None
    covariance = np.array(found["covariance_mm2"])
    error = np.array(found["position_mm"]) - PIVOT_MM
    assert error @ np.linalg.solve(covariance, error) < 30.0
    assert 0.0 < found["sigma_mm"] < 0.15
    # Half a second of a thousand frames a second, from when it was first looked at.
    assert 500 <= found["frames"] <= 552
    assert found["last_ns"] - found["first_ns"] >= 500_000_000
    # Nothing of it is kept.
    entries = pointer.get("/api/v1/audit", params={"limit": 1}).json()["items"]
    assert entries[0]["operation"] == "create-tool"


def test_the_tips_own_covariance_counts(pointer: Any, running: FakePipeline):
    """A tip from a pivot calibration of a tilted pointer: its error is in every place alike."""
    running.batches = [tool_batch([pivoting("pointer", 300)])]
    calibrated = pointer.post("/api/v1/tools/pointer/pivot-calibrations", json={"duration_s": 0.02})
    assert calibrated.status_code == 201, calibrated.text
    spread = np.array(calibrated.json()["tip_covariance_mm2"])
    running.batches = [tool_batch([resting("pointer", 700)])]
    found = asked(pointer)
    assert found["tool_calibration_id"] == calibrated.json()["id"]
    turn = rotation_matrix(np.array([0.3, -0.4, 0.5]))
    least = np.linalg.eigvalsh(np.array(found["covariance_mm2"]) - turn @ spread @ turn.T)[0]
    assert least > 0.0


def test_it_waits_until_the_tip_rests(pointer: Any, running: FakePipeline):
    step = np.array([0.2, 0.0, 0.0])
    coming = [
        moved
        for n in range(300)
        for moved in resting("pointer", 1, n, PIVOT_MM + (299 - n) * step, seed=n)
    ]
    running.batches = [tool_batch([coming]), tool_batch([resting("pointer", 700, first=300)])]
    found = asked(pointer)
    np.testing.assert_allclose(found["position_mm"], PIVOT_MM, atol=0.3)
    # Of the way no more is in it than the limits let through.
    assert found["first_ns"] > 280_000_000


@pytest.mark.slow
def test_relative_to_the_patient_who_moves(pointer: Any, running: FakePipeline):
    tip, patient = [], []
    for n, one in enumerate(resting("pointer", 700)):
        turn = rotation_matrix(np.array([0.0, 0.0, 0.2 * n / 700]))
        assert one.rotation is not None
        assert one.translation_mm is not None
        assert one.tip_mm is not None
        moved = replace(
            one,
            rotation=turn @ one.rotation,
            translation_mm=turn @ one.translation_mm,
            tip_mm=turn @ one.tip_mm,
        )
        tip.append(moved)
        patient.append(pose("patient", n, turn, np.zeros(3)))
    running.batches = [tool_batch([tip, patient])]
    # The reference is 1.5 m from the tip: its turns, known to 0.2 mrad, are 0.4 mm there.
    wide = {"max_sigma_mm": 1.0, "duration_s": 0.3}
    found = asked(pointer, frame_id="patient", **wide)
    assert found["frame_id"] == "patient"
    np.testing.assert_allclose(found["position_mm"], PIVOT_MM, atol=0.1)
    assert np.sqrt(np.trace(found["covariance_mm2"])) > 0.3
    # By default relative to the tool's reference.
    pointer.patch("/api/v1/tools/pointer", json={"reference_id": "patient"})
    assert asked(pointer, **wide)["frame_id"] == "patient"
    refused = pointer.post(URL, json={"frame_id": "tracker", "timeout_s": 0.05})
    assert code(refused) == (422, "not-stationary"), refused.text
    assert "0.05 s" in refused.json()["detail"]


@pytest.mark.slow
def test_points_make_a_registration_as_they_stand(pointer: Any, running: FakePipeline):
    turn, at = rotation_matrix(np.array([0.2, -0.3, 1.0])), np.array([50.0, 60.0, 1500.0])
    fiducials = []
    for number, place in enumerate(IMAGE):
        running.batches = [
            tool_batch([resting("pointer", 700, at_mm=turn @ place + at, seed=number)])
        ]
        found = asked(pointer, name=f"F{number}", frame_id="tracker")
        fiducials.append(
            {
                "name": found["name"],
                "frame_mm": place.tolist(),
                "measured_mm": found["position_mm"],
                "measured_covariance_mm2": found["covariance_mm2"],
            }
        )
    body = {"id": "ct", "device_id": "sim", "fiducials": fiducials}
    answer = pointer.post("/api/v1/registrations", json=body)
    assert answer.status_code == 201, answer.text
    matrix = np.array(answer.json()["matrix"])
    np.testing.assert_allclose(matrix[:3, 3], at, atol=0.1)
    np.testing.assert_allclose(matrix[:3, :3], turn, atol=1e-3)
    # In its frame the tip is where the fiducial is.
    inside = asked(pointer, frame_id="ct")
    np.testing.assert_allclose(inside["position_mm"], IMAGE[-1], atol=0.1)


def lost(count: int) -> Poses:
    words = "1 of 4 markers was seen"
    return [ToolPose("pointer", PoseStatus.MISSING, words, n * 10**6, n) for n in range(count)]


def shaking() -> Poses:
    rng = np.random.default_rng(3)
    return [
        replace(one, tip_mm=one.tip_mm + rng.normal(0.0, 1.0, 3), translation_mm=shaken)
        for one in resting("pointer", 700)
        if one.tip_mm is not None
        and one.translation_mm is not None
        and (shaken := one.translation_mm + rng.normal(0.0, 1.0, 3)) is not None
    ]


NO_POINTS: list[tuple[Any, ...]] = [
    (list, (409, "nothing-seen"), "no frame came"),
    (lambda: lost(50), (409, "nothing-seen"), "MISSING: 50; 1 of 4 markers was seen"),
    (shaking, (422, "not-stationary"), "the tip scattered by"),
    (lambda: resting("pointer", 300), (422, "too-few-poses"), "span 0.299 s"),
    (
        lambda: [*resting("pointer", 300), *lost(600)[300:], *resting("pointer", 100, 600)],
        (422, "too-few-poses"),
        "300 frames had no pose to use, the last: 1 of 4 markers",
    ),
]


@pytest.mark.slow
def test_why_there_is_no_point(pointer: Any, running: FakePipeline):
    for poses, problem, words in NO_POINTS:
        running.batches = [
            tool_batch([poses(), [pose("patient", n, np.eye(3), PIVOT_MM) for n in (0,)]])
        ]
        answer = pointer.post(URL, json={"timeout_s": 0.05})
        assert code(answer) == problem, answer.text
        assert 'tip of tool "pointer" was not held still within 0.05 s' in answer.json()["detail"]
        assert words in answer.json()["detail"]


def test_a_tip_that_nobody_knows_measures_nothing(pointer: Any):
    pointer.patch("/api/v1/tools/pointer", json={"tip_mm": None})
    answer = pointer.post(URL, json={})
    assert code(answer) == (409, "tip-not-calibrated")
    assert "pivot" in answer.json()["detail"]


def test_what_cannot_be_asked_for(pointer: Any, live: FakePipeline):
    assert code(pointer.post("/api/v1/tools/nobody/points", json={})) == (404, "unknown-tool")
    assert code(pointer.post(URL, json={"frame_id": "nowhere"})) == (404, "unknown-tool")
    assert code(pointer.post(URL, json={"frame_id": "pointer"})) == (422, "invalid-parameter")
    assert code(pointer.post(URL, json={"duration_s": 0.0})) == (422, "invalid-request")
    live.records = None
    assert code(pointer.post(URL, json={})) == (409, "device-not-running")


def test_not_with_another_calibration(pointer: Any, running: FakePipeline):
    rest = resting("pointer", 100)
    running.batches = [tool_batch([rest]), tool_batch([rest], calibration="moved")]
    switched = pointer.post(URL, json={})
    assert code(switched) == (409, "calibration-switched"), switched.text
    # The frame was registered with the one before.
    registered(pointer)
    running.batches = [tool_batch([resting("pointer", 700)], calibration="moved")]
    assert asked(pointer)["calibration_id"] == "moved"
    answer = pointer.post(URL, json={"frame_id": "ct"})
    assert code(answer) == (409, "calibration-switched"), answer.text
    assert '"sim-nominal"' in answer.json()["detail"]
    running.batches = [tool_batch([lost(3)], calibration=None)]
    none = pointer.post(URL, json={"timeout_s": 0.02})
    assert code(none) == (409, "no-active-calibration"), none.text


@pytest.mark.slow
def test_no_more_wait_at_once_than_may(pointer: Any, running: FakePipeline):
    running.batches = [tool_batch([resting("pointer", 700)])]
    with ExitStack() as others:
        for _ in range(concurrency_limits.MAX_CONCURRENT):
            others.enter_context(concurrency_limits.digitisations)
        refused = pointer.post(URL, json={})
        assert code(refused) == (503, "busy"), refused.text
        # Who measures points keeps nobody from calibrating tools.
        path = "/api/v1/tools/pointer/pivot-calibrations"
        assert pointer.post(path, json={"duration_s": 0.02}).status_code != 503
    for _ in range(concurrency_limits.MAX_CONCURRENT + 1):
        asked(pointer)


def test_a_registration_by_a_surface_waits_its_turn(pointer: Any):
    body = registration(IMAGE, measured_sigma_mm=0.1)
    assert pointer.post("/api/v1/registrations", json=body).status_code == 201
    points = (np.random.default_rng(0).normal(size=(20, 3)) * 50.0).tolist()
    request = {
        "id": "skin", "kind": "surface", "device_id": "sim", "parent_id": "ct", "points_mm": points,
        "surface": {"kind": "points", "points_mm": points},
    }  # fmt: skip
    with ExitStack() as others:
        for _ in range(concurrency_limits.MAX_CONCURRENT_SURFACES):
            others.enter_context(concurrency_limits.surfaces)
        refused = pointer.post("/api/v1/registrations", json=request)
    assert code(refused) == (503, "busy"), refused.text
