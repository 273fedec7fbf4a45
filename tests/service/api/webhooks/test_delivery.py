"""Deliveries to a real HTTP server: signed, in order, repeated, bounded; nobody waits for them."""

import logging
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from compute.pose.beam_hold import BeamHoldCause
from service.api.webhooks import delivery
from service.api.webhooks.signature import signed_headers
from service.api.webhooks.sources import DeviceEvents
from service.application.app import create_app
from service.pipeline.device_status import DeviceStatus
from service.pipeline.frame_batch import BeamHoldState
from service.settings import Settings
from tests.service.api.webhooks.receiver import receiving
from tests.service.fake_pipeline import FakePipeline, TestClient

if TYPE_CHECKING:
    from service.api.webhooks.dispatcher import WebhookDispatcher

API = "/api/v1/webhooks"


@pytest.fixture
def client(tmp_path: Path) -> Iterator[TestClient]:
    with TestClient(create_app(Settings(data_dir=tmp_path), FakePipeline())) as client:
        dispatcher: WebhookDispatcher = client.app.state.webhooks  # type: ignore[attr-defined]
        dispatcher._first_delay_s = 0.01
        yield client


def make(client: TestClient, url: str, *event_types: str, **members: Any) -> dict[str, Any]:
    body = {"id": "alarm", "title": "Alarm", "url": url, "event_types": event_types} | members
    made = client.post(API, json=body)
    assert made.status_code == 201, made.text
    document: dict[str, Any] = made.json()
    return document


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < end, "it did not come true"
        time.sleep(0.01)


def state(client: TestClient, webhook_id: str = "alarm") -> dict[str, Any]:
    found: dict[str, Any] = client.get(f"{API}/{webhook_id}/state").json()
    return found


@pytest.mark.slow
def test_delivery_to_a_name_goes_to_the_address_where_somebody_listens(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of `localhost`: the receiver listens on IPv4 only, and the name leads to IPv6 first."""
    monkeypatch.setattr("service.api.webhooks.target.lookup", lambda _: ("::1", "127.0.0.1"))
    with receiving() as receiver:
        make(client, receiver.url.replace("127.0.0.1", "localhost"), "device.lost")
        answer = client.post(f"{API}/alarm/test")
        assert answer.status_code < 300, answer.text
        receiver.wait(1)
    ((headers, _),) = receiver.requests
    assert {name.lower(): text for name, text in headers.items()}["host"].startswith("localhost:")


def emit(client: Any, *arguments: Any) -> None:
    client.app.state.webhooks.emit(*arguments)


@pytest.mark.slow
def test_event_is_signed_and_has_type_time_and_data(client: TestClient) -> None:
    with receiving() as receiver:
        made = make(client, receiver.url, "device.lost")
        emit(client, "hold.held", {"hold_id": "other"})
        emit(client, "device.lost", {"device_id": "sim", "reason": "unplugged"})
        [event] = receiver.wait(1)
        wait_for(lambda: state(client)["events_delivered"] == 1)
        [(headers, body)] = receiver.requests
    assert event["type"] == "device.lost"
    assert event["data"] == {"device_id": "sim", "reason": "unplugged"}
    lower = {name.lower(): value for name, value in headers.items()}
    assert lower["host"] in receiver.url
    expected = signed_headers(
        made["secret"], lower["webhook-id"], int(lower["webhook-timestamp"]), body
    )
    assert expected.items() <= lower.items()
    assert abs(time.time() - int(lower["webhook-timestamp"])) < 60


@pytest.mark.slow
def test_failed_attempts_are_repeated_with_the_same_id_in_order(client: TestClient) -> None:
    with receiving(statuses=[500, 429, 302]) as receiver:
        make(client, receiver.url, "device.lost")
        for number in range(2):
            emit(client, "device.lost", {"number": number})
        events = receiver.wait(5)
        wait_for(lambda: state(client)["events_delivered"] == 2)
    assert [event["data"]["number"] for event in events] == [0, 0, 0, 0, 1]
    ids = [headers["webhook-id"] for headers, _ in receiver.requests]
    assert len(set(ids[:4])) == 1
    assert ids[4] != ids[0]


@pytest.mark.slow
def test_given_up_after_last_attempt_and_state_says_why(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(delivery, "ATTEMPTS", 3)
    with receiving(statuses=[500] * 3) as receiver:
        make(client, receiver.url, "device.lost")
        emit(client, "device.lost", {})
        wait_for(lambda: state(client)["events_failed"] == 1)
        assert state(client)["reason"] == "answered with status 500"
        # The next event has its own attempts.
        emit(client, "device.lost", {})
        wait_for(lambda: state(client)["events_delivered"] == 1)
    assert state(client)["reason"] is None
    text = client.get("/metrics").text
    assert 'lumiline_webhook_events_failed_total{webhook="alarm"} 1.0' in text


@pytest.mark.slow
def test_stalled_receiver_holds_up_nobody(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    """emit does not wait, the queue is bounded, and other webhooks get theirs."""
    # Who waited for the stalled one would not come to the end of the test.
    monkeypatch.setattr(delivery, "REQUEST_S", 3600.0)
    stall = threading.Event()
    with receiving(stall=stall) as stalled, receiving() as good:
        make(client, stalled.url, "device.lost", id="stalled")
        make(client, good.url, "device.lost", id="good")
        for number in range(delivery.MAX_WAITING + 50):
            emit(client, "device.lost", {"number": number})
        good.wait(100, timeout_s=100.0)
        wait_for(lambda: state(client, "stalled")["events_dropped"] >= 40)
        assert state(client, "stalled")["events_waiting"] <= delivery.MAX_WAITING
        assert client.get("/healthz").status_code == 200
        assert client.delete(f"{API}/stalled").status_code == 204


@pytest.mark.slow
def test_server_ends_while_receiver_stalls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # The end of the request that stalls would come an hour after the end of the server.
    monkeypatch.setattr(delivery, "REQUEST_S", 3600.0)
    with receiving(stall=threading.Event()) as receiver:
        with TestClient(create_app(Settings(data_dir=tmp_path), FakePipeline())) as client:
            dispatcher: WebhookDispatcher = client.app.state.webhooks  # type: ignore[attr-defined]
            make(client, receiver.url, "device.lost")
            emit(client, "device.lost", {})
            wait_for(lambda: state(client)["state"] == "delivering")
            assert dispatcher._thread.is_alive()
        assert not dispatcher._thread.is_alive()


def test_unreachable_receiver_is_told_in_state(client: TestClient) -> None:
    make(client, "http://127.0.0.1:9/hook", "device.lost")
    assert client.post(f"{API}/alarm/test").status_code == 202
    wait_for(lambda: state(client)["reason"] is not None)
    assert "ConnectError" in state(client)["reason"]


@pytest.mark.slow
def test_disabled_webhook_gets_nothing_until_enabled(client: TestClient) -> None:
    with receiving() as receiver:
        make(client, receiver.url, "device.lost", enabled=False)
        emit(client, "device.lost", {"number": 0})
        assert state(client)["state"] == "disabled"
        changed = client.patch(f"{API}/alarm", json={"enabled": True})
        assert changed.status_code == 200, changed.text
        emit(client, "device.lost", {"number": 1})
        [event] = receiver.wait(1)
    assert event["data"] == {"number": 1}


def test_secret_is_shown_once_and_never_logged_or_audited(
    client: TestClient, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    made = make(client, "http://127.0.0.1:9/hook", "device.lost")
    secret = made["secret"].removeprefix("whsec_")
    for path in (API, f"{API}/alarm", f"{API}/alarm/state", "/api/v1/audit"):
        answer = client.get(path)
        assert answer.status_code == 200
        assert secret not in answer.text
        assert "secret" not in answer.json()
    audit = client.get("/api/v1/audit", params={"object_kind": "webhook"}).json()["items"]
    assert [entry["operation"] for entry in audit] == ["create-webhook"]
    emit(client, "device.lost", {})
    wait_for(lambda: state(client)["reason"] is not None)
    assert secret not in caplog.text
    assert secret not in repr(client.app.state.webhooks._targets())  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"url": "http://169.254.169.254/"}, "link-local"),
        ({"url": "ftp://x"}, "https://HOST/PATH"),
        ({"event_types": []}, "at least 1"),
        ({"event_types": ["hold.moved"]}, "hold.held"),
        ({"extra": 1}, "extra"),
    ],
)
def test_wrong_webhook_is_refused(client: TestClient, change: dict[str, Any], word: str) -> None:
    body = {"title": "x", "url": "https://example.org/", "event_types": ["hold.held"]} | change
    refused = client.post(API, json=body)
    assert refused.status_code == 422
    assert word in refused.text
    if "url" in change:
        assert refused.json()["type"] == "/problems/webhook-target-refused"
        make(client, "https://example.org/", "hold.held")
        assert client.patch(f"{API}/alarm", json=change).json()["type"] == refused.json()["type"]


@pytest.mark.slow
def test_conditional_changes_and_too_many(client: TestClient) -> None:
    make(client, "https://example.org/", "hold.held")
    tag = client.get(f"{API}/alarm").headers["etag"]
    first = client.patch(f"{API}/alarm", json={"title": "A"}, headers={"if-match": tag})
    assert first.status_code == 200
    again = client.patch(f"{API}/alarm", json={"title": "B"}, headers={"if-match": tag})
    assert again.json()["type"] == "/problems/precondition-failed"
    missing = client.patch(f"{API}/alarm", json={"title": "B"}, headers={"if-match": None})
    assert missing.json()["type"] == "/problems/precondition-required"
    taken = client.post(
        API,
        json={"id": "alarm", "title": "x", "url": "https://a.org/", "event_types": ["hold.held"]},
    )
    assert taken.json()["type"] == "/problems/webhook-exists"
    for number in range(31):
        make(client, "https://example.org/", "hold.held", id=f"n{number}")
    body = {"title": "x", "url": "https://a.org/", "event_types": ["hold.held"]}
    assert client.post(API, json=body).json()["type"] == "/problems/too-many-webhooks"
    assert client.get(f"{API}/none/state").json()["type"] == "/problems/unknown-webhook"


def test_device_events_lost_and_recovered_once_each() -> None:
    events: list[tuple[str, dict[str, Any]]] = []
    look = DeviceEvents(lambda kind, data: events.append((kind, data))).look

    def told(name: str, reason: str | None = None) -> list[str]:
        events.clear()
        look({"bar": DeviceStatus(name, reason)})  # type: ignore[arg-type]
        return [kind for kind, _ in events]

    assert told("starting") == []
    assert told("disconnected") == []  # it never ran
    assert told("running") == []
    assert told("disconnected", "the cable") == ["device.lost"]
    assert events[0][1] == {"device_id": "bar", "state": "disconnected", "reason": "the cable"}
    assert told("failed") == []
    assert told("running") == ["device.recovered"]
    assert told("failed", "x") == ["device.lost"]
    assert told("stopped") == []  # on purpose
    assert told("running") == []
    look({})
    assert told("disconnected") == []


@pytest.mark.slow
def test_hold_events_changes_only_and_not_how_it_is_at_the_start(client: Any) -> None:
    """Through the registry of a running server, to the receiver."""
    registry = client.app.state.live.holds
    with receiving() as receiver:
        make(client, receiver.url, "hold.held", "hold.released")
        [listener] = registry._listeners
        for held in (True, True, False, True):
            cause = BeamHoldCause.NO_DATA if held else BeamHoldCause.NONE
            listener("sim", BeamHoldState("chest", held, cause, None, 1), False)
        events = receiver.wait(2)
    assert [event["type"] for event in events] == ["hold.released", "hold.held"]
    assert events[0]["data"]["hold_id"] == "chest"
    assert events[0]["data"]["device_id"] == "sim"
