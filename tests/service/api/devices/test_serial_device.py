"""Devices on serial ports over REST: what they say they are, and what is refused."""

from dataclasses import replace
from typing import Any

import pytest

from tests.hardware.serial.emulated_device import bench_device


def serial(url: str, **settings: Any) -> dict[str, Any]:
    source = {"kind": "serial", "settings": {"url": url, **settings}}
    return {"id": "bar", "title": "Bar", "source": source}


def test_its_sensors_are_those_that_it_says_it_has(sqlite_client: Any) -> None:
    with bench_device() as bar:
        strobe = {"slots": [0, 1, 1]}
        made = sqlite_client.post("/api/v1/devices", json=serial(bar.url, strobe=strobe))
        assert made.status_code == 201, made.text
        assert [sensor["name"] for sensor in made.json()["sensors"]] == list(
            bar.device.description().sensors
        )
        assert made.json()["source"]["settings"]["strobe"] == strobe
        assert sqlite_client.post("/api/v1/devices/bar/start").status_code == 200
        bar.described = lambda said: replace(said, sensors=("a", "b", "c", "d"))
        bar.switch_off_and_on()
        refused = sqlite_client.post("/api/v1/devices/bar/start")
        assert refused.status_code == 409
        assert refused.json()["type"] == "/problems/sensors-changed"
        assert 'what is connected has "a" (2048 px)' in refused.json()["detail"]
        sqlite_client.post("/api/v1/devices/bar/stop")
        anew = sqlite_client.patch(
            "/api/v1/devices/bar", json={"source": serial(bar.url)["source"]}
        )
        assert [sensor["name"] for sensor in anew.json()["sensors"]] == ["a", "b", "c", "d"]
        assert sqlite_client.post("/api/v1/devices/bar/start").status_code == 200


@pytest.mark.parametrize(
    ("url", "settings", "status", "problem"),
    [
        ("socket://127.0.0.1:1", {}, 409, "device-not-connected"),
        ("/dev/ttyLumilineNowhere", {}, 409, "device-not-connected"),
        ("/etc/passwd", {}, 422, "invalid-request"),
        ("spy:///dev/ttyS0?file=/tmp/x", {}, 422, "invalid-request"),
        ("socket://127.0.0.1:1", {"baudrate": 1}, 422, "invalid-request"),
        ("socket://127.0.0.1:1", {"frame_rate_hz": 0}, 422, "invalid-request"),
        ("socket://127.0.0.1:1", {"strobe": {"slots": []}}, 422, "invalid-request"),
        ("socket://127.0.0.1:1", {"strobe": {"slots": [300]}}, 422, "invalid-request"),
        ("socket://127.0.0.1:1", {"colour": "red"}, 422, "invalid-request"),
    ],
)
def test_what_cannot_be_is_refused(
    sqlite_client: Any, url: str, settings: dict[str, Any], status: int, problem: str
) -> None:
    answer = sqlite_client.post("/api/v1/devices", json=serial(url, **settings))
    assert (answer.status_code, answer.json()["type"]) == (status, f"/problems/{problem}")


def test_what_the_device_refuses_is_told(sqlite_client: Any) -> None:
    with bench_device() as bar:
        body = serial(bar.url, frame_rate_hz=90_000)
        answer = sqlite_client.post("/api/v1/devices", json=body)
        assert (answer.status_code, answer.json()["type"]) == (422, "/problems/invalid-parameter")
        assert "refused the command exposure" in answer.json()["detail"]
