"""Recordings over HTTP: begun, read about, downloaded, replayed, deleted; files of others."""

import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import httpx
import pytest

from hardware.recording.reader import RecordingReader
from hardware.recording.writer import RecordingWriter
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.settings import SimulationSettings
from service.application.app import create_app
from service.pipeline.device_status import DeviceStatus
from service.settings import Settings
from tests.hardware.recording.blocks import block, described, read_recording
from tests.running_server import serving
from tests.service.fake_pipeline import FakePipeline, TestClient

API = "/api/v1/recordings"


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 240.0
    while not condition():
        assert time.monotonic() < end, "it did not come true"
        time.sleep(0.02)


@pytest.mark.slow
def test_a_recording_from_its_begin_to_its_end(tmp_path: Path) -> None:
    with serving(tmp_path) as url, httpx.Client(base_url=url, timeout=60.0) as api:
        wrong = api.post("/api/v1/devices/sim/recordings", json={"id": "../a.h5"})
        assert wrong.status_code == 422
        begun = api.post("/api/v1/devices/sim/recordings", json={"id": "one.h5"})
        assert begun.status_code == 201, begun.text
        assert begun.headers["location"] == f"{API}/one.h5"
        wait_for(lambda: api.get(f"{API}/one.h5").json()["frames_written"] > 100)
        for refused in (
            api.get(f"{API}/one.h5/file"),
            api.delete(f"{API}/one.h5"),
            api.post("/api/v1/devices/sim/recordings", json={}),
        ):
            assert refused.status_code == 409
            assert refused.json()["type"] == "/problems/recording-in-progress"
        stopped = api.post(f"{API}/one.h5/stop").json()
        assert (stopped["state"], stopped["reason"]) == ("complete", "stopped by request")
        assert api.post(f"{API}/one.h5/stop").json() == stopped
        assert [one["calibration_id"] for one in stopped["calibrations"]] == ["sim-nominal"]
        # A busy machine may lose exposures: then somebody has counted them.
        lost = api.get("/api/v1/devices/sim/state").json()["frames_lost"]
        lost += stopped["frames_dropped_compute"] + stopped["frames_dropped_writer"]
        assert stopped["frames_missing"] <= lost

        path = tmp_path / "recordings" / "one.h5"
        data = path.read_bytes()
        whole = api.get(f"{API}/one.h5/file")
        assert (whole.status_code, whole.content) == (200, data)
        part = api.get(f"{API}/one.h5/file", headers={"Range": "bytes=1000-4999"})
        assert (part.status_code, part.content) == (206, data[1000:5000])
        rest = {"Range": f"bytes={len(data) - 10}-", "If-Range": whole.headers["etag"]}
        assert api.get(f"{API}/one.h5/file", headers=rest).content == data[-10:]
        beyond = api.get(f"{API}/one.h5/file", headers={"Range": f"bytes={len(data)}-"})
        assert beyond.status_code == 416

        source = {"kind": "replay", "recording_id": "one.h5", "speed": 0.01}
        tape = {"id": "tape", "title": "Again", "source": source}
        assert api.post("/api/v1/devices", json=tape).status_code == 201
        api.post("/api/v1/devices/tape/start").raise_for_status()
        refused = api.delete(f"{API}/one.h5")
        assert refused.json()["type"] == "/problems/recording-in-use", refused.text
        api.post("/api/v1/devices/tape/stop").raise_for_status()
        assert api.delete(f"{API}/one.h5").status_code == 409  # its source, running or not
        assert api.delete("/api/v1/devices/tape").status_code == 204
        assert api.delete(f"{API}/one.h5").status_code == 204
        assert api.get(f"{API}/one.h5").status_code == 404
        assert not path.exists()

        request = {"id": "two.h5", "contents": ["results"]}
        api.post("/api/v1/devices/sim/recordings", json=request).raise_for_status()
        wait_for(lambda: api.get(f"{API}/two.h5").json()["frames_written"] > 0)
    # The server was shut down meanwhile.
    info = read_recording(tmp_path / "recordings" / "two.h5")
    assert (info.complete, info.state.reason) == (True, "the server was shut down")
    assert (info.lines, info.results) == (False, True)


@pytest.fixture
def folder(sqlite_settings: Settings, sqlite_client: TestClient) -> Path:
    """The folder of recordings of a running application."""
    return sqlite_settings.folders.recordings


def listed(client: TestClient, **query: Any) -> list[dict[str, Any]]:
    answer = client.get(API, params=query)
    assert answer.status_code == 200, answer.text
    items: list[dict[str, Any]] = answer.json()["items"]
    return items


def write(path: Path, frames: int, *, complete: bool = True) -> None:
    with RecordingWriter(path, described()) as writer:
        writer.append_block(block(0, frames))
        writer.close(complete=complete)


@pytest.mark.parametrize(
    ("status", "reason"),
    [
        (DeviceStatus("running", "links are slow"), "the device was started again"),
        (DeviceStatus("starting"), "the device was started again"),
        (DeviceStatus("starting", "no station"), "the device has starting: no station"),
    ],
)
def test_recording_whose_device_is_started_again_says_so(
    sqlite_client: TestClient,
    live: FakePipeline,
    monkeypatch: pytest.MonkeyPatch,
    status: DeviceStatus,
    reason: str,
) -> None:
    """A start in another process ends the session before; the status is the device's, as it is."""
    live.records = SimulatedDriver("sim", SimulationSettings()).description
    begun = sqlite_client.post("/api/v1/devices/sim/recordings", json={"id": "a.h5"})
    assert begun.status_code == 201, begun.text
    running = type(live.session("sim"))
    monkeypatch.setattr(running, "status", lambda _: status)
    monkeypatch.setattr(running, "drained", True)
    wait_for(lambda: sqlite_client.get(f"{API}/a.h5").json()["state"] == "complete")
    assert sqlite_client.get(f"{API}/a.h5").json()["reason"] == reason


def test_files_that_others_put_there_appear_as_what_they_are(
    folder: Path, sqlite_client: TestClient
) -> None:
    assert listed(sqlite_client) == []
    write(folder / "whole.h5", 11)
    (folder / "sub").mkdir()
    write(folder / "sub" / "cut.h5", 12, complete=False)
    (folder / "text.h5").write_text("no recording", encoding="utf-8")
    with h5py.File(folder / "other.h5", "w") as file:
        file["x"] = 1
    (folder / "notes.txt").write_text("not listed", encoding="utf-8")
    (folder / ".hidden.h5").write_text("not listed", encoding="utf-8")
    outside = folder.parent / "secret.h5"
    write(outside, 3)
    (folder / "link.h5").symlink_to(outside)
    found = {one["id"]: one for one in listed(sqlite_client)}
    assert {name: (one["state"], one["frames_written"]) for name, one in found.items()} == {
        "whole.h5": ("complete", 11),
        "sub/cut.h5": ("incomplete", 12),
        "text.h5": ("unreadable", None),
        "other.h5": ("unreadable", None),
    }
    assert "not an HDF5 file" in found["text.h5"]["reason"]
    assert {one["id"] for one in listed(sqlite_client, device_id="bar")} == {
        "whole.h5",
        "sub/cut.h5",
    }
    page = sqlite_client.get(API, params={"limit": 3}).json()
    rest = listed(sqlite_client, limit=3, cursor=page["next_cursor"])
    assert {one["id"] for one in (*page["items"], *rest)} == set(found)
    assert len(rest) == 1
    assert sqlite_client.get(f"{API}/sub/cut.h5").json()["frames_written"] == 12
    assert sqlite_client.get(f"{API}/sub/cut.h5/file").status_code == 200
    for name in ("link.h5", "../secret.h5", "absent.h5", "%2e%2e/secret.h5", "sub"):
        assert sqlite_client.get(f"{API}/{name}/file").status_code in (404, 422), name
        assert sqlite_client.delete(f"{API}/{name}").status_code in (404, 405, 422), name
    assert outside.exists()


def test_what_is_known_of_a_file_is_read_again_when_it_changes(
    folder: Path, sqlite_client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(folder / "a.h5", 5)
    assert sqlite_client.get(API).json()["items"][0]["frames_written"] == 5
    opened = []
    monkeypatch.setattr(
        "service.api.recordings.repository._reader",
        lambda path: opened.append(path) or RecordingReader(path, columns=False),
    )
    assert listed(sqlite_client)[0]["frames_written"] == 5
    assert opened == []
    write(folder / "b.h5", 6)
    shutil.move(folder / "b.h5", folder / "a.h5")
    assert listed(sqlite_client)[0]["frames_written"] == 6
    assert len(opened) == 1


@pytest.mark.slow
def test_too_little_free_space_refuses_a_recording(tmp_path: Path) -> None:
    live = FakePipeline()
    live.records = described()
    settings = Settings(data_dir=tmp_path, recording_free_bytes=2**62)
    with TestClient(create_app(settings, live)) as client:
        refused = client.post("/api/v1/devices/sim/recordings", json={})
        assert refused.status_code == 507
        assert refused.json()["type"] == "/problems/insufficient-storage"
        assert "delete recordings" in refused.json()["detail"]
        missing = client.post("/api/v1/devices/none/recordings", json={})
        assert missing.json()["type"] == "/problems/unknown-device"
    assert list((tmp_path / "recordings").iterdir()) == []
