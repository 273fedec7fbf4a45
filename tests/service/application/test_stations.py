"""A station and gateways in processes of their own, with NATS and PostgreSQL: what clients see."""

import secrets
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import create_engine, text
from sqlalchemy.engine import make_url

from tests.nats_server import NatsServer
from tests.service.application.stations import GatewayServer, Station, wait_until
from tests.service.conftest import POSTGRES, postgres_copy

BAR = {
    "id": "bar",
    "title": "A bar",
    "station": "bar-1",
    "autostart": True,
    "source": {
        "kind": "simulated",
        "settings": {"scene": {"kind": "calibration-frame"}, "frame_rate_hz": 200},
    },
}

pytestmark = [pytest.mark.slow, pytest.mark.postgres]


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[NatsServer]:
    server = NatsServer(tmp_path)
    server.start()
    yield server
    server.kill()


@pytest.fixture
def shared_database(new_postgres: str | None) -> Iterator[str]:
    if new_postgres is None:
        pytest.skip("databases may not be made in the PostgreSQL server for tests")
    yield from postgres_copy(new_postgres)


@pytest.fixture
def station(tmp_path: Path, broker: NatsServer, shared_database: str) -> Iterator[Station]:
    one = Station("bar-1", tmp_path, broker.url, shared_database)
    one.start()
    yield one
    one.kill(signal.SIGTERM)


@pytest.fixture
def gateway(
    tmp_path: Path, broker: NatsServer, shared_database: str
) -> Iterator[GatewayServer]:
    one = GatewayServer("gateway-1", tmp_path, broker.url, shared_database)
    one.start()
    yield one
    one.kill(signal.SIGTERM)


def reached(gateway: GatewayServer, name: str = "bar-1") -> bool:
    found = gateway.station(name)
    return found is not None and found["state"] == "running"


def create(gateway: GatewayServer, body: dict[str, Any]) -> None:
    wait_until(lambda: reached(gateway), "the station")
    answer = gateway.request("POST", "/devices", body)
    assert answer.status_code == 201, answer.text


def test_device_of_a_station_does_through_rest_what_a_local_one_does(
    station: Station, gateway: GatewayServer
) -> None:
    create(gateway, BAR)
    assert gateway.get("/devices/bar")["station"] == "bar-1"
    answer = gateway.request("POST", "/devices/bar/start")
    assert answer.status_code == 200, answer.text
    assert answer.json()["state"] == "running"
    with gateway.stream("bar") as messages:
        taken = messages.until(lambda one: one["type"] == "frame" and one["sequence"] > 100)
        frames = [one["sequence"] for one in taken if one["type"] == "frame"]
        assert frames == list(range(frames[0], frames[-1] + 1))
    answer = gateway.request("POST", "/devices/bar/stop")
    assert answer.json()["state"] == "stopped", answer.text
    assert gateway.state("bar")["state"] == "stopped"
