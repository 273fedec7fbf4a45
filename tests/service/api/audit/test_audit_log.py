"""The audit log: every change with who, what and when; in the change's own transaction."""

from collections.abc import Iterator
from threading import Event
from typing import Any

import pytest
from sqlalchemy import text
from sqlalchemy.exc import DBAPIError

from hardware.simulated.calibration_target import calibration_target_points_mm
from service.api.calibrations.examples import simulated_points
from service.api.correction_tables.hdf5_file import write_table
from service.api.correction_tables.table_content import MEDIA_TYPE
from service.application.app import create_app
from service.database.audited_session import kind_of
from service.database.models import Base, DeviceRow
from service.problems.errors import NotReady
from service.security import store
from service.settings import Settings
from tests.service.api.correction_tables.tables import content as content_of_table
from tests.service.fake_pipeline import FakePipeline, TestClient

EXTERNAL = {
    "id": "bar",
    "title": "Bar",
    "source": {"kind": "external", "sensors": [{"name": "A", "pixels": 512, "pitch_um": 7.0}]},
}


@pytest.fixture(scope="module")
def module_client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    settings = Settings(data_dir=tmp_path_factory.mktemp("audit"))
    with TestClient(create_app(settings, FakePipeline()), raise_server_exceptions=False) as client:
        yield client


def entries(client: Any, **query: str) -> list[dict[str, Any]]:
    answer = client.get("/api/v1/audit", params={"limit": 200, **query})
    assert answer.status_code == 200, answer.text
    found: list[dict[str, Any]] = answer.json()["items"]
    return found


def newest(client: Any) -> dict[str, Any]:
    return entries(client)[0]


def send(client: Any, method: str, path: str, status: int, **options: Any) -> Any:
    answer = client.request(method, f"/api/v1{path}", **options)
    assert answer.status_code == status, answer.text
    return answer


@pytest.mark.slow
def test_every_change_of_a_device_and_its_calibration(client: Any) -> None:
    points = simulated_points(2.0 * calibration_target_points_mm()[::2])
    hash_ = client.get("/api/v1/calibrations/sim-nominal").json()["content_hash"]
    table = {
        "content": write_table(content_of_table(hash_)),
        "headers": {"content-type": MEDIA_TYPE},
    }
    calibration = {"id": "a", "device_id": "sim", "points": points}
    targets = [{"name": "P1", "position_mm": [0, 0, 0]}]
    run = {"id": "r", "device_id": "sim", "points": points, "result_id": "of-run"}
    reading = [{"name": "p", "readings": simulated_points([[0.0, 0.0, 0.0]])[0]["readings"]}]
    steps: list[tuple[str, str, int, dict[str, Any], str, str]] = [
        # request, what it is answered with, and kind and id of what was changed
        ("POST", "/devices", 201, {"json": EXTERNAL}, "device", "bar"),
        ("PATCH", "/devices/bar", 200, {"json": {"title": "New"}}, "device", "bar"),
        ("DELETE", "/devices/bar", 204, {}, "device", "bar"),
        ("POST", "/devices/sim/start", 200, {}, "device", "sim"),
        ("POST", "/devices/sim/stop", 200, {}, "device", "sim"),
        ("POST", "/calibrations", 201, {"json": calibration}, "calibration", "a"),
        ("POST", "/correction-tables?id=t", 201, table, "correction-table", "t"),
        ("POST", "/correction-tables/t/activate", 200, {}, "device", "sim"),
        ("POST", "/correction-tables/t/deactivate", 200, {}, "device", "sim"),
        ("POST", "/correction-tables?id=u", 201, table, "correction-table", "u"),
        ("DELETE", "/correction-tables/u", 204, {}, "correction-table", "u"),
        ("POST", "/calibrations/a/activate", 200, {}, "device", "sim"),
        ("POST", "/devices/sim/roll-back", 200, {}, "device", "sim"),
        ("POST", "/calibrations/a/retire", 200, {}, "calibration", "a"),
        (
            "POST", "/captures", 201,
            {"json": {"id": "c", "device_id": "sim", "targets": targets}}, "capture", "c",
        ),
        ("DELETE", "/captures/c", 204, {}, "capture", "c"),
        ("POST", "/runs/calibration", 202, {"json": run}, "run", "r"),
        ("POST", "/runs/r/cancel", 200, {}, "run", "r"),
        ("DELETE", "/runs/r", 204, {}, "run", "r"),
    ]  # fmt: skip
    told = []
    for method, path, status, options, kind, identity in steps:
        request_id = f"step-{len(told)}"
        named = options | {"headers": options.get("headers", {}) | {"x-request-id": request_id}}
        send(client, method, path, status, **named)
        [entry] = [one for one in entries(client) if one["request_id"] == request_id]
        assert (entry["object_kind"], entry["object_id"]) == (kind, identity), path
        assert entry["outcome"] == "done"
        assert entry["actor"] == {"kind": "local", "id": "local", "name": "local"}
        assert entry["address"] == "127.0.0.1"
        told.append(entry)
    by = {entry["operation"]: entry for entry in told}
    assert by["change-device"]["before"] == {"title": "Bar"}
    assert by["change-device"]["after"] == {"title": "New"}
    assert by["delete-device"]["before"]["title"] == "New"
    assert by["activate-calibration"]["before"]["calibration_id"] == "sim-nominal"
    assert by["activate-calibration"]["after"]["calibration_id"] == "a"
    assert by["activate-correction-table"]["after"]["table_id"] == "t"
    assert by["roll-back-device"]["after"]["calibration_id"] == "sim-nominal"
    assert "retired_at" in by["retire-calibration"]["after"]
    assert by["cancel-run"]["after"]["state"] == "cancelled"
    history = client.get("/api/v1/devices/sim/activations").json()["items"]
    assert [move["actor"] for move in history] == ["local"] * 4 + [None]
    # Measuring is no change.
    before = len(entries(client))
    send(client, "POST", "/reconstructions", 201, json={"device_id": "sim", "points": reading})
    assert len(entries(client)) == before


def test_the_next_reader_of_the_log_knows_who(module_client: Any) -> None:
    with module_client.app.state.database.write() as session:
        row, made = store.add_key(session, name="ada", scopes=("activate:calibrations",))
        identity = row.id
    headers = {"authorization": f"Bearer {made.text}"}
    send(module_client, "POST", "/calibrations/sim-nominal/activate", 200, headers=headers)
    entry = newest(module_client)
    assert entry["actor"] == {"kind": "key", "id": identity, "name": "ada"}
    assert entries(module_client, actor_id=identity) == [entry]
    send(module_client, "POST", "/devices/sim/stop", 403, headers=headers)
    refused = newest(module_client)
    assert (refused["outcome"], refused["operation"]) == ("refused", "stop-device")
    assert (refused["object_kind"], refused["object_id"]) == ("device", "sim")
    assert "operate:devices" in refused["detail"]
    assert entries(module_client, actor_id=identity, outcome="refused") == [refused]
    # Reading what one may not read is no attempt to change.
    before = len(entries(module_client))
    send(module_client, "GET", "/devices", 403, headers=headers)
    assert len(entries(module_client)) == before


def test_a_conflict_is_told_and_bad_input_is_not(module_client: Any) -> None:
    send(module_client, "POST", "/calibrations/sim-nominal/retire", 409)
    refused = newest(module_client)
    assert (refused["outcome"], refused["operation"]) == ("refused", "retire-calibration")
    assert "is the active one" in refused["detail"]
    before = len(entries(module_client))
    send(module_client, "POST", "/calibrations/nothing/retire", 404)
    send(module_client, "POST", "/devices", 422, json={})
    assert len(entries(module_client)) == before


def test_filters_and_pages(module_client: Any) -> None:
    for title in ("one", "two", "three"):
        send(module_client, "PATCH", "/devices/sim", 200, json={"title": title})
    found = entries(module_client, operation="change-device", object_kind="device", object_id="sim")
    assert [entry["after"]["title"] for entry in found] == ["three", "two", "one"]
    assert entries(module_client, operation="change-device", object_kind="key") == []
    assert entries(module_client, object_id="nothing") == []
    since = found[1]["created_at"]
    assert len(entries(module_client, operation="change-device", since=since)) == 2
    assert len(entries(module_client, operation="change-device", until=since)) == 1
    page = module_client.get("/api/v1/audit?operation=change-device&limit=1").json()
    assert page["items"] == [found[0]]
    assert (
        entries(module_client, operation="change-device", cursor=page["next_cursor"])[0]
        == (found[1])
    )
    for wrong in (
        "since=2020-01-01T00:00:00",
        "since=1234567890",
        "since=0001-01-01T00:00:00%2B14:00",
        "until=9999-12-31T23:59:59-10:00",
        "outcome=maybe",
        "limit=0",
    ):
        assert module_client.get(f"/api/v1/audit?{wrong}").status_code == 422, wrong
    for right in ("since=1970-01-01T00:00:00%2B14:00", "until=9998-12-31T23:59:59-12:00"):
        assert module_client.get(f"/api/v1/audit?{right}").json()["items"] != []


def test_what_is_not_done_is_not_told(module_client: Any) -> None:
    database = module_client.app.state.database
    before = len(entries(module_client))

    def fail_half_way() -> None:
        with database.write() as session:
            session.get_one(DeviceRow, "sim").title = "never"
            session.flush()
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        fail_half_way()
    assert len(entries(module_client)) == before


def test_a_device_deleted_with_all_that_is_its(client: Any) -> None:
    send(client, "DELETE", "/devices/sim?cascade=true", 204)
    told = [one for one in entries(client) if one["operation"] == "delete-device"]
    counts = {one["object_kind"]: one["before"] for one in told}
    assert counts["calibration"] == counts["activation"] == {"rows": 1}
    assert counts["device"]["title"]


def test_entries_are_never_changed_or_deleted(client: Any) -> None:
    client.patch("/api/v1/devices/sim", json={"title": "Told"})
    database = client.app.state.database
    before = entries(client)
    assert before
    for statement in (
        "UPDATE audit_log SET actor_name = 'nobody'",
        "UPDATE audit_log SET outcome = 'done' WHERE id = 1",
        "DELETE FROM audit_log",
        "DELETE FROM audit_log WHERE id = 1",
    ):
        with pytest.raises(DBAPIError, match="audit_log are never"), database.write() as session:
            session.execute(text(statement))
    assert entries(client) == before


def test_no_table_is_forgotten() -> None:
    """What is new in the database is audited unless somebody says otherwise."""
    kinds = {mapper.class_.__tablename__: mapper.class_ for mapper in Base.registry.mappers}
    assert kind_of(kinds["correction_tables"]()) == "correction-table"
    assert kind_of(kinds["api_keys"]()) == "key"
    assert len({kind_of(found()) for found in kinds.values()}) == len(kinds)


def test_a_hanging_database_is_not_waited_for(
    module_client: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    goes_on = Event()
    monkeypatch.setattr("service.security.audit_entry._WAITED_S", 0.05)
    monkeypatch.setattr("service.security.audit_entry._write", lambda *_: goes_on.wait(240.0))
    try:
        send(module_client, "POST", "/devices/sim/stop", 200)
        assert not goes_on.is_set()
    finally:
        goes_on.set()
    assert "stop-device by local, done, is not written down yet" in caplog.text


def test_a_busy_database_keeps_no_device_from_being_stopped(
    module_client: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def locked(*_: Any) -> None:
        raise NotReady("locked")

    monkeypatch.setattr("service.security.audit_entry._write", locked)
    send(module_client, "POST", "/devices/sim/stop", 200)
    assert "stop-device by local, done, could not be written down" in caplog.text
