"""The dashboard's benchmark: plain clients that ask as pages do, and what its figures mean."""

import asyncio
import json
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any
from urllib.parse import parse_qs, urlsplit

import pytest

from benchmarks.chromium import Browser, running_browser
from benchmarks.dashboard import growth_mib_h
from benchmarks.dashboard_clients import PageRequests, repeat
from service.cli.bench_dashboard import CONDITIONS, PAGES, measure, noticed_rows, summarise

STREAM_HZ = 50.0


@contextmanager
def answering() -> Iterator[tuple[str, list[str]]]:
    """Run a server that answers each GET; yields its URL and what it was asked for."""
    asked: list[str] = []

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            asked.append(self.path)
            self.send_response(404 if self.path == "/none" else 200)
            self.send_header("Content-Length", "2")
            self.end_headers()
            self.wfile.write(b"{}")

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}", asked
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


async def beside_a_stream(
    gets: tuple[tuple[float, str], ...], *, ends: bool = False
) -> dict[str, Any]:
    """Run two clients for 1.5 s at a stream, and add the subprotocols that were asked for."""
    from websockets.asyncio.server import ServerConnection, serve
    from websockets.exceptions import ConnectionClosed
    from websockets.typing import Subprotocol

    offered: list[str | None] = []

    async def send(connection: ServerConnection) -> None:
        offered.append(connection.subprotocol)
        try:
            while not ends:
                await connection.send(b"frame")
                await asyncio.sleep(1.0 / STREAM_HZ)
        except ConnectionClosed:
            return

    async with serve(send, "127.0.0.1", 0, subprotocols=[Subprotocol("lumiline.v1")]) as server:
        port = server.sockets[0].getsockname()[1]
        stream = (f"ws://127.0.0.1:{port}/stream?rate_hz=50", ("lumiline.v1",))
        found = await repeat(PageRequests((stream,), gets, 0.5), clients=2, seconds=1.5)
    return found | {"offered": offered}


@pytest.mark.slow
def test_plain_clients_ask_as_often_as_the_page_did():
    with answering() as (url, asked):
        gets = ((0.1, f"{url}/state?of=sim"), (0.2, f"{url}/none"))
        found = asyncio.run(beside_a_stream(gets))
    assert set(asked) == {"/state?of=sim", "/none"}
    # Three periods of two clients, of which the last may be begun or not.
    assert 2 * 2 <= asked.count("/state?of=sim") <= 2 * 3
    assert abs(found["answers"] - len(asked)) <= 2
    assert found["refused"] <= asked.count("/none") <= found["refused"] + 2
    assert found["offered"] == ["lumiline.v1"] * 2
    assert 0.0 < found["messages_per_s"] <= STREAM_HZ


def test_plain_clients_say_that_a_stream_ended():
    with pytest.raises(ExceptionGroup) as raised:
        asyncio.run(beside_a_stream((), ends=True))
    assert raised.group_contains(RuntimeError, match="ended the stream")


def test_requests_of_a_page_are_the_same_after_json():
    requests = PageRequests((("ws://a/b?c=d", ("lumiline.v1",)),), ((0.25, "http://a/e"),), 20.0)
    text = json.dumps({"streams": requests.streams, "gets": requests.gets, "period_s": 20.0})
    assert PageRequests.of_json(text) == requests


def one_round(latency_ms: float, lost: int, **more: object) -> dict[str, Any]:
    latency = {"p50": latency_ms, "max": 2.0 * latency_ms}
    return {
        "latency_ms": latency,
        "frames_lost": lost,
        "frames_not_tracked": 0,
        "missed": 1,
        "server_share_of_core": latency_ms / 10.0,
        "machine_busy": 0.5,
        **more,
    }


def test_rounds_have_the_median_latency_the_largest_and_all_losses():
    shares = {"GPU": 0.4, "renderer": 0.1}
    rounds = [one_round(value, 1, share_of_core=shares) for value in (1.0, 9.0, 2.0)]
    found = summarise(rounds)
    assert found["latency_ms"] == {"p50": 2.0, "max": 18.0}
    assert (found["frames_lost"], found["missed"]) == (3, 3)
    assert found["server_share_of_core"] == pytest.approx(0.2)
    assert found["share_of_core"] == pytest.approx(0.5)
    assert found["rounds"] == rounds


def test_latency_is_also_a_multiple_of_that_alone():
    latencies = dict(zip(CONDITIONS, (2.0, 2.1, 6.0, 2.4), strict=True))
    beside = {name: summarise([one_round(ms, 0)]) for name, ms in latencies.items()}
    rows = {row[0]: row[1:] for row in noticed_rows(beside)}
    assert rows["latency p50, ms"] == ("2.00", "2.10 (1.05)", "6.00 (3.00)", "2.40 (1.20)")
    assert rows["frames lost"] == (0, 0, 0, 0)


def test_memory_grows_by_the_slope_of_the_second_half():
    flat_then_rising = [(60.0 * n, 5.0, 100.0 if n < 10 else 100.0 + n) for n in range(20)]
    objects, process = growth_mib_h(flat_then_rising)
    assert objects == pytest.approx(0.0, abs=1e-9)
    assert process == pytest.approx(60.0)
    assert math.isnan(growth_mib_h(flat_then_rising[:4])[0])


@pytest.mark.slow
def test_a_short_run(tmp_path: Path):
    found = measure(tmp_path, 6.0, part_s=2.0, rounds=1, quiet=True)
    (stream, protocols), *others = found["requests"]["streams"]
    assert not others
    query = parse_qs(urlsplit(stream).query)
    assert (query["rate_hz"], protocols) == (["30"], ("lumiline.v1",))
    paths = {urlsplit(url).path for _, url in found["requests"]["gets"]}
    assert "/api/v1/devices/sim/state" in paths
    assert set(found["beside"]) == set(CONDITIONS)
    plain = found["beside"]["plain_clients"]["rounds"][0]
    assert plain["clients"] == PAGES
    assert plain["refused"] == 0
    assert plain["answers"] > 0
    assert plain["messages_per_s"] > 1.0
    # Of a busy machine no more is said.
    assert found["visible"]["pictures_per_s"] > 0.0
    assert found["hidden"]["pictures_after_it"] >= 0
    assert all(one["latency_ms"]["p50"] > 0.0 for one in found["beside"].values())


@pytest.mark.slow
def test_a_browser_with_idle_priority_is_idle_until_the_end_of_it():
    with running_browser() as browser:
        with browser.idle_priority():
            assert policies(browser) == {os.SCHED_IDLE}
        if os.geteuid() == 0:
            assert os.SCHED_IDLE not in policies(browser)


def policies(browser: Browser) -> set[int]:
    found = browser.call("SystemInfo.getProcessInfo")["processInfo"]
    return {os.sched_getscheduler(process["id"]) for process in found}
