"""Log lines: their two forms, the request and the device that they are of, no secrets."""

import asyncio
import contextvars
import json
import logging
import sys
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.application.app import create_app
from service.application.middleware import RequestLog
from service.logs import (
    REFUSED,
    JsonFormatter,
    RequestRecord,
    TextFormatter,
    configured_logging,
    is_server_record,
    request_record,
    set_device_id,
    set_request_id,
)
from service.settings import Settings
from tests.service.fake_pipeline import FakePipeline, TestClient

KEY = "lumi_abcdefghij_0123456789"
SECRET = "s3cret"


def line(message: str, *arguments: Any, **members: Any) -> logging.LogRecord:
    found = logging.LogRecord("service.x", logging.WARNING, __file__, 1, message, arguments, None)
    vars(found).update(members)
    return found


@given(st.text(), st.text())
def test_a_line_is_one_line_and_one_object(message: str, value: str):
    record = line("%s", message, member=value)
    shown = json.loads(JsonFormatter().format(record))
    assert (shown["level"], shown["logger"]) == ("warning", "service.x")
    for text in (JsonFormatter().format(record), TextFormatter().format(record)):
        assert "\n" not in text
        assert "\x1b" not in text
    if (
        "lumi_" not in message
        and ":" not in message
        and "=" not in message
        and "eyJ" not in message
    ):
        assert "earer" in message or "asic" in message or shown["message"] == message


def test_secrets_are_taken_out_and_the_rest_is_left():
    text = f"{KEY} postgresql://u:{SECRET}@h/d token={SECRET}"
    try:
        raise ValueError(text)
    except ValueError:
        record = line("a %s", text, path=f"/x?key={SECRET}", exc_info=sys.exc_info())
    shown = JsonFormatter().format(record)
    for written in (shown, TextFormatter().format(record)):
        assert SECRET not in written
        assert KEY not in written
        assert "ValueError" in written
    fields = json.loads(shown)
    assert fields["path"] == "/x?key=***"
    assert fields["message"] == "a lumi_*** postgresql://u:***@h/d token=***"
    # A pattern over the whole line would take from the first value to the second.
    fields = json.loads(JsonFormatter().format(line("m", a="http://x", b="user:x@y")))
    assert (fields["a"], fields["b"]) == ("http://x", "user:x@y")


def test_lines_are_marked_with_request_and_device():
    def marked() -> tuple[str, dict[str, Any]]:
        set_request_id("r1")
        set_device_id("bar")
        return TextFormatter().format(line("m")), json.loads(JsonFormatter().format(line("m")))

    text, fields = contextvars.Context().run(marked)
    assert text.endswith("service.x: m [request r1] [device bar]")
    assert (fields["request"], fields["device"]) == ("r1", "bar")
    assert "device" not in json.loads(JsonFormatter().format(line("m")))
    assert json.loads(JsonFormatter().format(line("m", device="d2")))["device"] == "d2"


def test_uvicorns_false_alarm_is_left_out_and_true_ones_are_not():
    alarm = line("ASGI callable returned without completing handshake.")

    def refused() -> bool:
        REFUSED.set(True)
        return is_server_record(alarm)

    assert is_server_record(alarm)
    assert not contextvars.Context().run(refused)
    assert not is_server_record(line('%s - "WebSocket %s" [accepted]'))
    assert is_server_record(line("Exception in ASGI application\n"))


@pytest.mark.parametrize("log_format", ["text", "json"])
def test_logging_is_set_up_and_put_back(
    sqlite_settings: Settings, capsys: pytest.CaptureFixture[str], log_format: str
):
    settings = sqlite_settings.model_copy(update={"log_format": log_format, "log_level": "info"})
    before = logging.getLogger().handlers[:]
    with configured_logging(settings):
        logging.getLogger("service.y").info("begun")
        logging.getLogger("service.y").debug("too much")
        logging.getLogger("uvicorn.error").info("serving")
        logging.getLogger("sqlalchemy.pool").warning("another's")
    logging.getLogger("service.y").warning("after")
    assert logging.getLogger().handlers == before
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3
    for text, word in zip(lines, ("begun", "serving", "another's"), strict=True):
        assert (json.loads(text)["message"] if log_format == "json" else text).endswith(word)


def accesses(caplog: pytest.LogCaptureFixture) -> list[logging.LogRecord]:
    return [record for record in caplog.records if record.name == "service.access"]


def test_each_request_has_an_id_and_a_line(sqlite_client: Any, caplog: pytest.LogCaptureFixture):
    caplog.set_level(logging.INFO, "service.access")
    answer = sqlite_client.get("/api/v1/devices?limit=1", headers={"x-request-id": "mine-1"})
    assert answer.headers["x-request-id"] == "mine-1"
    made = sqlite_client.get("/nowhere", headers={"x-request-id": "no good\tone"})
    assert made.status_code == 404
    assert made.headers["x-request-id"] not in ("", "no good\tone")
    other = sqlite_client.get("/nowhere")
    assert other.headers["x-request-id"] != made.headers["x-request-id"]
    first, second, _ = accesses(caplog)
    assert first.getMessage().startswith("GET /api/v1/devices?limit=1 200 ")
    fields = vars(first)
    assert (fields["route"], fields["status"]) == ("/api/v1/devices", 200)
    assert fields["duration_s"] > 0
    assert (vars(second)["route"], vars(second)["status"]) == (None, 404)


def test_a_path_begins_no_line_of_its_own(sqlite_client: Any, caplog: pytest.LogCaptureFixture):
    caplog.set_level(logging.INFO, "service.access")
    sqlite_client.get("/a%0aINFO forged")
    assert "\n" not in accesses(caplog)[-1].getMessage()


def test_an_encoded_key_is_not_written_down(sqlite_client: Any, caplog: pytest.LogCaptureFixture):
    caplog.set_level(logging.INFO, "service.access")
    for target in (
        f"/nothing?x={KEY.replace('_', '%5F')}",
        f"/nothing?x={KEY.replace('_', '%255f')}",
        f"/nothing?x=%6cumi_{KEY[5:]}",
        f"/{KEY.replace('_', '%5F')}/{KEY.replace('_', '%255F')}",
        f"/api/v1/devices?api_key={KEY}",
    ):
        assert sqlite_client.get(target).status_code in (400, 404)
        for form in (TextFormatter, JsonFormatter):
            written = form().format(accesses(caplog)[-1])
            assert "***" in written, target
            assert KEY.rpartition("_")[2] not in written, target


@pytest.mark.timeout(60)
def test_a_long_address_is_cut(sqlite_client: Any, caplog: pytest.LogCaptureFixture):
    caplog.set_level(logging.DEBUG, "service.access")
    for target, status, kind in (
        ("/{0}", 404, "not-found"),
        ("/api/v1/devices?x={0}", 414, "query-too-long"),
        ("/healthz?x={0}", 414, "query-too-long"),
    ):
        answer = sqlite_client.get(target.format("eyJ" * 20_000))
        assert (answer.status_code, answer.json()["type"]) == (status, f"/problems/{kind}")
        record = accesses(caplog)[-1]
        for form in (TextFormatter, JsonFormatter):
            assert len(form().format(record)) < 1500, target


def test_who_supervises_is_not_in_the_log_unless_it_fails(
    sqlite_client: Any, live: FakePipeline, caplog: pytest.LogCaptureFixture
):
    caplog.set_level(logging.INFO, "service.access")
    for path in ("/healthz", "/readyz", "/metrics"):
        assert sqlite_client.get(path).status_code == 200
    assert accesses(caplog) == []
    live.answers = False
    assert sqlite_client.get("/readyz").status_code == 503
    assert len(accesses(caplog)) == 1


def test_a_failure_has_a_line_and_its_id(
    sqlite_client: Any, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
):
    caplog.set_level(logging.INFO, "service")

    def broken(*_: Any) -> None:
        raise RuntimeError("unforeseen")

    monkeypatch.setattr(sqlite_client.app.state.device_service, "status", broken)
    answer = sqlite_client.get("/api/v1/devices/sim/state", headers={"x-request-id": "f1"})
    assert (answer.status_code, answer.headers["x-request-id"]) == (500, "f1")
    assert vars(accesses(caplog)[-1])["status"] == 500


def test_a_websocket_has_a_line_when_it_opens_and_one_when_it_closes(
    caplog: pytest.LogCaptureFixture,
):
    caplog.set_level(logging.INFO, "service")
    sent: list[Any] = []
    ended: list[RequestRecord] = []

    async def app(scope: Any, receive: Any, send: Any) -> None:
        request_record(scope).route = "/stream"
        await send({"type": "websocket.accept", "headers": [(b"a", b"b")]})
        assert len(ended) == 1  # counted as it opens: it may stay open for days
        await send({"type": "websocket.close", "code": 1001})

    async def send(message: Any) -> None:
        sent.append(message)

    scope = {
        "type": "websocket",
        "path": "/stream",
        "query_string": b"device_id=sim",
        "headers": [(b"x-request-id", b"w1")],
        "client": ("127.0.0.1", 1),
    }
    asyncio.run(RequestLog(app, ended.append, lambda: False)(scope, None, send))  # type: ignore[arg-type]
    assert sent[0]["headers"] == [(b"a", b"b"), (b"x-request-id", b"w1")]
    assert [(one.kind, one.status, one.route) for one in ended] == [("websocket", 101, "/stream")]
    opened, closed = accesses(caplog)
    assert opened.getMessage().startswith("WEBSOCKET /stream?device_id=sim 101 ")
    assert closed.getMessage().startswith("/stream closed after ")


def test_a_stopping_server_takes_no_requests(sqlite_settings: Settings, live: FakePipeline):
    app = create_app(sqlite_settings, live)
    with TestClient(app) as client:
        app.state.stopping = True
        answer = client.get("/healthz")
        assert (answer.status_code, answer.json()["context"]) == (503, {"part": "server"})
        assert answer.headers["x-request-id"]
