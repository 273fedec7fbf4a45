"""The hub: each client gets what it asked for; a stalled one is told, and slows nobody."""

import asyncio
import itertools
import json
import threading
import time
import weakref
from collections.abc import Coroutine
from dataclasses import replace
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.reconstruction.point_batch import PointBatch
from compute.signal.peaks import PeakBatch
from hardware.line_frame import LineFrame
from service.pipeline.frame_batch import FrameBatch
from service.protocols.stream.hub import Hub, StreamEnded, StreamRequest, Subscription
from service.protocols.stream.messages import StreamBatch, encode

POINTS = frozenset({"points"})


def run(coroutine: Coroutine[Any, Any, None]) -> None:
    asyncio.run(coroutine)


def read(payload: bytes | str) -> Any:
    return json.loads(payload) if isinstance(payload, str) else msgpack.unpackb(payload)


def frames_of(sequences: range, device: str = "d", peaks_a_line: int = 0) -> FrameBatch:
    """A batch with one point a frame, whose x is the sequence number."""
    count = len(sequences)
    lines = np.zeros((2, 8), np.uint16)
    frames = tuple(LineFrame(device, n, n * 10, n * 10 + 1, None, lines) for n in sequences)
    position = np.zeros((count, 3))
    position[:, 0] = list(sequences)
    points = PointBatch(
        position,
        np.broadcast_to(np.eye(3), (count, 3, 3)),
        np.zeros(count),
        np.full(count, np.inf),
        np.ones((count, 2), dtype=np.bool_),
        np.zeros(count, np.int32),
    )
    peaks = PeakBatch.empty(2 * count, 3)
    peaks.count[:] = peaks_a_line
    for line in range(2 * count):
        peaks.position_px[line, :peaks_a_line] = 100 * line + np.arange(peaks_a_line)
        for column in (peaks.sigma_px, peaks.amplitude, peaks.width_px):
            column[line, :peaks_a_line] = 1.0
    return FrameBatch(device, ("a", "b"), "c", None, frames, peaks, points, np.arange(count))


async def taken(client: Subscription, most: int = 1_000_000) -> list[Any]:
    """All that a client can have now."""
    found: list[Any] = []
    while len(found) < most:
        try:
            async with asyncio.timeout(0.02):
                found.append(read(await client.next()))
        except TimeoutError:
            return found
    return found


def sequences(messages: list[Any]) -> list[int]:
    return [message["sequence"] for message in messages if message["type"] == "frame"]


def test_every_frame_once_and_in_order_with_its_number() -> None:
    async def scenario() -> None:
        hub = Hub()
        clients = [
            hub.subscribe(StreamRequest("d", POINTS, "json")),
            hub.subscribe(StreamRequest("d", POINTS, "msgpack", lossless=True)),
        ]
        hub.publish_batch(frames_of(range(5)))
        hub.publish("d", {"type": "state", "state": "x"})
        hub.publish_batch(frames_of(range(5, 7)))
        for client in clients:
            messages = await taken(client)
            assert [message["n"] for message in messages] == list(range(8))
            assert sequences(messages) == list(range(7))
            assert messages[5] == {"type": "state", "state": "x", "n": 5}
            assert [m["points"][0]["position_mm"][0] for m in messages if "points" in m] == list(
                range(7)
            )

    run(scenario())


def test_a_live_client_that_falls_behind_gets_the_newest_and_is_told() -> None:
    async def scenario() -> None:
        hub = Hub(lag_s=0.0)
        slow = hub.subscribe(StreamRequest("d", POINTS, "json"))
        quick = hub.subscribe(StreamRequest("d", POINTS, "json"))
        for first in range(0, 40, 4):
            hub.publish_batch(frames_of(range(first, first + 4)))
            assert sequences(await taken(quick)) == list(range(first, first + 4))
            if first == 20:
                hub.publish("d", {"type": "state", "state": "x"})
                await taken(quick)
        messages = await taken(slow)
        # 40 frames and a status message: the newest frame is number 40. A status is never left out.
        assert [message["type"] for message in messages] == ["missed", "state", "missed", "frame"]
        assert messages[0] == {"type": "missed", "device_id": "d", "messages": 24, "first": 0}
        assert messages[2] == {"type": "missed", "device_id": "d", "messages": 15, "first": 25}
        assert (messages[3]["sequence"], messages[3]["n"]) == (39, 40)

    run(scenario())


def test_a_slow_client_is_known_by_what_waits_and_what_it_missed() -> None:
    async def scenario() -> None:
        hub = Hub(lag_s=0.0)
        wanted = StreamRequest("d", frozenset({"points"}), "json")
        slow = hub.subscribe(wanted, "key navigation")
        newest = hub.subscribe(replace(wanted, rate_hz=10.0))
        for first in range(0, 30, 10):
            hub.publish_batch(frames_of(range(first, first + 10)))
        assert hub.subscriptions() == [slow, newest]
        assert (slow.client, slow.waiting, slow.missed) == ("key navigation", 30, 0)
        await taken(slow)
        assert (slow.waiting, newest.waiting, newest.missed) == (0, 0, 0)
        assert slow.missed > 0

    run(scenario())


def test_a_lossless_client_lacks_only_what_is_not_kept() -> None:
    async def scenario() -> None:
        hub = Hub(kept_messages=10, lag_s=0.0)
        client = hub.subscribe(StreamRequest("d", POINTS, "json", lossless=True))
        for first in range(0, 8, 4):
            hub.publish_batch(frames_of(range(first, first + 4)))
        assert sequences(await taken(client, 3)) == [0, 1, 2]
        for first in range(8, 24, 4):
            hub.publish_batch(frames_of(range(first, first + 4)))
        messages = await taken(client)
        # Eight are kept, in two batches; from the very end it might fall off again at once.
        assert messages[0] == {"type": "missed", "device_id": "d", "messages": 17, "first": 3}
        assert sequences(messages) == list(range(20, 24))

    run(scenario())


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.5, 0.8, 0.95])
def test_a_lossless_client_that_is_a_little_too_slow_gets_nearly_what_it_can_take(
    share: float,
) -> None:
    async def scenario() -> None:
        hub = Hub(kept_messages=100)
        client = hub.subscribe(StreamRequest("d", POINTS, "json", lossless=True))
        frames = told = 0
        credit = 0.0
        for sequence in range(4000):
            hub.publish_batch(frames_of(range(sequence, sequence + 1)))
            credit += share
            while credit >= 1.0:
                credit -= 1.0
                taken = client._cursor.take(due=True)
                if taken is not None and sequence >= 2000:
                    frames += taken.frames
                    told += not taken.frames
        assert frames > 0.9 * share * 2000
        assert told < 0.05 * frames

    run(scenario())


def test_a_bundle_that_falls_off_loses_nothing_that_it_does_not_tell() -> None:
    """Messages come from another thread all the while, and the client is too slow for them."""

    async def scenario(lossless: bool) -> None:
        hub = Hub(kept_messages=300, lag_s=0.002)
        client = hub.subscribe(StreamRequest("d", POINTS, "json", lossless=lossless, bundle_s=0.0))
        ended = threading.Event()

        def publish() -> None:
            for sequence in itertools.count(0, 3):
                if ended.is_set():
                    return
                hub.publish_batch(frames_of(range(sequence, sequence + 3)))

        thread = threading.Thread(target=publish)
        thread.start()
        place = told = 0
        begin = time.monotonic()
        while (passed := time.monotonic() - begin) < 0.3 or (not told and passed < 30.0):
            found = client._cursor.take(due=True)
            message = {"type": "none"} if found is None else read(found.payload)
            if message["type"] == "missed":
                assert message["first"] == place
                place += message["messages"]
                told += 1
            for frame in message.get("frames", []):
                assert frame["n"] == place
                place += 1
        ended.set()
        thread.join()
        assert told, "it was quick enough: nothing was tested"

    run(scenario(lossless=True))
    run(scenario(lossless=False))


def test_a_client_that_comes_back_goes_on_where_it_was() -> None:
    async def scenario() -> None:
        hub = Hub()
        first = hub.subscribe(StreamRequest("d", POINTS, "json", lossless=True))
        hub.publish_batch(frames_of(range(10)))
        last = (await taken(first, 4))[-1]["n"]
        hub.unsubscribe(first)
        hub.publish_batch(frames_of(range(10, 12)))
        stream = hub.log("d").id
        again = hub.subscribe(
            StreamRequest("d", POINTS, "json", lossless=True, stream=stream, after=last)
        )
        assert again.resumed
        assert sequences(await taken(again)) == list(range(4, 12))
        # Of another log the numbers mean nothing: all that is there.
        other = hub.subscribe(
            StreamRequest("d", POINTS, "json", lossless=True, stream="x", after=last)
        )
        assert not other.resumed
        assert sequences(await taken(other)) == list(range(12))
        # A number that was never given is not waited for.
        ahead = hub.subscribe(
            StreamRequest("d", POINTS, "json", lossless=True, stream=stream, after=99)
        )
        hub.publish_batch(frames_of(range(12, 13)))
        assert sequences(await taken(ahead)) == [12]

    run(scenario())


@pytest.mark.slow
def test_at_a_rate_the_newest_frame_and_every_status_at_once() -> None:
    async def scenario() -> None:
        hub = Hub()
        client = hub.subscribe(StreamRequest("d", POINTS, "json", rate_hz=1.0))
        hub.publish_batch(frames_of(range(3)))
        assert sequences(await taken(client)) == [2]
        hub.publish_batch(frames_of(range(3, 6)))
        hub.publish("d", {"type": "state", "state": "x"})
        messages = await taken(client)
        assert [message["type"] for message in messages] == ["state"]
        async with asyncio.timeout(240.0):
            later = read(await client.next())
        assert (later["type"], later["sequence"]) == ("frame", 5)

    run(scenario())


def test_bundles_hold_every_frame_and_no_status() -> None:
    async def scenario() -> None:
        hub = Hub()
        clients = [
            hub.subscribe(StreamRequest("d", POINTS, encoding, bundle_s=0.01))
            for encoding in ("json", "msgpack")
        ]
        hub.publish_batch(frames_of(range(3)))
        hub.publish_batch(frames_of(range(3, 700)))
        hub.publish("d", {"type": "state", "state": "x"})
        hub.publish_batch(frames_of(range(700, 702)))
        for client in clients:
            messages = await taken(client)
            kinds = [message["type"] for message in messages]
            assert kinds == ["frames", "frames", "state", "frames"]
            assert {message["device_id"] for message in messages if "frames" in message} == {"d"}
            frames = [f for message in messages for f in message.get("frames", [])]
            assert sequences(frames) == list(range(702))
            alone = hub.log("d").since(0, 1)[0].payload((POINTS, "json"), 2)
            assert frames[2] == read(alone)

    run(scenario())


def test_without_content_there_are_status_messages_only() -> None:
    async def scenario() -> None:
        hub = Hub()
        hub.publish("d", {"type": "state", "state": "before"})
        client = hub.subscribe(StreamRequest("d", frozenset(), "json"))
        hub.publish_batch(frames_of(range(3)))
        hub.publish("d", {"type": "state", "state": "x"})
        assert [message["type"] for message in await taken(client)] == ["state"]
        again = hub.subscribe(
            StreamRequest("d", frozenset(), "json", lossless=True, stream=hub.log("d").id, after=0)
        )
        assert [message["state"] for message in await taken(again)] == ["x"]

    run(scenario())


def test_other_devices_and_former_clients_get_nothing() -> None:
    async def scenario() -> None:
        hub = Hub()
        here = hub.subscribe(StreamRequest("d", POINTS, "json"))
        other = hub.subscribe(StreamRequest("e", POINTS, "json"))
        hub.unsubscribe(here)
        hub.publish("e", {"type": "test"})
        assert await taken(other) == [{"type": "test", "n": 0}]
        assert (hub.subscribers("d"), hub.subscribers("e")) == (0, 1)

    run(scenario())


def test_a_deleted_device_ends_its_streams_after_the_last_message() -> None:
    async def scenario() -> None:
        hub = Hub()
        client = hub.subscribe(StreamRequest("d", POINTS, "json", bundle_s=1.0))
        hub.publish_batch(frames_of(range(2)))
        stream = hub.log("d").id
        hub.end("d")
        await asyncio.sleep(0)
        kinds = [read(await client.next())["type"] for _ in range(2)]
        assert kinds == ["frames", "state"]
        with pytest.raises(StreamEnded):
            await client.next()
        # A device of the same name that is made later has a log of its own.
        assert hub.log("d").id != stream

    run(scenario())


def test_publishing_to_a_closed_loop_is_no_error() -> None:
    hub = Hub()

    async def subscribe() -> None:
        hub.subscribe(StreamRequest("d", POINTS, "json"))

    run(subscribe())
    hub.publish("d", {"type": "test"})


@settings(deadline=None, max_examples=60)
@given(
    st.lists(st.one_of(st.integers(1, 7), st.just("state"), st.just("read")), max_size=40),
    st.integers(1, 20),
    st.booleans(),
)
def test_whatever_comes_what_a_client_gets_and_what_it_missed_add_up(
    events: list[int | str], kept: int, lossless: bool
) -> None:
    async def scenario() -> None:
        hub = Hub(kept_messages=kept, lag_s=0.0)
        client = hub.subscribe(StreamRequest("d", POINTS, "json", lossless=lossless))
        got: list[Any] = []
        sequence = 0
        for event in events:
            if event == "read":
                got += [one for one in [client._cursor.take(due=True)] if one is not None]
            elif event == "state":
                hub.publish("d", {"type": "state", "state": "x"})
            else:
                hub.publish_batch(frames_of(range(sequence, sequence + int(event))))
                sequence += int(event)
        while (one := client._cursor.take(due=True)) is not None:
            got.append(one)
        place = 0
        for message in [read(one.payload) for one in got]:
            if message["type"] == "missed":
                assert message["first"] == place
                place += message["messages"]
            else:
                assert message["n"] == place
                place += 1
        assert place == hub.log("d").next
        if not lossless:
            statuses = [m for m in (read(one.payload) for one in got) if m["type"] == "state"]
            if kept == 20 and len(events) <= 20 and sequence <= 10:
                assert len(statuses) == events.count("state")

    run(scenario())


def test_messages_of_a_part_of_a_batch_are_those_of_the_whole() -> None:
    batch = StreamBatch(frames_of(range(5), peaks_a_line=2))
    content = frozenset({"points", "peaks"})
    whole = batch.messages(content)
    assert [message["sequence"] for message in whole] == list(range(5))
    for first in range(5):
        for last in range(first, 6):
            assert batch.messages(content, first, last) == whole[first:last]
    assert [peak["position_px"] for peak in whole[3]["peaks"]] == [600.0, 601.0, 700.0, 701.0]
    assert [peak["sensor"] for peak in whole[3]["peaks"]] == ["a", "a", "b", "b"]
    assert {peak["reduced_chi2"] for peak in whole[3]["peaks"]} == {None}


def test_nothing_that_is_kept_holds_on_to_the_pixels() -> None:
    batch = frames_of(range(2))
    pixels, peaks = weakref.ref(batch.frames[0].lines), weakref.ref(batch.peaks.position_px)
    hub = Hub()
    hub.publish_batch(batch)
    del batch
    assert hub.log("d").message_count == 2
    assert pixels() is None
    assert peaks() is None


def test_json_never_holds_nan() -> None:
    with pytest.raises(ValueError, match="JSON"):
        encode({"value": float("nan")}, "json")
