"""Streams of a real server: messages, lost connections, what ends them."""

import asyncio
import threading
from collections.abc import Callable
from typing import Any

import httpx
import pytest
from websockets.exceptions import ConnectionClosedError

from lumiline.client import AsyncClient, Client, ServerProblem, ServerUnreachable
from lumiline.client.messages import DeviceState, Frame, Hello, Message

Collect = Callable[..., list[Message]]


@pytest.fixture(params=["sync", "async"])
def collect(request: pytest.FixtureRequest, server: str) -> Collect:
    """Take so many messages of a stream by the one client or the other."""

    def waiting(count: int, device: str = "sim", *args: Any, **named: Any) -> list[Message]:
        with Client(server).stream(device, *args, **named) as stream:
            return [message for message, _ in zip(stream, range(count), strict=False)]

    def together(count: int, device: str = "sim", *args: Any, **named: Any) -> list[Message]:
        async def run() -> list[Message]:
            async with AsyncClient(server).stream(device, *args, **named) as stream:
                return [await anext(stream) for _ in range(count)]

        return asyncio.run(run())

    return waiting if request.param == "sync" else together


def frames_of(messages: list[Message]) -> list[Frame]:
    return [message for message in messages if isinstance(message, Frame)]


def test_a_greeting_and_then_frames_of_what_was_asked_for(collect: Collect) -> None:
    hello, *rest = collect(20, "sim", ("points", "peaks"))
    assert isinstance(hello, Hello)
    assert (hello.device_id, hello.state, hello.calibration_id) == ("sim", "running", "sim-nominal")
    assert hello.content == ("peaks", "points")
    assert len(hello.sensors) == 4
    frames = frames_of(rest)
    assert len(frames) == 19
    for frame in frames:
        assert frame.points is not None
        assert frame.peaks is not None
        assert frame.tracks is None
        (point,) = frame.points
        assert point.position_mm is not None
        assert len(point.position_mm) == 3
        assert point.marker == frame.marker
        assert {peak.sensor for peak in frame.peaks} <= set(hello.sensors)
        assert all(0.0 < peak.sigma_px < 1.0 for peak in frame.peaks)


def test_tools_and_tracks_are_there_when_asked_for(collect: Collect) -> None:
    frames = frames_of(collect(5, "sim", ("tools", "tracks")))
    assert frames
    # Neither tools nor tracks of this device: lists, and empty ones.
    assert all((frame.tools, frame.tracks, frame.points) == ((), (), None) for frame in frames)


@pytest.mark.slow
def test_lossless_has_every_number_also_bundled_and_as_json(collect: Collect) -> None:
    messages = collect(60, "sim", mode="lossless", bundle_ms=50.0)
    hello, frames = messages[0], frames_of(messages)
    assert isinstance(hello, Hello)
    assert [frame.n for frame in frames] == list(range(hello.next, hello.next + len(frames)))
    assert len(frames) == 59


def test_a_stream_goes_on_where_another_program_ended(server: str) -> None:
    with Client(server).stream("sim", mode="lossless") as stream:
        first = [frame for frame, _ in zip(stream.frames(), range(10), strict=False)]
        assert stream.hello is not None
        at = (stream.hello.stream, first[-1].n)
        # Zip asked for one more than it gave.
        assert stream.last == at[1] + 1
    with Client(server).stream("sim", mode="lossless", resume=at) as again:
        later = [frame for frame, _ in zip(again.frames(), range(10), strict=False)]
        assert again.hello is not None
        assert again.hello.resumed
    assert [frame.n for frame in (*first, *later)] == list(range(first[0].n, first[0].n + 20))


def test_a_lost_connection_is_made_again_and_nothing_is_missing(server: str) -> None:
    stream = Client(server).stream("sim", mode="lossless")
    numbers = []
    greetings = 0
    with stream:
        for message in stream:
            if isinstance(message, Frame):
                numbers.append(message.n)
            greetings += isinstance(message, Hello)
            if len(numbers) in {10, 25} and len(numbers) >= 10 * greetings:
                assert stream._socket is not None
                stream._socket.socket.shutdown(2)
            if len(numbers) == 60:
                break
    assert numbers == list(range(numbers[0], numbers[0] + 60))
    assert stream.reconnections >= 2
    assert greetings == stream.reconnections + 1


def test_a_lost_connection_is_made_again_with_asyncio(server: str) -> None:
    async def run() -> list[int]:
        numbers: list[int] = []
        async with AsyncClient(server).stream("sim", mode="lossless") as stream:
            async for frame in stream.frames():
                numbers.append(frame.n)
                if len(numbers) == 10:
                    assert stream._socket is not None
                    stream._socket.transport.abort()
                if len(numbers) == 40:
                    break
            assert stream.reconnections == 1
        return numbers

    numbers = asyncio.run(run())
    assert numbers == list(range(numbers[0], numbers[0] + 40))


def test_without_reconnection_a_lost_connection_is_an_error(server: str) -> None:
    with Client(server).stream("sim", reconnect_s=0.0) as stream:
        next(stream)
        assert stream._socket is not None
        stream._socket.socket.shutdown(2)
        with pytest.raises(ServerUnreachable, match="was lost") as caught:
            list(stream)
    assert isinstance(caught.value.__cause__, ConnectionClosedError)


def test_what_the_server_refuses_is_its_problem(collect: Collect) -> None:
    with pytest.raises(ServerProblem) as caught:
        collect(1, "nobody")
    assert (caught.value.status, caught.value.code) == (404, "unknown-device")
    with pytest.raises(ServerProblem, match="invalid-parameter") as caught:
        collect(1, "sim", ("poses",))
    assert "poses" in caught.value.detail


def test_a_server_that_is_not_there_is_told_at_once() -> None:
    with pytest.raises(ServerUnreachable, match="could not be opened"):
        Client("http://127.0.0.1:9").stream("sim").__enter__()


def test_states_come_as_messages_and_a_deleted_device_ends_its_streams(server: str) -> None:
    source = {"kind": "simulated", "settings": {"frame_rate_hz": 50}}
    body = {"id": "brief", "title": "Brief", "source": source}
    httpx.post(f"{server}/api/v1/devices", json=body).raise_for_status()
    with Client(server) as client, client.stream("brief", ("state",)) as stream:
        assert stream.hello is not None
        assert stream.hello.state == "stopped"
        client.start_device("brief")
        httpx.delete(f"{server}/api/v1/devices/brief").raise_for_status()
        states = [message.state for message in stream if isinstance(message, DeviceState)]
    # The iteration has ended by itself.
    assert states[0] == "starting"
    assert states[-1] == "deleted"


def test_a_stream_can_be_closed_while_it_waits(server: str) -> None:
    with Client(server).stream("sim", ("state",)) as stream:
        next(stream)
        timer = threading.Timer(0.2, stream.close)
        timer.start()
        assert list(stream) == []
        timer.join()


def test_only_a_lossless_stream_is_resumed(server: str) -> None:
    with pytest.raises(ValueError, match="lossless"):
        Client(server).stream("sim", resume=("x", 1))
