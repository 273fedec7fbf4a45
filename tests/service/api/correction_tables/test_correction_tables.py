"""/api/v1/correction-tables: stored, exchanged, used with their calibration only."""

from typing import Any

import numpy as np
import pytest

from service.api.calibrations.examples import NEW_CALIBRATIONS
from service.api.correction_tables import upload_process as reading
from service.api.correction_tables.hdf5_file import read_table, write_table
from service.api.correction_tables.table_content import MEDIA_TYPE, TableContent
from service.application.app import create_app
from service.settings import Settings
from tests.service.api.correction_tables.tables import content
from tests.service.fake_pipeline import FakePipeline, TestClient
from tests.service.jobs import slow_tasks

URL = "/api/v1/correction-tables"


@pytest.fixture
def quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read uploads in this process: that they are read in another has its own tests."""
    monkeypatch.setattr(
        reading, "call_in_process", lambda function, data, **_: function(lambda *_: None, data)
    )


def send(client: Any, table: TableContent | bytes, **query: Any) -> Any:
    data = table if isinstance(table, bytes) else write_table(table)
    return client.post(URL, params=query, content=data, headers={"content-type": MEDIA_TYPE})


def nominal_hash(client: Any) -> str:
    found: str = client.get("/api/v1/calibrations/sim-nominal").json()["content_hash"]
    return found


def made_calibration(client: Any, name: str) -> str:
    body = NEW_CALIBRATIONS["frame"]["value"] | {"id": name}
    found: str = client.post("/api/v1/calibrations", json=body).json()["content_hash"]
    return found


def history(client: Any) -> list[tuple[str, str | None]]:
    """Calibration and table since the oldest activation."""
    items = client.get("/api/v1/devices/sim/activations").json()["items"]
    return [(item["calibration_id"], item["table_id"]) for item in items[::-1]]


@pytest.mark.slow
def test_a_table_is_stored_read_and_comes_back_as_it_was(client: Any):
    given = content(nominal_hash(client))
    made = send(client, given, id="map", note="first")  # by another process, as it is served
    assert made.status_code == 201, made.text
    assert made.headers["location"] == f"{URL}/map"
    document = made.json()
    assert client.get(f"{URL}/map").json() == document
    assert (document["calibration_id"], document["active"], document["origin"]) == (
        "sim-nominal", False, "upload",
    )  # fmt: skip
    assert document["content_hash"] == given.content_hash()
    assert document["validation"] == {"rms_px": 0.0123, "points": 200}
    assert document["valid_share"] == [1.0] * 4
    assert document["max_correction_px"] == pytest.approx(
        np.abs(given.table.coefficients_px).max(axis=(1, 2, 3))
    )
    file = client.get(f"{URL}/map/file")
    assert file.headers["content-type"] == MEDIA_TYPE
    assert 'filename="map.h5"' in file.headers["content-disposition"]
    assert read_table(file.content).content_hash() == given.content_hash()
    again = send(client, file.content, id="again")
    assert again.json()["content_hash"] == document["content_hash"]
    listed = client.get(URL, params={"device_id": "sim", "calibration_id": "sim-nominal"}).json()
    assert [one["id"] for one in listed["items"]] == ["again", "map"]
    assert client.get(URL, params={"device_id": "other"}).json()["items"] == []


@pytest.mark.slow
def test_a_table_is_used_with_its_calibration_and_no_other(
    client: Any, live: FakePipeline, quickly: None
):
    made_calibration(client, "other")
    send(client, content(nominal_hash(client)), id="map")
    send(client, content(made_calibration(client, "third"), degree=1), id="of-third")
    used = client.post(f"{URL}/map/activate")
    assert used.json()["active"] is True
    assert live.in_force["sim"].calibration_id == "sim-nominal"
    assert live.in_force["sim"].table_id == "map"
    assert live.in_force["sim"].table is not None
    assert client.get("/api/v1/devices/sim").json()["active_table_id"] == "map"
    refused = client.post(f"{URL}/of-third/activate")
    assert (refused.status_code, refused.json()["type"]) == (
        409, "/problems/foreign-correction-table",
    )  # fmt: skip
    assert client.get("/api/v1/devices/sim").json()["active_table_id"] == "map"
    # What is active already stays as it is, with its table.
    client.post("/api/v1/calibrations/sim-nominal/activate")
    assert client.get("/api/v1/devices/sim").json()["active_table_id"] == "map"
    client.post("/api/v1/calibrations/third/activate")
    assert live.in_force["sim"].table is None
    assert client.get(f"{URL}/map").json()["active"] is False
    assert client.post(f"{URL}/map/activate").status_code == 409
    assert client.post(f"{URL}/of-third/activate").status_code == 200
    assert client.post(f"{URL}/map/deactivate").json()["active"] is False
    assert live.in_force["sim"].table_id == "of-third"
    client.post(f"{URL}/of-third/deactivate")
    assert live.in_force["sim"].table_id is None
    assert history(client) == [
        ("sim-nominal", None),
        ("sim-nominal", "map"),
        ("third", None),
        ("third", "of-third"),
        ("third", None),
    ]


@pytest.mark.slow
def test_a_table_works_with_a_calibration_of_the_same_content(client: Any, quickly: None):
    wanted = made_calibration(client, "first")
    assert made_calibration(client, "second") == wanted
    client.post("/api/v1/calibrations/first/activate")
    assert send(client, content(wanted), id="map").json()["calibration_id"] == "first"
    client.post("/api/v1/calibrations/second/activate")
    assert client.post(f"{URL}/map/activate").json()["active"] is True
    assert history(client)[-1] == ("second", "map")


@pytest.mark.slow
def test_rolling_back_goes_back_step_by_step(client: Any, live: FakePipeline, quickly: None):
    made_calibration(client, "other")
    send(client, content(nominal_hash(client)), id="map")
    client.post(f"{URL}/map/activate")
    client.post("/api/v1/calibrations/other/activate")
    back = client.post("/api/v1/devices/sim/roll-back").json()
    assert (back["active_calibration_id"], back["active_table_id"]) == ("sim-nominal", "map")
    assert live.in_force["sim"].table_id == "map"
    back = client.post("/api/v1/devices/sim/roll-back").json()
    assert (back["active_calibration_id"], back["active_table_id"]) == ("sim-nominal", None)
    refused = client.post("/api/v1/devices/sim/roll-back")
    assert refused.json()["type"] == "/problems/nothing-to-roll-back"
    client.post("/api/v1/calibrations/other/activate")
    back = client.post("/api/v1/devices/sim/roll-back").json()
    assert (back["active_calibration_id"], back["active_table_id"]) == ("sim-nominal", None)
    assert history(client) == [
        ("sim-nominal", None),
        ("sim-nominal", "map"),
        ("other", None),
        ("sim-nominal", "map"),
        ("sim-nominal", None),
        ("other", None),
        ("sim-nominal", None),
    ]
    items = client.get("/api/v1/devices/sim/activations").json()["items"][::-1]
    first = items[0]["id"]
    assert [item["restores_id"] for item in items] == [
        None, None, None, items[1]["id"], first, None, first,
    ]  # fmt: skip


@pytest.mark.slow
def test_rolling_back_to_a_retired_calibration_is_refused(sqlite_client: Any):
    made_calibration(sqlite_client, "other")
    sqlite_client.post("/api/v1/calibrations/other/activate")
    sqlite_client.post("/api/v1/calibrations/sim-nominal/retire")
    refused = sqlite_client.post("/api/v1/devices/sim/roll-back")
    assert refused.json()["type"] == "/problems/calibration-retired"
    assert sqlite_client.get("/api/v1/devices/sim").json()["active_calibration_id"] == "other"


@pytest.mark.slow
def test_a_device_starts_with_its_table(sqlite_client: Any, live: FakePipeline, quickly: None):
    send(sqlite_client, content(nominal_hash(sqlite_client)), id="map")
    sqlite_client.post(f"{URL}/map/activate")
    live.in_force.clear()
    sqlite_client.post("/api/v1/devices/sim/start")
    assert live.in_force["sim"].table_id == "map"


def test_only_a_table_that_was_never_used_is_deleted(client: Any, quickly: None):
    for name in ("used", "spare"):
        send(client, content(nominal_hash(client)), id=name)
    client.post(f"{URL}/used/activate")
    for _ in range(2):
        refused = client.delete(f"{URL}/used")
        assert refused.json()["type"] == "/problems/correction-table-in-use"
        assert "referred to by 1 activation (" in refused.json()["detail"]
        client.post(f"{URL}/used/deactivate")
    assert client.delete(f"{URL}/spare").status_code == 204
    assert client.get(f"{URL}/spare").status_code == 404
    assert [item["id"] for item in client.get(URL).json()["items"]] == ["used"]


def test_a_deleted_device_takes_its_tables_along(client: Any, quickly: None):
    send(client, content(nominal_hash(client)), id="map")
    client.post(f"{URL}/map/activate")
    assert client.delete("/api/v1/devices/sim").status_code == 409
    assert client.delete("/api/v1/devices/sim?cascade=true").status_code == 204
    assert client.get(f"{URL}/map").status_code == 404


def test_sensors_of_another_order_are_refused(sqlite_client: Any, quickly: None):
    table = content(
        nominal_hash(sqlite_client),
        ("horizontal", "vertical", "diagonal-rising", "diagonal-falling"),
    )
    refused = send(sqlite_client, table)
    assert refused.json()["type"] == "/problems/foreign-correction-table"
    assert sqlite_client.get(URL).json()["items"] == []


def crash(_tell: Any, _data: bytes) -> None:
    slow_tasks.die(_tell)


@pytest.mark.slow
def test_a_crash_of_the_reading_library_costs_an_answer(
    sqlite_client: Any, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(reading, "_read", crash)
    refused = send(sqlite_client, content(nominal_hash(sqlite_client)))
    assert refused.json()["type"] == "/problems/invalid-table-file"
    assert "exit code 7" in refused.json()["detail"]
    assert sqlite_client.get("/healthz").status_code == 200


def test_files_have_a_limit_of_their_own(sqlite_settings: Settings):
    limits = {"body_limit_bytes": 2048, "table_limit_bytes": 4096}
    settings = sqlite_settings.model_copy(update=limits)
    with TestClient(create_app(settings, FakePipeline())) as client:
        refused = send(client, bytes(4097))
        assert (refused.status_code, "4096" in refused.json()["detail"]) == (413, True)
        assert send(client, bytes(4096)).json()["type"] == "/problems/invalid-table-file"
        other = client.post("/api/v1/calibrations", content=bytes(2049))
        assert (other.status_code, "2048" in other.json()["detail"]) == (413, True)
