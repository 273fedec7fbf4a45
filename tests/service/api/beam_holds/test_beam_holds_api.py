"""The resource of holds: made, referred, changed, acknowledged, deleted; refused with reasons."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pytest

from compute.transform import Transform, rotation_matrix
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.scenes import MovingTool, MovingTools
from hardware.simulated.settings import SimulationSettings
from service.api.beam_holds.reference_capture import mean_pose
from service.database.models import HoldRow
from tests.service.api.tools.batches import noisy, pivoting, pose, tool_batch
from tests.service.api.tools.test_tools_api import PATIENT, code, made
from tests.service.fake_pipeline import FakePipeline

PLACES = {
    4: np.array([0.0, 0.0, 1500.0]),
    5: np.array([90.0, 0.0, 1500.0]),
    6: np.array([0.0, 50.0, 1500.0]),
}
CHEST = {
    "id": "chest",
    "device_id": "sim",
    "title": "Chest",
    "watch": {"kind": "strobed-markers", "markers": [4, 5, 6]},
    "limits": {"shift_mm": 3.0},
}
HEAD = {
    "id": "head",
    "device_id": "sim",
    "title": "Head",
    "watch": {"kind": "tool", "tool_id": "patient", "target_mm": [0, -80, 0]},
    "limits": {"shift_mm": 1.5, "rotation_rad": 0.02},
}
POSE = {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "translation_mm": [0, 0, 1500]}
GIVEN = {"given": {"positions_mm": [place.tolist() for place in PLACES.values()]}}


@pytest.fixture
def running(live: FakePipeline) -> FakePipeline:
    """A device that strobes seven markers."""
    shown = MovingTools((MovingTool(((0.0, 0.0, 0.0),) * 7),))
    live.records = SimulatedDriver("sim", SimulationSettings(scene=shown)).description
    return live


def new(client: Any, hold: dict[str, Any], **changes: Any) -> Any:
    return client.post("/api/v1/beam-holds", json=hold | changes)


def state(client: Any, hold: str) -> dict[str, Any]:
    answer = client.get(f"/api/v1/beam-holds/{hold}/state")
    assert answer.status_code == 200, answer.text
    assert answer.headers["cache-control"] == "no-store"
    found: dict[str, Any] = answer.json()
    return found


def chest(frames: int, shift_mm: float = 0.0, **given: Any) -> Any:
    """Frames of the three markers in turn, 1 ms each, exposed now."""
    shown = {marker: place + np.array([shift_mm, 0.0, 0.0]) for marker, place in PLACES.items()}
    return tool_batch([pivoting("none", frames)], shown, **given)


def test_a_hold_from_the_first_to_the_last(client: Any, live: FakePipeline):
    answer = new(client, CHEST, note="left side")
    assert answer.status_code == 201, answer.text
    assert answer.headers["location"] == "/api/v1/beam-holds/chest"
    hold = answer.json()
    assert hold["watch"] == CHEST["watch"] | {"min_markers": None}
    assert hold["limits"] == {
        "shift_mm": 3.0, "axis_mm": None, "rotation_rad": None, "probability": 0.05, "release": 0.8,
    }  # fmt: skip
    assert hold["rules"] == {"max_gap_s": 0.1, "settle_s": 0.5, "latched": False}
    assert (hold["reference"], hold["note"]) == (None, "left side")
    assert client.get("/api/v1/beam-holds/chest").json() == hold
    (watched,) = live.tracked["sim"].holds
    assert (watched.id, watched.reference, watched.limits.shift_mm) == ("chest", None, 3.0)
    now = state(client, "chest")
    assert (now["held"], now["cause"], now["exposure_ns"]) == (True, "no-data", None)
    assert "POST /api/v1/beam-holds/chest/reference" in now["reason"]
    referred = client.post("/api/v1/beam-holds/chest/reference", json=GIVEN)
    assert referred.status_code == 200, referred.text
    taken = referred.json()["reference"]
    assert (taken["kind"], taken["calibration_id"], taken["frames"]) == (
        "given",
        "sim-nominal",
        None,
    )
    assert taken["positions_mm"] == GIVEN["given"]["positions_mm"]
    why = "it has a new reference, and nothing was measured since"
    assert state(client, "chest")["reason"] == why
    change = {"limits": {"axis_mm": [1, 2, 3]}, "rules": {"settle_s": 0, "latched": True}}
    changed = client.patch("/api/v1/beam-holds/chest", json=change).json()
    assert changed["limits"]["axis_mm"] == [1, 2, 3]
    assert changed["limits"]["shift_mm"] == 3.0
    why = "the hold was changed, and nothing was measured since"
    assert state(client, "chest")["reason"] == why
    alone = client.patch("/api/v1/beam-holds/chest", json={"limits": {"shift_mm": None}}).json()
    assert (alone["limits"]["shift_mm"], alone["limits"]["axis_mm"]) == (None, [1, 2, 3])
    changed = client.patch("/api/v1/beam-holds/chest", json={"limits": {"shift_mm": 3}}).json()
    assert changed["rules"]["latched"] is True
    assert changed["rules"] == {"max_gap_s": 0.1, "settle_s": 0.0, "latched": True}
    assert (changed["title"], changed["reference"]) == ("Chest", taken)
    (watched,) = live.tracked["sim"].holds
    assert (watched.limits.axis_mm, watched.limits.rules.latched) == ((1, 2, 3), True)
    acknowledged = client.post("/api/v1/beam-holds/chest/acknowledge")
    assert (acknowledged.status_code, acknowledged.json()["held"]) == (200, True)
    listed = client.get("/api/v1/beam-holds", params={"device_id": "sim"}).json()
    assert listed["items"] == [changed]
    assert client.get("/api/v1/beam-holds", params={"device_id": "other"}).json()["items"] == []
    gone = client.delete("/api/v1/beam-holds/chest/reference").json()
    assert gone["reference"] is None
    assert state(client, "chest")["held"]
    assert client.delete("/api/v1/beam-holds/chest").status_code == 204
    assert live.tracked["sim"].holds == ()
    assert code(client.get("/api/v1/beam-holds/chest/state")) == (404, "unknown-beam-hold")
    by = {
        (one["operation"], one["object_id"]) for one in client.get("/api/v1/audit").json()["items"]
    }
    assert {(one, "chest") for one in (
        "create-beam-hold", "set-beam-hold-reference", "change-beam-hold", "acknowledge-beam-hold",
        "remove-beam-hold-reference", "delete-beam-hold",
    )} <= by  # fmt: skip


REFUSED: list[tuple[dict[str, Any], dict[str, Any], tuple[int, str], str]] = [
    (CHEST, {"device_id": "nothing"}, (404, "unknown-device"), "nothing"),
    (HEAD, {"watch": {"kind": "tool", "tool_id": "no"}}, (404, "unknown-tool"), '"no"'),
    (CHEST, {"limits": {}}, (422, "invalid-parameter"), "at least one"),
    (CHEST, {"limits": {"rotation_rad": 0.1}}, (422, "invalid-parameter"), "markers do not turn"),
    (
        CHEST,
        {"watch": {"kind": "strobed-markers", "markers": [4, 4]}},
        (422, "invalid-parameter"),
        "[4, 4]",
    ),
    (
        CHEST,
        {"watch": {"kind": "strobed-markers", "markers": [4, 5], "min_markers": 3}},
        (422, "invalid-parameter"),
        "min_markers is 3",
    ),
    (
        CHEST,
        {"watch": {"kind": "simultaneous-markers", "markers": 3, "search_radius_mm": 2}},
        (422, "invalid-parameter"),
        "search_radius_mm is 2 mm and a limit 3 mm",
    ),
    (
        HEAD,
        {"watch": HEAD["watch"] | {"axes": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}},
        (422, "invalid-parameter"),
        "no rotation",
    ),
    (HEAD, {"reference": GIVEN["given"]}, (422, "invalid-parameter"), "is its pose"),
    (CHEST, {"reference": POSE}, (422, "invalid-parameter"), "is their places"),
    (
        CHEST,
        {"reference": {"positions_mm": [[0, 0, 1500]]}},
        (422, "invalid-parameter"),
        "1 places; 3 markers",
    ),
    (
        HEAD,
        {"reference": POSE | {"covariance": np.diag([1, 1, 1, 1, 1, -1]).tolist()}},
        (422, "invalid-parameter"),
        "eigenvalue",
    ),
    (
        CHEST,
        {"reference": {"positions_mm": [[0, 0, 1500], [9, 0, 1500], [0, 0, 1500]]}},
        (422, "invalid-parameter"),
        "1 and 3 are 0 mm apart",
    ),
    (CHEST, {"limits": {"shift_mm": 500}}, (422, "invalid-request"), ""),
    (CHEST, {"rules": {"max_gap_s": 0}}, (422, "invalid-request"), ""),
]


def test_a_hold_that_cannot_be_says_why(sqlite_client: Any):
    assert made(sqlite_client, PATIENT).status_code == 201
    for hold, changes, expected, words in REFUSED:
        answer = new(sqlite_client, hold, **changes)
        assert code(answer) == expected, (changes, answer.text)
        assert words in answer.json()["detail"], (changes, answer.text)
    assert sqlite_client.get("/api/v1/beam-holds").json()["items"] == []


def test_what_is_taken_or_in_use_stays(sqlite_client: Any):
    assert made(sqlite_client, PATIENT).status_code == 201
    assert new(sqlite_client, HEAD, reference=POSE).status_code == 201
    assert code(new(sqlite_client, CHEST, id="head")) == (409, "beam-hold-exists")
    refused = sqlite_client.delete("/api/v1/tools/patient")
    assert code(refused) == (409, "tool-in-use")
    assert '1 hold ("head")' in refused.json()["detail"]
    refused = sqlite_client.delete("/api/v1/devices/sim")
    assert code(refused) == (409, "device-in-use")
    assert "1 hold" in refused.json()["detail"]
    for number in range(7):
        assert new(sqlite_client, CHEST, id=f"chest-{number}").status_code == 201
    assert code(new(sqlite_client, CHEST)) == (409, "too-many-beam-holds")
    changed = sqlite_client.patch(
        "/api/v1/beam-holds/chest-1", json={"limits": {"rotation_rad": 1}}
    )
    assert code(changed) == (422, "invalid-parameter")
    assert sqlite_client.delete("/api/v1/devices/sim?cascade=true").status_code == 204
    assert sqlite_client.get("/api/v1/beam-holds").json()["items"] == []


def test_a_reference_of_markers_is_their_mean(client: Any, running: FakePipeline):
    assert new(client, CHEST).status_code == 201
    running.batches = [chest(150)]
    answer = client.post(
        "/api/v1/beam-holds/chest/reference", json={"frames": 40, "timeout_s": 0.1}
    )
    assert answer.status_code == 200, answer.text
    taken = answer.json()["reference"]
    assert (taken["kind"], taken["calibration_id"], taken["frames"]) == (
        "captured",
        "sim-nominal",
        40,
    )
    # 0.02 mm along each axis, of 40 frames: six deviations are enough.
    places = np.array(list(PLACES.values()))
    np.testing.assert_allclose(taken["positions_mm"], places, atol=6 * 0.02 / np.sqrt(40))
    assert 0.01 < taken["scatter_mm"] < 0.1
    spread = np.sqrt(np.trace(np.array(taken["covariances_mm2"]), axis1=1, axis2=2))
    assert (spread > 0.5 * 0.02 * np.sqrt(3 / 40)).all()
    assert (spread < 0.1).all()
    (watched,) = running.tracked["sim"].holds
    assert watched.reference.positions_mm.tolist() == taken["positions_mm"]
    # And with it the beam goes on once all settled; the frames are as old as their clock says.
    running.holds._wall_ns = lambda: 0  # type: ignore[method-assign]
    running.holds.take(chest(1000))
    assert not running.holds.now("chest").held  # type: ignore[union-attr]


def test_a_reference_of_a_tool_is_its_mean_pose(sqlite_client: Any, running: FakePipeline):
    assert made(sqlite_client, PATIENT).status_code == 201
    assert new(sqlite_client, HEAD).status_code == 201
    rng = np.random.default_rng(5)
    turn, at = rotation_matrix(np.array([0.3, -0.4, 2.5])), np.array([10.0, 20.0, 1500.0])
    still = [pose("patient", n, *noisy(turn, at, rng)) for n in range(60)]
    running.batches = [tool_batch([still])]
    path = "/api/v1/beam-holds/head/reference"
    answer = sqlite_client.post(path, json={"frames": 50, "timeout_s": 0.1})
    assert answer.status_code == 200, answer.text
    taken = answer.json()["reference"]
    found = Transform(
        np.array(taken["rotation"]),
        np.array(taken["translation_mm"]),
        np.array(taken["covariance"]),
    )
    np.testing.assert_allclose(found.rotation, turn, atol=6 * 2e-4 / np.sqrt(50))
    np.testing.assert_allclose(found.translation_mm, at, atol=6 * 0.02 / np.sqrt(50))
    assert np.linalg.eigvalsh(found.covariance).min() > 0.0
    why = "it has a new reference, and nothing was measured since"
    assert state(sqlite_client, "head")["reason"] == why


def test_the_mean_of_poses_keeps_what_is_common_to_them():
    rng = np.random.default_rng(9)
    common = np.diag([1e-6] * 3 + [0.25] * 3)
    poses = [
        Transform(rotation_matrix(rng.normal(0, 1e-4, 3)), rng.normal(0, 0.01, 3), common)
        for _ in range(200)
    ]
    found = mean_pose(poses).covariance
    assert found is not None
    np.testing.assert_allclose(np.diag(found), np.diag(common), rtol=0.05)
    alone = mean_pose([replace(one, covariance=None) for one in poses]).covariance
    assert alone is not None
    np.testing.assert_allclose(np.sqrt(np.diag(alone)[3:]), 0.01 / np.sqrt(200), rtol=0.3)


def strolling(frames: int) -> Any:
    batch = chest(frames)
    batch.points.position_mm[:, 0] += np.linspace(0.0, 5.0, frames)
    return batch


UNMEASURED: list[tuple[list[Any], str, str]] = [
    ([], "nothing-seen", "0 of 40 frames"),
    ([lambda: chest(60)], "nothing-seen", "20 of 40 frames"),
    ([lambda: strolling(300)], "not-stationary", "marker 4"),
    ([lambda: chest(300, calibration=None)], "no-active-calibration", "no active"),
    (
        [lambda: chest(60), lambda: chest(300, calibration="other")],
        "calibration-switched",
        "measure it again",
    ),
]


def test_a_reference_that_cannot_be_measured_says_why(sqlite_client: Any, running: FakePipeline):
    assert new(sqlite_client, CHEST).status_code == 201
    path = "/api/v1/beam-holds/chest/reference"
    for shown, problem, words in UNMEASURED:
        running.batches = [make() for make in shown]
        answer = sqlite_client.post(path, json={"frames": 40, "timeout_s": 0.05})
        assert code(answer)[1] == problem, answer.text
        assert words in answer.json()["detail"]
        assert sqlite_client.get("/api/v1/beam-holds/chest").json()["reference"] is None


def test_nothing_is_measured_of_a_device_that_does_not_run(sqlite_client: Any):
    assert new(sqlite_client, CHEST).status_code == 201
    answer = sqlite_client.post("/api/v1/beam-holds/chest/reference", json={})
    assert code(answer) == (409, "device-not-running")


def test_markers_that_are_lit_together_are_told_by_their_places(
    sqlite_client: Any, live: FakePipeline
):
    from tests.service.api.quality.batches import strobed_batch

    shown = SimulationSettings(illumination="simultaneous")
    live.records = SimulatedDriver("sim", shown).description
    pair = {"kind": "simultaneous-markers", "markers": 2, "observed_as": "points"}
    assert new(sqlite_client, CHEST, watch=pair).status_code == 201
    live.batches = [strobed_batch(range(60), lit_together=True)]
    path = "/api/v1/beam-holds/chest/reference"
    answer = sqlite_client.post(path, json={"frames": 50, "timeout_s": 0.1})
    assert answer.status_code == 200, answer.text
    found = np.array(answer.json()["reference"]["positions_mm"])
    np.testing.assert_allclose(found, [[-146, 0, 1500], [146, 0, 1500]], atol=0.5)
    assert new(sqlite_client, CHEST, id="trio", watch=pair | {"markers": 3}).status_code == 201
    answer = sqlite_client.post(
        "/api/v1/beam-holds/trio/reference", json={"frames": 50, "timeout_s": 0.1}
    )
    assert code(answer) == (409, "nothing-seen")
    assert "showed 2 markers; all 3" in answer.json()["detail"]


def test_a_hold_by_tracks_has_markers_followed(sqlite_client: Any, live: FakePipeline):
    watch = {"kind": "simultaneous-markers", "markers": 2, "observed_as": "tracks"}
    assert new(sqlite_client, CHEST, watch=watch).status_code == 201
    assert live.tracked["sim"].tracks
    assert sqlite_client.delete("/api/v1/beam-holds/chest").status_code == 204
    assert not live.tracked["sim"].tracks


def test_a_reference_is_not_given_to_another_hold(
    sqlite_client: Any, running: FakePipeline, monkeypatch: pytest.MonkeyPatch
):
    assert new(sqlite_client, CHEST).status_code == 201
    running.batches = [chest(300)]

    def attach(session: Any, tap: Any) -> None:
        with sqlite_client.app.state.database.write() as database:
            row = database.get(HoldRow, "chest")
            row.created_at = datetime.now(UTC) + timedelta(seconds=1)
        FakePipeline.attach(running, session, tap)

    monkeypatch.setattr(running, "attach", attach)
    answer = sqlite_client.post("/api/v1/beam-holds/chest/reference", json={"frames": 40})
    assert code(answer) == (409, "beam-hold-replaced")


def test_a_reference_that_was_taken_away_meanwhile_stays_away(
    sqlite_client: Any, running: FakePipeline, monkeypatch: pytest.MonkeyPatch
):
    assert new(sqlite_client, CHEST, reference=GIVEN["given"]).status_code == 201
    running.batches = [chest(300)]

    def attach(session: Any, tap: Any) -> None:
        assert sqlite_client.delete("/api/v1/beam-holds/chest/reference").status_code == 200
        FakePipeline.attach(running, session, tap)

    monkeypatch.setattr(running, "attach", attach)
    answer = sqlite_client.post("/api/v1/beam-holds/chest/reference", json={"frames": 40})
    assert code(answer) == (409, "beam-hold-replaced")
    assert "changed or taken away" in answer.json()["detail"]
    assert sqlite_client.get("/api/v1/beam-holds/chest").json()["reference"] is None


def test_a_server_that_starts_knows_its_holds(sqlite_settings: Any):
    from service.application.app import create_app
    from tests.service.fake_pipeline import TestClient

    with TestClient(create_app(sqlite_settings, FakePipeline())) as client:
        assert new(client, CHEST, rules={"latched": True}).status_code == 201
        assert client.post("/api/v1/beam-holds/chest/reference", json=GIVEN).status_code == 200
    live = FakePipeline()
    with TestClient(create_app(sqlite_settings, live)) as client:
        assert state(client, "chest")["reason"] == "nothing was measured yet"
        live.holds._wall_ns = lambda: 0  # type: ignore[method-assign]
        live.holds.take(chest(1000))
        assert state(client, "chest")["cause"] == "latched"
