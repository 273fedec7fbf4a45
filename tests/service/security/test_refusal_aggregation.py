"""Refusals in the audit log: the first has an entry, those that follow one with their count."""

import asyncio
from typing import Any

import pytest

from service.application.app import create_app
from service.principal import Act, Principal
from service.security.guard import Guard
from service.security.refusal_aggregation import RefusalAggregator
from service.security.store import make_key
from service.settings import Settings
from tests.service.fake_pipeline import FakePipeline, TestClient
from tests.service.security.conftest import Secured, key_id


def act(who: str, operation: str = "stop-device") -> Act:
    return Act(Principal("key", who, who, frozenset()), operation)


class Told:
    """Takes what is told, late, as a database does."""

    def __init__(self) -> None:
        self.all: list[tuple[str, str, int]] = []

    async def __call__(self, told: Act, more: int) -> None:
        await asyncio.sleep(0)
        self.all.append((told.principal.id, told.operation, more))


def test_those_of_one_key_and_operation_are_folded() -> None:
    async def scenario() -> None:
        told = Told()
        refusals = RefusalAggregator(told)
        firsts = [refusals.is_first(act("a")) for _ in range(5)]
        assert firsts == [True] + 4 * [False]
        assert refusals.is_first(act("a", "start-device"))
        assert [refusals.is_first(act("b")) for _ in range(2)] == [True, False]
        await refusals.close()
        assert sorted(told.all) == [("a", "stop-device", 4), ("b", "stop-device", 1)]
        assert len(refusals) == 0
        assert refusals.is_first(act("a"))
        await refusals.close()

    asyncio.run(scenario())


def test_they_are_told_of_without_another_request() -> None:
    async def scenario() -> None:
        told = Told()
        refusals = RefusalAggregator(told, aggregation_s=0.01)
        for _ in range(3):
            refusals.is_first(act("a"))
        while not told.all:
            await asyncio.sleep(0.01)
        assert told.all == [("a", "stop-device", 2)]
        assert refusals.is_first(act("a"))

    asyncio.run(scenario())


def test_memory_is_bounded_and_nothing_is_lost() -> None:
    async def scenario() -> None:
        told = Told()
        refusals = RefusalAggregator(told, max_entries=3)
        for number in range(10):
            for _ in range(number + 1):
                refusals.is_first(act(str(number)))
            assert len(refusals) <= 3
        await refusals.close()
        assert told.all == [(str(number), "stop-device", number) for number in range(1, 10)]

    asyncio.run(scenario())


def refused(secured: Secured, **query: str) -> list[dict[str, Any]]:
    admin = secured.key("read:audit")
    answer = secured.client.get(
        "/api/v1/audit", params={"outcome": "refused", "limit": 200, **query},
        headers={"authorization": f"Bearer {admin}"},
    )  # fmt: skip
    found: list[dict[str, Any]] = answer.json()["items"]
    return found


def test_a_key_cannot_fill_the_log(tmp_path: Any) -> None:
    settings = Settings(data_dir=tmp_path, authentication="required")
    app = create_app(settings, FakePipeline())
    with TestClient(app) as client:
        secured = Secured(client)
        key = secured.key("read:stream")
        for number in range(20):
            path = f"/api/v1/devices/d{number}/stop"
            assert secured.ask("POST", path, key).status_code == 403
        assert secured.ask("POST", "/api/v1/devices/sim/start", key).status_code == 403
        found = refused(secured, actor_id=key_id(key))
        assert [one["operation"] for one in found] == ["start-device", "stop-device"]
        assert found[1]["object_id"] == "d0"
    # The server ends, and tells of the others before.
    with TestClient(create_app(settings, FakePipeline())) as client:
        found = refused(Secured(client), actor_id=key_id(key))
        assert len(found) == 3
        assert (found[0]["operation"], found[0]["object_id"]) == ("stop-device", None)
        assert found[0]["detail"].startswith("19 more of this operation")


@pytest.mark.parametrize("encoded", ["_", "%5F", "%255F"])
def test_a_whole_key_in_a_path_is_not_kept_for_good(secured: Secured, encoded: str) -> None:
    whole = make_key().text
    key = secured.key("read:stream")
    path = f"/api/v1/keys/{whole.replace('_', encoded)}/revoke"
    assert secured.ask("POST", path, key).status_code == 403
    [entry] = refused(secured, actor_id=key_id(key))
    assert (entry["object_kind"], entry["object_id"]) == ("key", "lumi_***")


def test_the_guard_passes_the_lifespan_on() -> None:
    heard: list[str] = []

    async def app(_scope: Any, receive: Any, _send: Any) -> None:
        heard.append((await receive())["type"])
        heard.append((await receive())["type"])

    messages = [{"type": "lifespan.startup"}, {"type": "lifespan.shutdown"}]

    async def receive() -> Any:
        return messages.pop(0)

    asyncio.run(Guard(app, Settings())({"type": "lifespan"}, receive, None))  # type: ignore[arg-type]
    assert heard == ["lifespan.startup", "lifespan.shutdown"]
