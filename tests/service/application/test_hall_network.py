"""Two bars, a broker and two servers on machines of their own: links are cut, processes killed.

What is asserted holds however slow the machine is; how long things took is printed (-s).
"""

import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import httpx
import pytest
from sqlalchemy import select

from service.database.engine import Database
from service.database.models import CalibrationRow
from service.principal import SCOPES
from service.security import store
from tests.nats_server import NatsServer
from tests.service.application.network import DatabaseProxy, Network
from tests.service.application.stations import GatewayServer, Station, wait_until
from tests.service.application.test_stations import MARKERS_MM, SOURCE
from tests.service.conftest import postgres_copy

pytestmark = [pytest.mark.slow, pytest.mark.postgres]

CUT_S: Final = float(os.environ.get("LUMILINE_TEST_CUT_S", "5"))
"""How long a link stays cut."""
BARS: Final = ("bar-1", "bar-2")


class Hall:
    """All machines; the test's own is "desk"."""

    def __init__(self, folder: Path, database: str) -> None:
        self.network = Network(("centre", *BARS, "server-1", "server-2", "desk"))
        try:
            self.proxy = DatabaseProxy(self.network, database)
            centre = self.network.address("centre")
            with self.network.on("centre"):
                self.broker = NatsServer(folder, host=centre)
                self.broker.start()
            self.stations = {
                name: Station(name, folder, self.broker.url, self.proxy.url) for name in BARS
            }
            self.gateways = {
                name: GatewayServer(
                    name,
                    folder,
                    self.broker.url,
                    self.proxy.url,
                    host=self.network.address(name),
                )
                for name in ("server-1", "server-2")
            }
        except BaseException:
            self.network.close()
            raise

    def close(self) -> None:
        for one in (*self.gateways.values(), *self.stations.values()):
            one.kill(signal.SIGTERM)
        self.broker.kill()
        self.proxy.close()
        self.network.close()

    def start(self, name: str) -> None:
        """Start a process on its machine."""
        with self.network.on(name):
            (self.stations | self.gateways)[name].begin()

    def held(self, gateway: GatewayServer, bar: str) -> bool:
        return bool(gateway.get(f"/beam-holds/beam-{bar}/state")["held"])

    def whole(self, gateway: GatewayServer, bar: str) -> bool:
        try:
            found = gateway.station(bar)
        except httpx.TransportError:
            return False  # it starts
        return (
            found is not None
            and found["state"] == "running"
            and gateway.running(bar)
            and not self.held(gateway, bar)
        )


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory, new_postgres: str | None) -> Iterator[Hall]:
    """Both devices run, each with a beam hold that lets the beam go on."""
    if new_postgres is None:
        pytest.skip("databases may not be made in the PostgreSQL server for tests")
    copies = postgres_copy(new_postgres)
    url = next(copies)
    database = Database(url)
    with database.write() as session:
        _, key = store.add_key(session, "test", SCOPES)
    database.close()
    made = Hall(tmp_path_factory.mktemp("hall"), url)
    try:
        for name in (*BARS, *made.gateways):
            made.start(name)
        with made.network.on("desk"):
            for gateway in made.gateways.values():
                gateway.key = key.text
                wait_until(gateway.answers, "the server's start")
            first = made.gateways["server-1"]
            for bar in BARS:
                wait_until(lambda bar=bar: (first.station(bar) or {}).get("state") == "running")
                create(made, bar)
            wait_for_all(made)
            yield made
    finally:
        made.close()
        next(copies, None)


def create(hall: Hall, bar: str) -> None:
    """Make the device of a bar, with a calibration, and a beam hold."""
    gateway = hall.gateways["server-1"]
    watch = {"kind": "strobed-markers", "markers": list(range(len(MARKERS_MM)))}
    device = {"id": bar, "title": bar, "station": bar, "source": SOURCE, "autostart": True}
    hold = {
        "id": f"beam-{bar}", "device_id": bar, "title": bar, "watch": watch,
        "limits": {"shift_mm": 20.0},
        "rules": {"max_gap_s": 0.5, "settle_s": 0.1},
        "reference": {"positions_mm": SOURCE["settings"]["scene"]["points_mm"]},
    }  # fmt: skip
    for path, body in (
        ("/devices", device),
        (f"/calibrations/{bar}-nominal/activate", None),
        (f"/devices/{bar}/start", None),
        ("/beam-holds", hold),
    ):
        answer = gateway.request("POST", path, body)
        assert answer.status_code < 300, answer.text
        if body is device:
            copy_calibration(hall.proxy.url, bar)


def copy_calibration(url: str, device: str) -> None:
    """Store the calibration of the simulated bar for another that is like it."""
    database = Database(url)
    with database.write() as session:
        row = session.scalars(select(CalibrationRow).limit(1)).one()
        members = {one.name: getattr(row, one.name) for one in CalibrationRow.__table__.columns}
        session.add(CalibrationRow(**members | {"id": f"{device}-nominal", "device_id": device}))
    database.close()


def wait_for_all(hall: Hall) -> None:
    for gateway in hall.gateways.values():
        for bar in BARS:
            wait_until(lambda g=gateway, b=bar: hall.whole(g, b), f"that {bar} runs again")


def observe(hall: Hall, what: str, act: Callable[[], None], undo: Callable[[], None]) -> None:
    begin = time.monotonic()
    act()
    time.sleep(CUT_S)
    undo()
    back = time.monotonic()
    wait_for_all(hall)
    now = time.monotonic()
    print(f"{what}: cut {back - begin:.1f} s, whole again {now - back:.1f} s later")


@pytest.mark.parametrize("bar", BARS)
def test_station_that_is_cut_off_holds_its_beam_and_no_other(hall: Hall, bar: str) -> None:
    other = next(one for one in BARS if one != bar)
    gateway = hall.gateways["server-1"]
    before = gateway.state(bar)["frames_processed"]

    def act() -> None:
        hall.network.cut(bar)
        begin = time.monotonic()
        wait_until(lambda: hall.held(gateway, bar), "the hold")
        print(f"{bar}: held at the server {time.monotonic() - begin:.2f} s after the cut")
        wait_until(lambda: gateway.state(bar)["state"] == "disconnected", "that it is missed")
        assert hall.whole(gateway, other)
        answer = gateway.request("POST", f"/devices/{bar}/stop")
        assert answer.status_code == 503, answer.text

    observe(hall, f"link of {bar}", act, lambda: hall.network.join(bar))
    # The device went on.
    assert gateway.state(bar)["frames_processed"] > before + 200 * CUT_S


def test_server_that_is_cut_off_holds_and_the_other_goes_on(hall: Hall) -> None:
    cut, other = hall.gateways["server-1"], hall.gateways["server-2"]
    with other.stream("bar-1") as messages:
        first = messages.until(lambda one: one["type"] == "frame")[-1]["sequence"]
        observe(
            hall,
            "link of server-1",
            lambda: hall.network.cut("server-1"),
            lambda: hall.network.join("server-1"),
        )
        taken = messages.until(
            lambda one: one["type"] == "frame" and one["sequence"] >= first + 200 * CUT_S
        )
        frames = [one["sequence"] for one in taken if one["type"] == "frame"]
        assert frames == list(range(first + 1, first + 1 + len(frames)))
    assert cut.running("bar-1")


def test_database_that_is_away_stops_no_stream_and_no_stop(hall: Hall) -> None:
    gateway = hall.gateways["server-1"]
    with gateway.stream("bar-1") as messages:
        first = messages.until(lambda one: one["type"] == "frame")[-1]["sequence"]

        def act() -> None:
            hall.proxy.cut()
            wait_until(
                lambda: (gateway.station("bar-2") or {}).get("state") == "limited",
                "that the station says it",
            )
            answer = gateway.request("POST", "/devices/bar-2/start")
            assert answer.status_code == 503, answer.text
            assert gateway.request("POST", "/devices/bar-2/stop").status_code == 200

        observe(hall, "the database", act, lambda: restart(hall, gateway))
        taken = messages.until(
            lambda one: one["type"] == "frame" and one["sequence"] >= first + 200 * CUT_S
        )
        frames = [one["sequence"] for one in taken if one["type"] == "frame"]
        assert frames == list(range(first + 1, first + 1 + len(frames)))


def restart(hall: Hall, gateway: GatewayServer) -> None:
    """Let the database be there again, and start what was stopped meanwhile."""
    hall.proxy.join()
    wait_until(
        lambda: gateway.request("POST", "/devices/bar-2/start").status_code == 200, "its start"
    )


def test_what_was_acknowledged_is_there_after_each_process_was_killed(hall: Hall) -> None:
    for number, name in enumerate((*BARS, *hall.gateways), start=1):
        gateway = hall.gateways["server-2" if name == "server-1" else "server-1"]
        limits = {"shift_mm": 20.0 + number}
        for bar in BARS:
            answer = gateway.request("PATCH", f"/beam-holds/beam-{bar}", {"limits": limits})
            assert answer.status_code == 200, answer.text
        process = (hall.stations | hall.gateways)[name]
        observe(hall, f"process {name}", process.kill, lambda name=name: hall.start(name))
        for gateway in hall.gateways.values():
            for bar in BARS:
                assert gateway.get(f"/beam-holds/beam-{bar}")["limits"]["shift_mm"] == 20.0 + number


def test_broker_that_is_killed_holds_all_and_all_come_back(hall: Hall) -> None:
    def act() -> None:
        hall.broker.kill()
        for gateway in hall.gateways.values():
            for bar in BARS:
                wait_until(lambda g=gateway, b=bar: hall.held(g, b), "the hold")

    def undo() -> None:
        with hall.network.on("centre"):
            hall.broker.start()

    observe(hall, "the broker", act, undo)
