"""Idempotency-Key: the same request again gets the same answer and makes nothing."""

from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from threading import Event
from typing import Any

import pytest
from sqlalchemy import select, update

from service.api import idempotency
from service.api.beam_holds import store
from service.api.idempotency import forget_unfinished
from service.application.app import create_app
from service.database.models import AuditRow, IdempotencyKeyRow
from service.settings import Settings
from tests.openapi_document import openapi_document
from tests.service.api.beam_holds.test_beam_holds_api import CHEST
from tests.service.fake_pipeline import FakePipeline, TestClient

HOLDS = "/api/v1/beam-holds"
READINGS = {"device_id": "sim", "points": [{"name": "a", "readings": {}}]}


def send(client: Any, body: Any = CHEST, key: str = "k-1", path: str = HOLDS) -> Any:
    return client.post(path, json=body, headers={"Idempotency-Key": key})


def code(answer: Any) -> tuple[int, str]:
    return answer.status_code, answer.json()["type"].removeprefix("/problems/")


def rows(client: Any) -> list[IdempotencyKeyRow]:
    with client.app.state.database.read() as session:
        return list(session.scalars(select(IdempotencyKeyRow)))


def acts(client: Any, operation: str) -> int:
    with client.app.state.database.read() as session:
        return len(list(session.scalars(select(AuditRow).where(AuditRow.operation == operation))))


def test_same_request_again_gets_the_same_answer(client: Any) -> None:
    first = send(client)
    assert first.status_code == 201
    assert "idempotent-replayed" not in first.headers
    for _ in range(2):
        again = send(client)
        assert (again.status_code, again.content) == (201, first.content)
        assert again.headers["location"] == first.headers["location"]
        assert again.headers["content-type"] == first.headers["content-type"]
        assert again.headers["idempotent-replayed"] == "true"
    assert len(client.get(HOLDS).json()["items"]) == 1
    assert acts(client, "create-beam-hold") == 1
    # Also after what it made is gone: the answer is that of the request.
    client.delete(f"{HOLDS}/chest")
    assert send(client).content == first.content
    assert client.get(HOLDS).json()["items"] == []


def test_resource_with_an_id_of_the_server_is_made_once(client: Any) -> None:
    path = "/api/v1/reconstructions"
    first, again = (send(client, READINGS, path=path) for _ in range(2))
    assert first.status_code == 201, first.text
    assert again.json() == first.json()
    assert send(client, READINGS, "k-2", path).json()["id"] != first.json()["id"]
    assert len(client.get(path).json()["items"]) == 2


def test_key_of_another_request_is_refused(client: Any) -> None:
    assert send(client).status_code == 201
    for body, path in (
        ({**CHEST, "id": "head"}, HOLDS),
        (CHEST, "/api/v1/tools"),
        (READINGS, "/api/v1/reconstructions"),
    ):
        refused = send(client, body, path=path)
        assert code(refused) == (422, "idempotency-key-reused")
        assert refused.json()["context"] == {"key": "k-1"}
    assert len(client.get(HOLDS).json()["items"]) == 1


def test_refused_request_may_be_sent_again(client: Any) -> None:
    wrong = {**CHEST, "device_id": "nothing"}
    assert code(send(client, wrong)) == (404, "unknown-device")
    assert rows(client) == []
    assert send(client).status_code == 201


@pytest.mark.parametrize("key", ["", "two words", "ä", "x" * 256])
def test_key_of_another_form_is_refused(sqlite_client: Any, key: str) -> None:
    headers = {"Idempotency-Key": key.encode("latin-1")}
    refused = sqlite_client.post(HOLDS, json=CHEST, headers=headers)
    assert code(refused) == (422, "invalid-idempotency-key")
    assert sqlite_client.get(HOLDS).json()["items"] == []


def test_of_two_at_once_one_is_carried_out(client: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    began, go_on = Event(), Event()
    add = store.add_beam_hold

    def slow(*args: Any) -> Any:
        began.set()
        assert go_on.wait(240.0)
        return add(*args)

    monkeypatch.setattr(store, "add_beam_hold", slow)
    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(send, client)
        assert began.wait(240.0)
        if client.app.state.database.engine.dialect.name == "postgresql":
            second = send(client)
            assert code(second) == (409, "request-in-progress")
            assert second.headers["retry-after"] == "1"
            assert code(send(client, {**CHEST, "id": "head"})) == (422, "idempotency-key-reused")
        go_on.set()
        assert first.result(10).status_code == 201
    assert send(client).content == first.result().content


def test_of_many_at_once_one_is_carried_out(client: Any) -> None:
    with ThreadPoolExecutor(8) as pool:
        answers = [one.result(30) for one in [pool.submit(send, client) for _ in range(8)]]
    statuses = [answer.status_code for answer in answers]
    assert set(statuses) <= {201, 409}
    assert len({answer.content for answer in answers if answer.status_code == 201}) == 1
    refused = {code(answer) for answer in answers if answer.status_code == 409}
    assert refused <= {(409, "request-in-progress")}
    assert acts(client, "create-beam-hold") - statuses.count(409) == 1


def test_unfinished_request_of_a_server_that_ended_is_forgotten(sqlite_settings: Settings) -> None:
    with TestClient(create_app(sqlite_settings, FakePipeline())) as client:
        assert send(client).status_code == 201
        with client.app.state.database.write() as session:
            session.execute(update(IdempotencyKeyRow).values(status=None))
        assert code(send(client)) == (409, "request-in-progress")
    with TestClient(create_app(sqlite_settings, FakePipeline())) as client:
        assert rows(client) == []
        assert code(send(client)) == (409, "beam-hold-exists")


def test_unfinished_request_of_a_running_server_is_kept_when_another_starts(
    client: Any, settings: Settings
) -> None:
    """The first would carry the same request out a second time otherwise."""
    assert send(client).status_code == 201
    begun = datetime.now(UTC) - timedelta(minutes=1)
    with client.app.state.database.write() as session:
        session.execute(update(IdempotencyKeyRow).values(status=None, created_at=begun))
    with TestClient(create_app(settings, FakePipeline())) as other:
        assert code(send(other)) == (409, "request-in-progress")
        assert code(send(client)) == (409, "request-in-progress")


def test_unfinished_request_is_abandoned_after_a_while(sqlite_client: Any) -> None:
    """Its server has ended, and others on the database have never all been down since."""
    send(sqlite_client)
    for age, answer in (
        (idempotency.ABANDONED_AFTER - timedelta(minutes=1), "request-in-progress"),
        (idempotency.ABANDONED_AFTER, "beam-hold-exists"),
    ):
        created = datetime.now(UTC) - age
        with sqlite_client.app.state.database.write() as session:
            session.execute(update(IdempotencyKeyRow).values(created_at=created, status=None))
        assert code(send(sqlite_client)) == (409, answer)


def test_finished_requests_stay_known_after_a_start(sqlite_client: Any) -> None:
    first = send(sqlite_client)
    forget_unfinished(sqlite_client.app.state.database, datetime.now(UTC))
    assert send(sqlite_client).content == first.content


def test_answers_are_kept_for_a_day(sqlite_client: Any) -> None:
    send(sqlite_client)
    for age, kept in (
        (idempotency.LIFETIME - timedelta(minutes=1), True),
        (idempotency.LIFETIME, False),
    ):
        with sqlite_client.app.state.database.write() as session:
            session.execute(update(IdempotencyKeyRow).values(created_at=datetime.now(UTC) - age))
        again = send(sqlite_client)
        assert (again.status_code == 201) is kept
    assert code(again) == (409, "beam-hold-exists")


def test_keys_are_of_a_credential(sqlite_client: Any) -> None:
    keys = [
        sqlite_client.post("/api/v1/keys", json={"name": "n", "scopes": ["write:holds"]}).json()[
            "key"
        ]
        for _ in range(2)
    ]
    answers = [
        sqlite_client.post(
            HOLDS,
            json={**CHEST, "id": f"hold-{number}"},
            headers={"Idempotency-Key": "same", "Authorization": f"Bearer {key}"},
        )
        for number, key in enumerate(keys)
    ]
    assert [answer.status_code for answer in answers] == [201, 201]


def test_a_new_key_is_never_kept(sqlite_client: Any) -> None:
    body = {"name": "n", "scopes": ["read:stream"]}
    first, again = (send(sqlite_client, body, path="/api/v1/keys") for _ in range(2))
    assert first.json()["key"] != again.json()["key"]
    assert rows(sqlite_client) == []


def test_the_contract_names_the_operations_that_take_a_key(sqlite_client: Any) -> None:
    taking, creating = set(), set()
    for item in openapi_document()["paths"].values():
        for method, operation in item.items():
            names = {one["name"] for one in operation.get("parameters", ())}
            if "Idempotency-Key" in names:
                taking.add(operation["operationId"])
                assert {"409", "422"} <= operation["responses"].keys()
            if method == "post" and {"201", "202"} & operation["responses"].keys():
                creating.add(operation["operationId"])
    assert taking == creating - {"create-key", "create-webhook"}
    assert len(taking) > 15
