"""A server with a bus and devices of its own: both are there, and a lost bus stops none."""

import time
from pathlib import Path

import pytest

from service.application.app import create_app
from service.settings import Settings
from tests.nats_server import NatsServer
from tests.running_server import shared_starter
from tests.service.fake_pipeline import TestClient

WAIT_S = 120.0


@pytest.mark.slow
def test_devices_of_the_server_itself_go_on_whatever_the_bus_does(tmp_path: Path) -> None:
    broker = NatsServer(tmp_path)
    settings = Settings(
        data_dir=tmp_path / "data", compute_device="cpu", log_level="warning", bus_url=broker.url
    )
    with TestClient(create_app(settings, starter=shared_starter())) as client:

        def processed() -> int:
            return int(client.get("/api/v1/devices/sim/state").json()["frames_processed"])

        def grows() -> None:
            before, end = processed(), time.monotonic() + WAIT_S
            while processed() <= before:
                assert time.monotonic() < end, "no frame comes"
                time.sleep(0.02)

        grows()
        (own,) = client.get("/api/v1/stations").json()["items"]
        assert (own["name"], own["state"]) == (None, "running")
        broker.start()
        grows()
        broker.kill()
        grows()
        answer = client.post("/api/v1/devices/sim/stop")
        assert answer.json()["state"] == "stopped"
        body = {
            "id": "far", "title": "Far", "station": "bar-1",
            "source": {"kind": "simulated", "settings": {}},
        }  # fmt: skip
        answer = client.post("/api/v1/devices", json=body)
        assert (answer.status_code, answer.json()["type"]) == (503, "/problems/station-not-reached")
        assert '"bar-1" was not reached' in answer.json()["detail"]
