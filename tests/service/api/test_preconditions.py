"""Conditional requests: ETag, 304, 412 and 428; of two writers with one ETag one wins."""

from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import TimeoutError as StillWaiting
from typing import Any

import pytest

from service.api.beam_holds.monitor_config import tracking_config_of
from service.api.correction_tables.store import active_calibration
from service.api.devices.device_service import DeviceService, StoredContent
from service.api.devices.schema import DeviceChange
from service.api.devices.store import get_device
from service.api.preconditions import Precondition
from service.api.radiometric_calibrations.store import active_radiometric
from service.database.engine import Database
from service.database.models import ActiveCalibrationRow
from service.problems.errors import PreconditionFailed
from service.settings import Settings
from tests.openapi_document import openapi_document
from tests.service.api.beam_holds.test_beam_holds_api import CHEST
from tests.service.api.tools.test_tools_api import POINTER
from tests.service.fake_pipeline import FakePipeline

ALARM = {
    "id": "alarm", "title": "x", "url": "https://a.example.org/", "event_types": ["hold.held"]
}  # fmt: skip
A_WHILE_S = 0.3
"""Long enough for other threads to reach the lock at which they have to wait."""

CHANGES: dict[str, tuple[str, list[dict[str, Any]]]] = {
    "/api/v1/devices/sim": ("PATCH", [{"title": "One"}, {"title": "Other"}]),
    "/api/v1/tools/pointer": ("PATCH", [{"title": "One"}, {"title": "Other"}]),
    "/api/v1/beam-holds/chest": ("PATCH", [{"title": "One"}, {"title": "Other"}]),
    "/api/v1/webhooks/alarm": ("PATCH", [{"title": "One"}, {"title": "Other"}]),
    "/api/v1/devices/sim/watch": ("PUT", [{"interval_s": 20.0}, {"interval_s": 30.0}]),
}
"""By path the method that changes a resource, and two changes."""


@pytest.fixture
def filled(client: Any) -> Any:
    """A server with a tool, a beam hold and a webhook."""
    for path, body in (("tools", POINTER), ("beam-holds", CHEST), ("webhooks", ALARM)):
        assert client.post(f"/api/v1/{path}", json=body).status_code == 201
    return client


def send(client: Any, path: str, number: int, if_match: str | None) -> Any:
    """Make one of the changes of a path; None: without the header."""
    method, changes = CHANGES[path]
    return client.request(method, path, json=changes[number], headers={"If-Match": if_match})


def code(answer: Any) -> tuple[int, str]:
    return answer.status_code, answer.json()["type"].removeprefix("/problems/")


@pytest.mark.parametrize("path", CHANGES)
def test_change_of_what_was_read(filled: Any, path: str) -> None:
    read = filled.get(path)
    etag = read.headers["etag"]
    assert filled.get(path).headers["etag"] == etag
    changed = send(filled, path, 0, etag)
    assert changed.status_code == 200, changed.text
    assert changed.headers["etag"] != etag
    again = filled.get(path)
    assert again.json() == changed.json()
    assert again.headers["etag"] == changed.headers["etag"]
    refused = send(filled, path, 1, etag)
    assert code(refused) == (412, "precondition-failed")
    assert refused.json()["context"] == {"etag": again.headers["etag"], "if_match": etag}
    assert filled.get(path).json() == changed.json()
    # One of several is enough; a weak one is none that a change may depend on.
    listed = f'"nothing", {again.headers["etag"]}'
    assert code(send(filled, path, 1, f"W/{again.headers['etag']}"))[0] == 412
    assert send(filled, path, 1, listed).status_code == 200


@pytest.mark.parametrize("path", CHANGES)
def test_change_without_a_precondition_is_refused(filled: Any, path: str) -> None:
    before = filled.get(path)
    refused = send(filled, path, 0, None)
    assert code(refused) == (428, "precondition-required")
    assert path in refused.json()["detail"]
    for wrong in ("nothing", before.headers["etag"].strip('"'), '"a" "b"', ""):
        refused = send(filled, path, 0, wrong)
        assert code(refused) == (422, "invalid-precondition"), wrong
    assert filled.get(path).json() == before.json()
    assert send(filled, path, 0, "*").status_code == 200


@pytest.mark.parametrize("path", [path for path in CHANGES if not path.endswith("watch")])
def test_delete_of_what_was_read(filled: Any, path: str) -> None:
    etag = filled.get(path).headers["etag"]
    send(filled, path, 0, "*")
    refused = filled.delete(path, headers={"If-Match": etag})
    assert code(refused) == (412, "precondition-failed")
    headers = {"If-Match": filled.get(path).headers["etag"]}
    cascade = {"cascade": "true"} if path.startswith("/api/v1/devices") else {}
    deleted = filled.delete(path, params=cascade, headers=headers)
    assert deleted.status_code == 204


def test_refused_change_is_in_the_audit_log(filled: Any) -> None:
    refused = send(filled, "/api/v1/tools/pointer", 0, '"old"')
    [entry] = filled.get("/api/v1/audit?operation=change-tool").json()["items"]
    assert (entry["outcome"], entry["object_id"]) == ("refused", "pointer")
    assert entry["detail"] == refused.json()["detail"]


def test_answer_is_short_while_nothing_has_changed(sqlite_client: Any) -> None:
    for path in ("devices/sim", "calibrations/sim-nominal", "device-profiles/bar"):
        read = sqlite_client.get(f"/api/v1/{path}")
        etag = read.headers["etag"]
        for wanted in (etag, f"W/{etag}", f'"a", {etag}', "*"):
            answer = sqlite_client.get(f"/api/v1/{path}", headers={"If-None-Match": wanted})
            assert (answer.status_code, answer.content) == (304, b""), wanted
            assert answer.headers["etag"] == etag
        for wanted in ('"a"', "a"):
            answer = sqlite_client.get(f"/api/v1/{path}", headers={"If-None-Match": wanted})
            assert answer.json() == read.json()
        head = sqlite_client.head(f"/api/v1/{path}", headers={"If-None-Match": etag})
        assert head.status_code == 304
        assert sqlite_client.head(f"/api/v1/{path}").headers["etag"] == etag


def test_what_no_cache_may_keep_has_no_etag(filled: Any) -> None:
    answer = filled.get("/api/v1/beam-holds/chest/state", headers={"If-None-Match": "*"})
    assert (answer.status_code, "etag" in answer.headers) == (200, False)


def test_the_contract_says_which_answers_have_an_etag(sqlite_client: Any) -> None:
    document = openapi_document()
    required = set()
    for path, item in document["paths"].items():
        for method, operation in item.items():
            names = {one["name"]: one for one in operation.get("parameters", ())}
            if "428" in operation["responses"]:
                assert names["If-Match"]["required"]
                required.add(f"{method.upper()} {path}")
            if "304" in operation["responses"]:
                assert method == "get"
                assert "If-None-Match" in names
                assert "ETag" in operation["responses"]["200"]["headers"]
            assert ("If-Match" in names) == ("412" in operation["responses"])
    assert required == {
        "PATCH /api/v1/devices/{device_id}",
        "PATCH /api/v1/tools/{tool_id}",
        "PATCH /api/v1/beam-holds/{hold_id}",
        "PATCH /api/v1/webhooks/{webhook_id}",
        "PUT /api/v1/devices/{device_id}/watch",
    }


# A webhook is of no device, whose lock both wait for here.
@pytest.mark.parametrize("path", [path for path in CHANGES if "webhooks" not in path])
def test_of_two_writers_at_once_one_wins(filled: Any, path: str) -> None:
    etag = filled.get(path).headers["etag"]
    with ThreadPoolExecutor(2) as pool:
        with filled.app.state.database.write() as session:
            get_device(session, "sim", lock=True)  # both have come before either can change
            waiting = [pool.submit(send, filled, path, number, etag) for number in (0, 1)]
            for one in waiting:
                with pytest.raises(StillWaiting):
                    one.result(A_WHILE_S)
        answers = [one.result(10) for one in waiting]
    assert sorted(answer.status_code for answer in answers) == [200, 412]
    [won] = [answer for answer in answers if answer.status_code == 200]
    assert filled.get(path).json() == won.json()


def test_of_two_servers_with_one_database_one_wins(client: Any, settings: Settings) -> None:
    # Each has locks of its own; what decides is the database's.
    etag = client.get("/api/v1/devices/sim").headers["etag"]
    others = [Database(settings.effective_database_url) for _ in range(2)]
    stored = StoredContent(active_calibration, active_radiometric, tracking_config_of)
    servers = [DeviceService(one, FakePipeline(), settings.folders, stored) for one in others]
    expected = Precondition(frozenset({etag}))
    try:
        with ThreadPoolExecutor(2) as pool:
            with client.app.state.database.write() as session:
                get_device(session, "sim", lock=True)
                waiting = [
                    pool.submit(server.change, "sim", DeviceChange(title=f"{number}"), expected)
                    for number, server in enumerate(servers)
                ]
                for one in waiting:
                    with pytest.raises(StillWaiting):
                        one.result(A_WHILE_S)
            errors = [one.exception(10) for one in waiting]
    finally:
        for one in others:
            one.close()
    [lost] = [error for error in errors if error is not None]
    assert isinstance(lost, PreconditionFailed)
    won = errors.index(None)
    assert client.get("/api/v1/devices/sim").json()["title"] == f"{won}"


def with_moved_pointer(client: Any) -> str:
    """Move the pointer to the active calibration; return the device's tag before."""
    tag: str = client.get("/api/v1/devices/sim").headers["etag"]
    with client.app.state.database.write() as session:  # as another activation would
        session.delete(session.get(ActiveCalibrationRow, "sim"))
    return tag


def test_device_read_before_an_activation_can_be_changed_after_it(client: Any) -> None:
    path = "/api/v1/devices/sim"
    tag = with_moved_pointer(client)
    now = client.get(path)
    # For a cache it is another one, for a PATCH it is not.
    assert now.headers["etag"] != tag
    assert client.get(path, headers={"If-None-Match": tag}).status_code == 200
    changed = client.patch(path, json={"title": "Mine"}, headers={"If-Match": tag})
    assert changed.status_code == 200, changed.text
    # What was changed meanwhile by another PATCH is refused as ever.
    refused = client.patch(path, json={"title": "Other"}, headers={"If-Match": tag})
    assert code(refused) == (412, "precondition-failed")


def test_device_read_before_an_activation_is_not_deleted(client: Any) -> None:
    tag = with_moved_pointer(client)
    refused = client.delete("/api/v1/devices/sim?cascade=true", headers={"If-Match": tag})
    assert code(refused) == (412, "precondition-failed")
