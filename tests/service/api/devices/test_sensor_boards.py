"""TCD1304 boards and GenICam cameras over REST: their sensors, and what is refused."""

from typing import Any

import pytest

import hardware.genicam.aravis
from tests.hardware.tcd1304.simulated_board import SimulatedBoard


def boards(*ports: str, **settings: Any) -> dict[str, Any]:
    named = [{"name": f"s{i}", "port": port} for i, port in enumerate(ports)]
    source = {"kind": "tcd1304", "settings": {"boards": named, "gap_ms": 20, **settings}}
    return {"id": "ccds", "title": "CCDs", "source": source}


def cameras(*which: str, **settings: Any) -> dict[str, Any]:
    named = [{"name": f"s{i}", "camera": camera} for i, camera in enumerate(which)]
    source = {"kind": "genicam", "settings": {"cameras": named, "pitch_um": 7.0, **settings}}
    return {"id": "cams", "title": "Cameras", "source": source}


def test_boards_have_the_sensors_that_were_named(sqlite_client: Any) -> None:
    left, right = SimulatedBoard(lambda _: b""), SimulatedBoard(lambda _: b"")
    try:
        made = sqlite_client.post("/api/v1/devices", json=boards(left.url, right.url))
        assert made.status_code == 201, made.text
        assert made.json()["sensors"] == [
            {"name": name, "pixels": 3648, "pitch_um": 8.0} for name in ("s0", "s1")
        ]
        assert sqlite_client.post("/api/v1/devices/ccds/start").status_code == 200
    finally:
        left.close()
        right.close()


@pytest.mark.parametrize(
    ("body", "status", "problem"),
    [
        (boards("socket://127.0.0.1:1"), 409, "device-not-connected"),
        (boards(), 422, "invalid-request"),
        (boards("spy:///dev/ttyS0?file=/tmp/x"), 422, "invalid-request"),
        (boards("/etc/passwd"), 422, "invalid-request"),
        (boards("/dev/ttyACM0", exposure_us=1), 422, "invalid-request"),
        (boards("/dev/ttyACM0", averages=256), 422, "invalid-request"),
        (boards("/dev/ttyACM0", "/dev/ttyACM0"), 422, "invalid-parameter"),
        (cameras(), 422, "invalid-request"),
        (cameras("10.0.0.5", pixel_format="RGB8"), 422, "invalid-request"),
        (cameras("10.0.0.5", pitch_um=0), 422, "invalid-request"),
        (cameras("10.0.0.5", features=[{"name": "a b", "value": 1}]), 422, "invalid-request"),
        (cameras("10.0.0.5", "10.0.0.5"), 422, "invalid-parameter"),
    ],
)
def test_what_cannot_be_is_refused(
    sqlite_client: Any, body: dict[str, Any], status: int, problem: str
) -> None:
    answer = sqlite_client.post("/api/v1/devices", json=body)
    assert (answer.status_code, answer.json()["type"]) == (status, f"/problems/{problem}")


def test_without_aravis_cameras_are_refused_with_what_to_install(
    sqlite_client: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = dict.fromkeys(("linux", "darwin", "win32"), "libaravis-none.so.0")
    monkeypatch.setattr(hardware.genicam.aravis, "_NAMES", names)
    hardware.genicam.aravis.library.cache_clear()
    answer = sqlite_client.post("/api/v1/devices", json=cameras("10.0.0.5"))
    hardware.genicam.aravis.library.cache_clear()
    assert (answer.status_code, answer.json()["type"]) == (501, "/problems/missing-library")
    assert "retry-after" not in answer.headers
    assert "libaravis-0.8-0" in answer.json()["detail"]
