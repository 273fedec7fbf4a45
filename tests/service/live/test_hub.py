"""The hub: each client gets what it asked for; a stalled one is told, and slows nobody."""

import asyncio
import json
from typing import Any

import msgpack
import pytest

from service.live.hub import Hub, Subscription
from service.live.messages import encode


def run(coroutine: Any) -> None:
    asyncio.run(coroutine)


def number(payload: bytes | str) -> Any:
    return json.loads(payload) if isinstance(payload, str) else msgpack.unpackb(payload)


def test_a_slow_client_loses_the_oldest_and_is_told_how_many() -> None:
    async def scenario() -> None:
        hub = Hub()
        slow = Subscription("d", frozenset({"points"}), "json", capacity=3)
        quick = Subscription("d", frozenset({"points"}), "msgpack", capacity=100)
        hub.subscribe(slow)
        hub.subscribe(quick)
        for value in range(10):
            hub.publish("d", {"type": "test", "value": value})
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert [number(await quick.next())["value"] for _ in range(10)] == list(range(10))
        told = number(await slow.next())
        assert told == {"type": "missed", "device": "d", "messages": 7}
        assert [number(await slow.next())["value"] for _ in range(3)] == [7, 8, 9]
        assert slow.missed == 0

    run(scenario())


def test_other_devices_and_former_clients_get_nothing() -> None:
    async def scenario() -> None:
        hub = Hub()
        here = Subscription("d", frozenset({"points"}), "json", 10)
        other = Subscription("e", frozenset({"points"}), "json", 10)
        hub.subscribe(here)
        hub.subscribe(other)
        hub.unsubscribe(here)
        hub.publish("d", {"type": "test"})
        hub.publish("e", {"type": "test"})
        await asyncio.sleep(0)
        assert number(await other.next()) == {"type": "test"}
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(here.next(), 0.05)
        assert (hub.subscribers("d"), hub.subscribers("e")) == (0, 1)

    run(scenario())


def test_publishing_to_a_closed_loop_is_no_error() -> None:
    hub = Hub()

    async def subscribe() -> None:
        hub.subscribe(Subscription("d", frozenset({"points"}), "json", 10))

    run(subscribe())
    hub.publish("d", {"type": "test"})


def test_json_never_holds_nan() -> None:
    with pytest.raises(ValueError, match="JSON"):
        encode({"value": float("nan")}, "json")
