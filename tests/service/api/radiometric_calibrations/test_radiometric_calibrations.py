"""/api/v1/radiometric-captures and -calibrations: captured, estimated, activated, history."""

from dataclasses import replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from hardware.line_frame import LineFrame
from hardware.recording.writer import RecordingWriter
from service.api.radiometric_calibrations import captures_router
from service.api.radiometric_calibrations.examples import (
    NEW_RADIOMETRIC_CALIBRATIONS,
    NEW_RADIOMETRIC_CAPTURES,
)
from service.pipeline.active_calibration import LiveBadPixel
from service.pipeline.device_status import DeviceStatus
from tests.service.api.radiometric_calibrations.frames import (
    DEFECTS,
    batch_of,
    description,
    driver,
    frames_of,
    lit,
    scans_of,
)
from tests.service.fake_pipeline import FakePipeline

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

CAPTURES = "/api/v1/radiometric-captures"
URL = "/api/v1/radiometric-calibrations"
SESSION = f"{CAPTURES}/sim-radiometric-capture"
CAPTURE_BODY = NEW_RADIOMETRIC_CAPTURES["guided"]["value"] | {
    "settings": {"frames": 32, "levels": 3, "timeout_s": 0.5}
}
EXAMPLE = NEW_RADIOMETRIC_CALIBRATIONS["document"]["value"]
LEVELS = (12_000.0, 24_000.0, 40_000.0)


def capture(client: Any, live: FakePipeline, electrons: float, **query: Any) -> Any:
    """Capture frames under even light."""
    live.records = description()
    live.batches = lit(electrons)
    return client.post(f"{SESSION}/capture", params=query)


def activate(client: Any, name: str, **query: str) -> Any:
    return client.post(f"{URL}/{name}/activate", params=query)


@pytest.mark.slow
def test_guided_captures_become_an_active_calibration(client: Any, live: FakePipeline) -> None:
    made = client.post(CAPTURES, json=CAPTURE_BODY)
    assert made.status_code == 201, made.text
    assert made.headers["location"] == SESSION
    assert (made.json()["next"], made.json()["left"]) == ("dark", 4)
    assert "Cover all sensors" in made.json()["instruction"]

    early = {"id": "pixels", "device_id": "sim",
             "source": {"kind": "capture",
                        "radiometric_capture_id": "sim-radiometric-capture"}}  # fmt: skip
    refused = client.post(URL, json=early).json()
    assert refused["type"] == "/problems/radiometric-capture-incomplete"
    assert "Cover all sensors" in refused["detail"]

    found = capture(client, live, 0.0, kind="dark", temperature_c=24.0)
    assert found.status_code == 200, found.text
    assert (found.json()["next"], found.json()["left"]) == ("flat", 3)
    assert "about 28% of full scale" in found.json()["instruction"]
    for electrons in LEVELS:
        found = capture(client, live, electrons, kind="flat", relative_light=electrons)
        assert found.status_code == 200, found.text
    session = found.json()
    assert (session["next"], session["left"]) == (None, 0)
    assert [one["name"] for one in session["captured"]] == ["dark", "flat-1", "flat-2", "flat-3"]
    level = session["captured"][2]["sensors"][0]
    assert level["mean_counts"] == pytest.approx(64 + 24_000 / 12, abs=3)
    assert client.get(SESSION).json() == session

    made = client.post(URL, json=early)
    assert made.status_code == 201, made.text
    document = client.get(f"{URL}/pixels").json()
    assert {name: document[name] for name in made.json()} == made.json()
    figures = document["sensors"][0]
    assert figures["gain_electrons_per_count"] == pytest.approx(12.0, rel=0.05)
    assert figures["prnu"] == pytest.approx(DEFECTS.response_nonuniformity, rel=0.1)
    assert figures["temperature_c"] == 24.0
    assert figures["linearity_error"] < 0.002
    dead, hot, stuck = DEFECTS.positions(4, 2048)
    bad = np.flatnonzero(document["content"]["sensors"][figures["sensor"]]["bad_pixels"])
    assert set(bad) >= {dead[0, 0], hot[0, 0], stuck[0, 0]}

    assert document["active"] is False
    assert activate(client, "pixels").json()["active"] is True
    assert client.get("/api/v1/devices/sim").json()["active_radiometric_id"] == "pixels"
    used = live.in_force["sim"]
    assert used.calibration_id == "sim-nominal"
    assert used.radiometric is not None
    assert used.radiometric.radiometric_id == "pixels"
    assert used.radiometric.content_hash == document["content_hash"]
    assert set(used.radiometric.sensors) == {one["sensor"] for one in document["sensors"]}
    assert client.delete(SESSION).status_code == 204
    assert client.get(SESSION).json()["type"] == "/problems/unknown-radiometric-capture"


def test_moves_are_a_history_that_is_in_the_audit_log(client: Any, live: FakePipeline) -> None:
    for name in ("one", "two"):
        made = client.post(URL, json=EXAMPLE | {"id": name})
        assert made.status_code == 201, made.text
    assert client.post(URL, json=EXAMPLE | {"id": "one"}).json()["type"] == (
        "/problems/radiometric-calibration-exists"
    )
    activate(client, "one")
    activate(client, "one")  # nothing changes
    conflict = activate(client, "two", expected="two").json()
    assert conflict["type"] == "/problems/activation-conflict"
    assert 'uses the radiometric calibration "one"' in conflict["detail"]
    assert activate(client, "two", expected="one").status_code == 200
    # Another calibration of the cameras leaves the pixels' as it is.
    assert client.post("/api/v1/calibrations/sim-nominal/activate").status_code == 200
    assert live.in_force["sim"].radiometric.radiometric_id == "two"  # type: ignore[union-attr]
    assert client.post(f"{URL}/one/deactivate").status_code == 200  # not active: nothing
    assert client.post(f"{URL}/two/deactivate").json()["active"] is False
    assert live.in_force["sim"].radiometric is None
    history = client.get("/api/v1/devices/sim/radiometric-activations").json()["items"]
    assert [(one["previous_radiometric_id"], one["radiometric_id"]) for one in history] == [
        ("two", None), ("one", "two"), (None, "one"),
    ]  # fmt: skip
    assert history[0]["actor"] is not None
    entries = client.get("/api/v1/audit", params={"limit": 200}).json()["items"]
    moves = [one for one in entries if one["operation"] == "activate-radiometric-calibration"]
    assert {"radiometric_id": "two"} in [one["after"] for one in moves]
    listed = client.get(URL, params={"device_id": "sim"}).json()
    assert [one["id"] for one in listed["items"]] == ["two", "one"]
    assert not any(one["active"] for one in listed["items"])
    refused = client.delete("/api/v1/devices/sim").json()
    assert "2 radiometric calibrations" in refused["detail"]


@pytest.mark.slow
def test_bad_captures_are_refused_with_the_reason(sqlite_client: Any, live: FakePipeline) -> None:
    client = sqlite_client
    client.post(CAPTURES, json=CAPTURE_BODY)

    def refused(electrons: float, **query: Any) -> str:
        before = client.get(SESSION).json()
        answer = capture(client, live, electrons, **query).json()
        assert answer["type"] == "/problems/unusable-radiometric-capture", answer
        assert client.get(SESSION).json() == before
        detail: str = answer["detail"]
        return detail

    first = capture(client, live, 24_000.0, kind="flat").json()
    assert first["type"] == "/problems/radiometric-capture-incomplete"
    assert "light in the dark: sensor" in refused(12_000.0, kind="dark")
    assert capture(client, live, 0.0, kind="dark").status_code == 200
    assert "saturated" in refused(60_000.0, kind="flat")
    assert "too dark" in refused(100.0, kind="flat")
    assert 'no flat capture "flat-7"' in refused(24_000.0, kind="flat", name="flat-7")

    def refused_frames(frames: list[LineFrame], kind: str) -> str:
        live.batches = [batch_of(frames)]
        answer = client.post(f"{SESSION}/capture", params={"kind": kind}).json()
        assert answer["type"] == "/problems/unusable-radiometric-capture", answer
        detail: str = answer["detail"]
        return detail

    frames = frames_of(24_000.0, 32)
    assert "5 of 32 frames came" in refused_frames(frames[:5], "flat")

    def changed(factor: Any) -> list[LineFrame]:
        """Frames whose light is multiplied, by pixel or by frame."""
        light = np.array([frame.lines for frame in frames], dtype=np.float64) - 64.0
        lines = (64.0 + light * factor).clip(0, 4095).astype(np.uint16)
        return [
            LineFrame(one.device, one.sequence, one.exposure_device_ns, one.exposure_host_ns,
                      None, line)
            for one, line in zip(frames, lines, strict=True)
        ]  # fmt: skip

    assert "uneven" in refused_frames(changed(np.linspace(0.2, 1.0, 2048)), "flat")
    flicker = np.where(np.arange(32) % 2 == 0, 0.9, 1.0)[:, None, None]
    assert "unsteady" in refused_frames(changed(flicker), "flat")
    dark = frames_of(0.0, 32)
    stripe = np.exp(-0.5 * ((np.arange(2048) - 900.0) / 2.0) ** 2) * 50.0
    seen = [
        LineFrame(one.device, one.sequence, one.exposure_device_ns, one.exposure_host_ns,
                  None, (one.lines + stripe).astype(np.uint16))
        for one in dark
    ]  # fmt: skip
    assert "stripe of light at pixel 89" in refused_frames(seen, "dark")
    live.records = None
    stopped = client.post(f"{SESSION}/capture", params={"kind": "flat"}).json()
    assert stopped["type"] == "/problems/device-not-running"


@pytest.mark.slow
def test_a_capture_is_taken_again_and_a_new_dark_one_begins_anew(
    sqlite_client: Any, live: FakePipeline
) -> None:
    client = sqlite_client
    client.post(CAPTURES, json=CAPTURE_BODY)
    capture(client, live, 0.0, kind="dark")
    capture(client, live, 12_000.0, kind="flat")
    capture(client, live, 24_000.0, kind="flat")
    again = capture(client, live, 36_000.0, kind="flat", name="flat-1").json()
    assert [one["name"] for one in again["captured"]] == ["dark", "flat-1", "flat-2"]
    assert again["captured"][1]["sensors"][0]["mean_counts"] == pytest.approx(3064, abs=5)
    # The level that is farthest from those that are there.
    assert "28% of full scale" in again["instruction"]
    anew = capture(client, live, 0.0, kind="dark").json()
    assert [one["name"] for one in anew["captured"]] == ["dark"]


@pytest.fixture
def meanwhile(monkeypatch: pytest.MonkeyPatch) -> "Callable[[Callable[[], Any]], None]":
    """Lets something happen once, when the next capture has its frames and has not stored them."""

    def plan(happens: "Callable[[], Any]") -> None:
        def collected(*asked: Any) -> None:
            monkeypatch.setattr(captures_router, "collect", collect)
            collect(*asked)
            happens()

        monkeypatch.setattr(captures_router, "collect", collected)

    collect = captures_router.collect
    return plan


def test_overlapping_flat_captures_are_both_kept(
    client: Any, live: FakePipeline, meanwhile: Any
) -> None:
    client.post(CAPTURES, json=CAPTURE_BODY)
    capture(client, live, 0.0, kind="dark")
    others: list[Any] = []
    meanwhile(lambda: others.append(capture(client, live, LEVELS[1], kind="flat")))
    found = capture(client, live, LEVELS[0], kind="flat")
    assert others[0].status_code == found.status_code == 200, found.text
    (acknowledged,) = others[0].json()["captured"][1:]
    assert found.json()["captured"][1] == acknowledged
    assert [one["name"] for one in found.json()["captured"]] == ["dark", "flat-1", "flat-2"]


def test_a_flat_capture_is_checked_against_a_dark_one_that_came_meanwhile(
    client: Any, live: FakePipeline, meanwhile: Any
) -> None:
    """Its light is 125 counts above the first one, and 25 above the second; 82 are needed."""
    client.post(CAPTURES, json=CAPTURE_BODY)
    capture(client, live, 0.0, kind="dark")
    second: list[Any] = []
    meanwhile(lambda: second.append(capture(client, live, 1200.0, kind="dark")))
    refused = capture(client, live, 1500.0, kind="flat")
    assert second[0].status_code == 200, second[0].text
    assert refused.json()["type"] == "/problems/unusable-radiometric-capture", refused.text
    assert "too dark" in refused.json()["detail"]
    assert client.get(SESSION).json() == second[0].json()


def test_a_session_made_anew_meanwhile_is_not_given_the_formers_frames(
    client: Any, live: FakePipeline, meanwhile: Any
) -> None:
    client.post(CAPTURES, json=CAPTURE_BODY)

    def again() -> None:
        assert client.delete(SESSION).status_code == 204
        assert client.post(CAPTURES, json=CAPTURE_BODY).status_code == 201

    meanwhile(again)
    answer = capture(client, live, 0.0, kind="dark")
    assert answer.status_code == 404, answer.text
    assert answer.json()["type"] == "/problems/unknown-radiometric-capture"
    assert client.get(SESSION).json()["captured"] == []


def test_from_recordings_of_the_data_directory(
    sqlite_client: Any, settings: Any, live: FakePipeline
) -> None:
    folder: Path = settings.folders.recordings
    folder.mkdir(parents=True, exist_ok=True)
    for name, electrons in (("dark", 0.0), ("low", LEVELS[0]), ("high", LEVELS[2])):
        source = driver(electrons, 24)
        source.open()
        with RecordingWriter(folder / f"{name}.h5", source.description) as writer:
            for frame in source.frames():
                writer.append(frame)
    source_of = {
        "kind": "recordings",
        "dark_recording_id": "dark.h5",
        "flat_recording_ids": ["low.h5", "high.h5"],
    }
    made = sqlite_client.post(URL, json={"id": "r", "device_id": "sim", "source": source_of})
    assert made.status_code == 201, made.text
    assert made.json()["origin"] == "recordings"
    assert made.json()["sensors"][3]["gain_electrons_per_count"] == pytest.approx(12.0, rel=0.1)
    swapped = source_of | {
        "dark_recording_id": "high.h5",
        "flat_recording_ids": ["low.h5", "dark.h5"],
    }
    refused = sqlite_client.post(URL, json={"device_id": "sim", "source": swapped}).json()
    assert "light in the dark" in refused["detail"]
    missing = source_of | {"dark_recording_id": "none.h5"}
    refused = sqlite_client.post(URL, json={"device_id": "sim", "source": missing}).json()
    assert refused["type"] == "/problems/unknown-recording"


def test_from_scans_in_the_request(sqlite_client: Any) -> None:
    sensor = description().sensors[1].name
    scans = {
        "dark": scans_of(0.0, 16, 1).tolist(),
        "flats": [scans_of(electrons, 16, 1).tolist() for electrons in LEVELS[:2]],
    }
    source = {"kind": "scans", "sensors": {sensor: scans}, "full_scale_counts": 4095}
    made = sqlite_client.post(URL, json={"device_id": "sim", "source": source})
    assert made.status_code == 201, made.text
    assert [one["sensor"] for one in made.json()["sensors"]] == [sensor]
    other = source | {"sensors": {"another": scans}}
    refused = sqlite_client.post(URL, json={"device_id": "sim", "source": other}).json()
    assert refused["type"] == "/problems/sensors-changed"
    short = [scans["dark"][0][:100], *scans["dark"][1:]]
    wrong = source | {"sensors": {sensor: scans | {"dark": short}}}
    refused = sqlite_client.post(URL, json={"device_id": "sim", "source": wrong}).json()
    assert "all must be of one length" in refused["detail"]


def test_documents_that_are_none_are_refused(sqlite_client: Any) -> None:
    (name, good), *_ = EXAMPLE["source"]["sensors"].items()

    def refused(document: Any, sensor: str = name) -> Any:
        source = {"kind": "document", "sensors": {sensor: document}}
        return sqlite_client.post(URL, json={"device_id": "sim", "source": source}).json()

    assert "sensor" in refused({})["detail"]
    assert refused(good | {"response": good["response"][:-1]})["status"] == 422
    assert refused(good | {"gain_electrons_per_count": -1.0})["status"] == 422
    assert refused(good, "no such sensor")["type"] == "/problems/sensors-changed"
    assert sqlite_client.get(URL).json()["items"] == []


def test_bad_pixels_of_the_live_frames_become_a_calibration(
    client: Any, live: FakePipeline
) -> None:
    body = {"id": "kept", "device_id": "sim", "source": {"kind": "bad-pixels"}}
    assert client.post(URL, json=body).json()["type"] == "/problems/device-not-running"
    live.records = description()
    none = client.post(URL, json=body).json()
    assert none["type"] == "/problems/invalid-parameter"
    assert "no bad pixel" in none["detail"]
    client.post(URL, json=EXAMPLE | {"id": "measured"})
    activate(client, "measured")
    (measured,) = EXAMPLE["source"]["sensors"]
    first, other = (
        LiveBadPixel(name, pixel, "stuck", datetime(2026, 1, 2, tzinfo=UTC))
        for name, pixel in (
            (measured, 7),
            (next(one.name for one in live.records.sensors if one.name != measured), 9),
        )
    )
    live.active = replace(live.in_force["sim"], bad_pixels=(first, other))
    live.states["sim"] = DeviceStatus("running", bad_pixels=(first, other))
    status = client.get("/api/v1/devices/sim/state").json()
    assert status["bad_pixels"][0] == {
        "sensor": measured, "pixel": 7, "kind": "stuck", "found_at": "2026-01-02T00:00:00Z",
    }  # fmt: skip
    assert 'lumiline_bad_pixels{device="sim"} 2.0' in client.get("/metrics").text
    made = client.post(URL, json=body)
    assert made.status_code == 201, made.text
    assert made.json()["origin"] == "bad-pixels"
    sensors = client.get(f"{URL}/kept").json()["content"]["sensors"]
    assert np.flatnonzero(sensors[measured]["bad_pixels"]).tolist() == [7, 100]
    assert sensors[measured]["prnu"] == 0.01
    assert np.flatnonzero(sensors[other.sensor]["bad_pixels"]).tolist() == [9]
    assert sensors[other.sensor]["gain_electrons_per_count"] == 12.0
    assert activate(client, "kept").json()["active"] is True
