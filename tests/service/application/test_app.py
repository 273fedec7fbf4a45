"""The application's lifespan: seeds once, starts devices, survives a broken one, closes."""

import logging
from typing import Any

import pytest

from compute.errors import InvalidParameter
from service.application.app import create_app
from service.settings import Settings
from tests.service.fake_pipeline import FakePipeline, TestClient


def test_the_seed_comes_once(sqlite_settings: Settings):
    for expected in (200, 404):
        with TestClient(create_app(sqlite_settings, FakePipeline())) as client:
            answer = client.delete("/api/v1/devices/sim?cascade=true")
            assert (answer.status_code == 204) == (expected == 200)


def test_what_was_stored_is_there_after_a_restart(settings: Settings):
    with TestClient(create_app(settings, FakePipeline())) as client:
        client.patch("/api/v1/devices/sim", json={"title": "Kept", "autostart": False})
    live = FakePipeline()
    with TestClient(create_app(settings, live)) as client:
        assert client.get("/api/v1/devices/sim").json()["title"] == "Kept"
    assert live.calls == [("close",)]


@pytest.mark.parametrize("error", [InvalidParameter("no light"), OSError("no such port")])
def test_a_device_that_cannot_start_keeps_the_server_up(
    sqlite_settings: Settings, error: Exception, caplog: pytest.LogCaptureFixture
):
    class Broken(FakePipeline):
        def start_device(self, *_: Any, **__: Any) -> Any:
            raise error

    with (
        caplog.at_level(logging.ERROR),
        TestClient(create_app(sqlite_settings, Broken())) as client,
    ):
        assert client.get("/api/v1/devices/sim/state").json()["state"] == "stopped"
    assert "device sim was not started" in caplog.text


@pytest.mark.slow
def test_the_landing_pages_links_work(sqlite_client: Any):
    links = sqlite_client.get("/api/v1").json()["links"]
    for name, path in links.items():
        if name != "stream":
            assert sqlite_client.get(path).status_code == 200, name
