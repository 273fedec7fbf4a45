"""Devices simulated from profiles in a real server: their streams, and their recordings."""

import json
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from typer.testing import CliRunner
from websockets.sync.client import connect

from compute.optics.profiles.profile_loader import load_profile
from hardware.replay import ReplayDriver
from hardware.simulated.profile_driver import ProfileDriver
from hardware.simulated.profile_settings import ProfileSettings
from hardware.simulated.scenes import StillPoints
from service.api.devices.nominal_calibration import nominal_calibration
from service.application.bootstrap import prepare
from service.cli import app
from service.cli.json_files import DOCUMENT
from service.database.engine import Database
from service.settings import Settings
from tests.running_server import serving
from tests.service.renamed_profiles import LENS, WINDOW

# Two markers that thesis-5.9 lights together, at places where its lines are 2 px wide and more.
POINTS_MM = ((130.0, -160.0, 1180.0), (-100.0, -40.0, 1070.0))
SCENE: dict[str, Any] = {"kind": "still-points", "points_mm": POINTS_MM}


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """A server that knows the device of thesis-5.9; its simulated bar leaves it the processor."""
    folder = tmp_path_factory.mktemp("profiles")
    settings = Settings(data_dir=folder, profile=LENS)
    folder.mkdir(exist_ok=True)
    database = Database(settings.effective_database_url)
    prepare(settings, database)
    database.close()
    with serving(folder) as url, httpx.Client(base_url=url, timeout=60.0) as client:
        client.post("/api/v1/devices/sim/stop").raise_for_status()
        yield client


def messages(api: httpx.Client, device: str, frames: int) -> list[dict[str, Any]]:
    """Return the greeting of a device that is started, and its first frames."""
    path = f"/api/v1/devices/{device}"
    api.post(f"{path}/start").raise_for_status()
    url = str(api.base_url).replace("http", "ws", 1).rstrip("/")
    query = f"device_id={device}&content=points,peaks&encoding=json"
    with connect(f"{url}/api/v1/stream?{query}", compression=None) as stream:
        found = [json.loads(stream.recv(timeout=240.0)) for _ in range(frames + 1)]
    status = api.get(f"{path}/state").json()
    assert status["state"] == "running"
    nominal = status["calibration_id"] is not None
    assert ("its calibration is nominal" in (status["reason"] or "")) == nominal
    assert status["frames_received"] >= frames
    api.post(f"{path}/stop").raise_for_status()
    assert [message["type"] for message in found] == ["hello", *["frame"] * frames]
    return found


@pytest.mark.slow
def test_points_are_where_the_markers_are(api: httpx.Client) -> None:
    settings = {"scene": SCENE, "optics": "exact", "frame_rate_hz": 20}
    source = {"kind": "profile", "profile_id": LENS, "settings": settings}
    changed = {"json": {"source": source}, "headers": {"If-Match": "*"}}
    api.patch("/api/v1/devices/thesis-5-9", **changed).raise_for_status()
    hello, *frames = messages(api, "thesis-5-9", 8)
    assert hello["readout"] == "lines"
    assert (hello["frame_rate_hz"], hello["markers"]) == (20.0, 0)
    assert hello["calibration_id"] == "thesis-5-9-nominal"
    for frame in frames:
        assert len(frame["peaks"]) == 8
        assert len(frame["points"]) == 2
        for truth in POINTS_MM:
            point = min(frame["points"], key=lambda one: np.linalg.norm(away(one, truth)))
            error = away(point, truth)
            # What the calibration leaves of the distortion is in the covariance: chi2 at 1e-4.
            assert error @ np.linalg.solve(point["covariance_mm2"], error) < 21.1
            assert np.linalg.norm(error) < 5.0
            assert len(point["sensors"]) == 4


def away(point: dict[str, Any], truth: tuple[float, ...]) -> Any:
    return np.subtract(point["position_mm"], truth)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("profile", "readout", "method"),
    [(WINDOW, "coded-window", "shadow"), ("mitchelson-1971", "gray-tracks", None)],
)
def test_shadows_are_read_and_tracks_are_not(
    api: httpx.Client, profile: str, readout: str, method: str | None
) -> None:
    settings = {"optics": "exact", "frame_rate_hz": 20}
    source = {"kind": "profile", "profile_id": profile, "settings": settings}
    body = {"id": profile, "title": profile, "source": source}
    api.post("/api/v1/devices", json=body).raise_for_status()
    hello, *frames = messages(api, profile, 4)
    assert (hello["readout"], hello["method"]) == (readout, method)
    assert hello["calibration_id"] is None
    peaks = 0 if method is None else len(hello["sensors"])
    assert [(len(frame["peaks"]), frame["points"]) for frame in frames] == [(peaks, [])] * 4
    assert [frame["marker"] for frame in frames[:2]] in ([0, 1], [1, 0])


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ('{"bits": 3}', "settings.json: bits: "),
        ("{", "settings.json: "),
        (None, "settings.json cannot be read: No such file"),
        ('{"frame_rate_hz": 9000}', "frame_rate_hz is 9000.0; thesis-5.9 reads at most 30"),
    ],
)
def test_settings_that_a_recording_cannot_have(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: str | None, words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    if given is not None:
        Path("settings.json").write_text(given, "utf-8")
    record = ["record", "device.h5", "--profile", LENS, "--simulation", "settings.json"]
    refused = CliRunner().invoke(app, record)
    assert refused.exit_code == 2, refused.output
    assert words in " ".join(refused.output.split())
    assert not Path("device.h5").exists()


@pytest.mark.parametrize("name", [LENS, WINDOW])
def test_a_recording_has_the_devices_bits(tmp_path: Path, name: str) -> None:
    recording, given = tmp_path / "device.h5", tmp_path / "settings.json"
    given.write_text(json.dumps({"optics": "exact", "frame_rate_hz": 30}), "utf-8")
    record = ["record", str(recording), "--profile", name, "--seconds", "0.3"]
    done = CliRunner().invoke(app, [*record, "--simulation", str(given)])
    assert done.exit_code == 0, done.output

    settings = ProfileSettings(optics="exact", frame_rate_hz=30, realtime=False)
    device = ProfileDriver(name, load_profile(name), settings)
    replayed = ReplayDriver(name, recording, speed=None)
    device.open()
    replayed.open()
    try:
        assert replayed.description == device.description
        frames = list(replayed.frames())
        assert len(frames) == 9
        for frame, original in zip(frames, islice(device.frames(), 9), strict=True):
            assert np.array_equal(frame.lines, original.lines)
            assert (frame.sequence, frame.marker) == (original.sequence, original.marker)
            assert frame.exposure_device_ns == original.exposure_device_ns
    finally:
        device.close()
        replayed.close()


@pytest.mark.slow
def test_a_recording_is_reconstructed(tmp_path: Path) -> None:
    """`lumiline replay` of a recording gives points near the truth, the same each time."""
    recording, calibration = tmp_path / "device.h5", tmp_path / "calibration.json"
    given = tmp_path / "settings.json"
    given.write_text(json.dumps({"optics": "exact", "scene": SCENE}), "utf-8")
    calibration.write_bytes(DOCUMENT.dump_json(nominal_calibration(load_profile(LENS))))
    record = ["record", str(recording), "--profile", LENS, "--seconds", "0.2"]
    done = CliRunner().invoke(app, [*record, "--simulation", str(given)])
    assert done.exit_code == 0, done.output
    outputs = [tmp_path / "first.jsonl", tmp_path / "second.jsonl"]
    for output in outputs:
        replay = ["replay", str(recording), "--calibration", str(calibration)]
        done = CliRunner().invoke(app, [*replay, "--output", str(output)])
        assert done.exit_code == 0, done.output
    assert outputs[0].read_bytes() == outputs[1].read_bytes()
    frames = [json.loads(line) for line in outputs[0].read_text("utf-8").splitlines()]
    assert len(frames) == 6
    markers = np.array(StillPoints(points_mm=POINTS_MM).points(0.0))
    for frame in frames:
        found = np.array([point["position_mm"] for point in frame["points"]])
        distance = np.linalg.norm(found[:, None] - markers, axis=2)
        assert distance.min(axis=0).max() < 5.0
