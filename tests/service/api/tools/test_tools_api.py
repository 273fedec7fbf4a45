"""The resource of tools: made, changed, deleted, refused with reasons; the live side follows."""

from typing import Any

import pytest

from tests.service.fake_pipeline import FakePipeline

POINTER = {
    "id": "pointer",
    "device_id": "sim",
    "title": "Pointer",
    "markers_mm": [[0, 0, 0], [80, 0, 0], [0, 60, 0], [20, 15, 40]],
    "strobe_markers": [0, 1, 2, 3],
    "tip_mm": [-150, 0, 0],
}
PATIENT = {
    "id": "patient",
    "device_id": "sim",
    "title": "Patient",
    "markers_mm": [[0, 0, 0], [110, 0, 0], [0, 70, 0], [45, 50, 30]],
}


def made(client: Any, tool: dict[str, Any], **changes: Any) -> Any:
    return client.post("/api/v1/tools", json=tool | changes)


def code(answer: Any) -> tuple[int, str]:
    return answer.status_code, answer.json()["type"].removeprefix("/problems/")


def followed(live: FakePipeline) -> list[str]:
    return [tool.name for tool in live.tracked["sim"].tools]


def test_a_tool_from_the_first_to_the_last(client: Any, live: FakePipeline):
    answer = made(client, POINTER)
    assert answer.status_code == 201, answer.text
    assert answer.headers["location"] == "/api/v1/tools/pointer"
    tool = answer.json()
    given = {name: value for name, value in POINTER.items() if name != "tip_mm"}
    assert tool.items() >= given.items()
    assert tool["tip"] == {
        "position_mm": [-150, 0, 0], "covariance_mm2": None, "tool_calibration_id": None,
        "axis": None,
    }  # fmt: skip
    assert tool["origin"]["kind"] == "given"
    assert (tool["reference_id"], tool["limits"]) == (None, {"tip_sd_mm": None})
    assert client.get("/api/v1/tools/pointer").json() == tool
    assert made(client, PATIENT).status_code == 201
    (body, other) = sorted(live.tracked["sim"].tools, key=lambda one: one.name, reverse=True)
    assert (body.name, body.strobe_markers, body.tip_mm) == ("pointer", (0, 1, 2, 3), (-150, 0, 0))
    assert body.markers_mm.tolist() == POINTER["markers_mm"]
    assert (other.name, other.strobe_markers, other.tip_mm) == ("patient", None, None)
    assert not live.tracked["sim"].tracks  # nobody has asked for it
    change = {"reference_id": "patient", "limits": {"tip_sd_mm": 0.4}, "title": "Probe"}
    changed = client.patch("/api/v1/tools/pointer", json=change).json()
    assert (changed["reference_id"], changed["limits"]) == ("patient", {"tip_sd_mm": 0.4})
    assert changed["tip"]["position_mm"] == [-150, 0, 0]  # left out: it stays
    by_name = {tool.name: tool for tool in live.tracked["sim"].tools}
    assert by_name["pointer"].max_tip_sd_mm == 0.4
    assert client.patch("/api/v1/tools/pointer", json={"tip_mm": None}).json()["tip"] == {
        "position_mm": None, "covariance_mm2": None, "tool_calibration_id": None, "axis": None,
    }  # fmt: skip
    listed = client.get("/api/v1/tools", params={"device_id": "sim"}).json()
    assert [tool["id"] for tool in listed["items"]] == ["patient", "pointer"]
    refused = client.delete("/api/v1/tools/patient")
    assert code(refused) == (409, "tool-in-use")
    assert '"pointer"' in refused.json()["detail"]
    assert client.delete("/api/v1/tools/pointer").status_code == 204
    assert client.delete("/api/v1/tools/patient").status_code == 204
    assert followed(live) == []
    assert code(client.get("/api/v1/tools/pointer")) == (404, "unknown-tool")


@pytest.mark.parametrize(
    ("changes", "status", "problem", "words"),
    [
        ({"device_id": "nothing"}, 404, "unknown-device", "nothing"),
        ({"id": "patient"}, 409, "tool-exists", '"patient"'),
        ({"id": "tracker"}, 422, "invalid-parameter", '"tracker"'),
        ({"reference_id": "nothing"}, 404, "unknown-tool", '"nothing"'),
        ({"reference_id": "pointer"}, 422, "invalid-parameter", "its own reference"),
        ({"strobe_markers": [0, 1, 2]}, 422, "invalid-parameter", "4 markers and 3"),
        ({"strobe_markers": [0, 1, 2, 2]}, 422, "invalid-parameter", "[0, 1, 2, 2]"),
        (
            {"markers_mm": [[0, 0, 0], [50, 0, 0], [120, 0, 0]], "strobe_markers": None},
            422,
            "degenerate-tool",
            "on a line",
        ),
        (
            # The same four distances as the patient's, turned about and moved.
            {
                "markers_mm": [[5, 6, 7], [5, 116, 7], [-65, 6, 7], [-45, 51, 37]],
                "strobe_markers": None,
            },
            422,
            "indistinguishable-tools",
            '"patient" and "pointer"',
        ),
        (
            {"markers_mm": [[0, 0, 0], [50, 0, 0], [0, 50, 0]], "strobe_markers": None},
            422,
            "degenerate-tool",
            "exchanged",
        ),
    ],
)
def test_what_cannot_be_tracked_is_refused_with_the_reason(
    sqlite_client: Any, changes: dict[str, Any], status: int, problem: str, words: str
):
    assert made(sqlite_client, PATIENT).status_code == 201
    answer = made(sqlite_client, POINTER, **changes)
    assert code(answer) == (status, problem), answer.text
    assert words in answer.json()["detail"]
    assert len(sqlite_client.get("/api/v1/tools").json()["items"]) == 1


def test_a_marker_is_one_tools_only(sqlite_client: Any):
    assert made(sqlite_client, POINTER).status_code == 201
    other = made(sqlite_client, PATIENT, strobe_markers=[6, 5, 4, 3])
    assert code(other) == (409, "markers-taken")
    assert other.json()["context"] == {"tool_id": "pointer", "markers": [3]}
    assert made(sqlite_client, PATIENT, strobe_markers=[6, 5, 4, 7]).status_code == 201


def test_a_reference_is_of_the_same_device(sqlite_client: Any):
    source = {"kind": "simulated"}
    device = {"id": "other", "title": "Other", "source": source}
    assert sqlite_client.post("/api/v1/devices", json=device).status_code == 201
    assert made(sqlite_client, PATIENT, device_id="other").status_code == 201
    answer = made(sqlite_client, POINTER, reference_id="patient")
    assert code(answer) == (422, "invalid-parameter")
    assert made(sqlite_client, POINTER).status_code == 201
    change = sqlite_client.patch("/api/v1/tools/pointer", json={"reference_id": "patient"})
    assert code(change) == (422, "invalid-parameter")
    # Nor is a pose of one device in the frame of another.
    posed = sqlite_client.get("/api/v1/tools/pointer/pose", params={"frame_id": "patient"})
    assert code(posed) == (422, "invalid-parameter")


def test_there_is_an_end_to_the_tools_of_a_device(
    sqlite_client: Any, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("service.api.tools.store.MAX_TOOLS", 1)
    assert made(sqlite_client, PATIENT).status_code == 201
    assert code(made(sqlite_client, POINTER)) == (409, "too-many-tools")


def test_a_device_with_tools_is_not_deleted_by_mistake(client: Any, live: FakePipeline):
    source = {"kind": "simulated"}
    client.post("/api/v1/devices", json={"id": "bench", "title": "Bench", "source": source})
    assert made(client, POINTER, device_id="bench").status_code == 201
    refused = client.delete("/api/v1/devices/bench")
    assert code(refused) == (409, "device-in-use")
    assert '1 tool ("pointer");' in refused.json()["detail"]
    deleted = client.delete("/api/v1/devices/bench", params={"cascade": True})
    assert deleted.status_code == 204, deleted.text
    assert client.get("/api/v1/tools").json()["items"] == []


def test_who_did_it_is_written_down(sqlite_client: Any):
    made(sqlite_client, POINTER)
    sqlite_client.patch("/api/v1/tools/pointer", json={"title": "Probe"})
    made(sqlite_client, POINTER, id="again")
    sqlite_client.delete("/api/v1/tools/pointer")
    entries = sqlite_client.get("/api/v1/audit", params={"limit": 4}).json()["items"]
    assert [(one["operation"], one["outcome"], one["object_kind"]) for one in entries] == [
        ("delete-tool", "done", "tool"),
        ("create-tool", "refused", "tool"),
        ("change-tool", "done", "tool"),
        ("create-tool", "done", "tool"),
    ]
    assert entries[2]["before"]["title"] == "Pointer"
    assert entries[2]["after"]["title"] == "Probe"


def test_how_a_device_is_tracked_is_its_setting(client: Any, live: FakePipeline):
    device = client.get("/api/v1/devices/sim").json()
    assert device["tracking"]["tracks"] == "never"
    client.post("/api/v1/devices/sim/start")
    assert not live.tracked["sim"].tracks
    tracking = {"tracks": "always", "coast_s": 0.5, "tool_tip_sd_mm": 0.7}
    answer = client.patch("/api/v1/devices/sim", json={"tracking": tracking})
    assert answer.status_code == 200, answer.text
    assert answer.json()["tracking"] == device["tracking"] | tracking
    now = live.tracked["sim"]
    assert now.tracks
    assert now.tracker is not None
    assert now.tool_tracker is not None
    assert (now.tracker.coast_s, now.tool_tracker.max_tip_sd_mm) == (0.5, 0.7)
    again = client.patch("/api/v1/devices/sim", json={"tracking": {"tracks": "with-tools"}})
    assert again.json()["tracking"]["coast_s"] == 0.5  # left out: it stays
    assert not live.tracked["sim"].tracks
    made(client, POINTER)
    assert live.tracked["sim"].tracks
    assert followed(live) == ["pointer"]
    client.delete("/api/v1/tools/pointer")
    assert not live.tracked["sim"].tracks
    wrong = {"tracking": {"volume_mm": [[0, 0, 0], [1, 1, 0]]}}
    assert code(client.patch("/api/v1/devices/sim", json=wrong)) == (422, "invalid-parameter")
    assert client.get("/api/v1/devices/sim").json()["tracking"]["tracks"] == "with-tools"


def test_references_do_not_lead_back(sqlite_client: Any):
    assert made(sqlite_client, PATIENT).status_code == 201
    assert made(sqlite_client, POINTER, reference_id="patient").status_code == 201
    base = PATIENT | {"markers_mm": [[0, 0, 0], [150, 0, 0], [0, 95, 0], [20, 60, 65]]}
    assert made(sqlite_client, base, id="table").status_code == 201
    answer = sqlite_client.patch("/api/v1/tools/patient", json={"reference_id": "pointer"})
    assert code(answer) == (422, "invalid-parameter")
    assert '"patient" to "pointer" to "patient"' in answer.json()["detail"]
    further = sqlite_client.patch("/api/v1/tools/patient", json={"reference_id": "table"})
    assert further.status_code == 200, further.text
    back = sqlite_client.patch("/api/v1/tools/table", json={"reference_id": "pointer"})
    assert code(back) == (422, "invalid-parameter")
    assert sqlite_client.get("/api/v1/tools/table").json()["reference_id"] is None


def test_what_a_change_of_tracking_leaves_out_stays(client: Any, live: FakePipeline):
    path = "/api/v1/devices/sim"
    first = {"tracks": "always", "coast_s": 0.25, "tool_tip_sd_mm": 0.5}
    assert client.patch(path, json={"tracking": first}).status_code == 200
    changed = client.patch(path, json={"tracking": {"coast_s": 0.5}}).json()["tracking"]
    assert changed.items() >= (first | {"coast_s": 0.5}).items()
    assert live.tracked["sim"].tracks
    (entry, *_) = client.get("/api/v1/audit", params={"limit": 1}).json()["items"]
    assert entry["before"]["tracking"] == first
    assert entry["after"]["tracking"] == first | {"coast_s": 0.5}
    # A default that is given takes its place; an empty change changes nothing.
    given = client.patch(path, json={"tracking": {"tracks": "never"}}).json()["tracking"]
    assert (given["tracks"], given["coast_s"]) == ("never", 0.5)
    assert client.patch(path, json={"tracking": {}}).json()["tracking"] == given
