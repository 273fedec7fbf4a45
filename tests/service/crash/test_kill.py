"""kill -9 at random moments: nothing torn, nothing lost that was acknowledged.

LUMILINE_TEST_KILLS=50 kills it so often; by default twice, which is quick.
"""

import hashlib
import json
import os
import random
import time
from pathlib import Path
from typing import Any

import httpx
import pytest

from hardware.recording.reader import RecordingReader
from tests.service.crash.clients import Clients
from tests.service.crash.process import ServiceProcess

KILLS = int(os.environ.get("LUMILINE_TEST_KILLS", "2"))
ENDED = {"succeeded", "failed", "cancelled", "interrupted"}


@pytest.mark.slow
def test_what_was_acknowledged_is_there_after_a_kill(tmp_path: Path) -> None:
    service = ServiceProcess(tmp_path)
    chance = random.Random()  # any moment will do, and each run tries others
    calibrations: dict[str, str] = {}
    runs: list[str] = []
    recorded = 0
    service.start()
    try:
        for kill in range(KILLS):
            clients = Clients(service.url, f"k{kill}")
            clients.start()
            if kill == 0:  # at least once when there is something of everything
                end = time.monotonic() + 240.0
                while not clients.has_everything and time.monotonic() < end:
                    time.sleep(0.02)
            time.sleep(chance.uniform(0.0, 2.5))
            service.kill()
            clients.stop()
            assert not [text for text in clients.failures if "unexpected" in text]
            # 503: on a busy machine a request may not get its turn at the database in time.
            assert [one.text for one in clients.refused if one.status_code in range(500, 503)] == []
            calibrations |= clients.calibrations
            runs += clients.runs
            service.start()
            check_calibrations(service.url, calibrations)
            check_runs(service.url, runs)
            check_activations(service.url, clients)
            recorded += check_recordings(service.url, tmp_path / "data" / "recordings", clients)
        print(f"{KILLS} kills: {len(calibrations)} calibrations, {len(runs)} runs and {recorded} "
              "frames were acknowledged, and are there")  # fmt: skip
        assert calibrations
        assert runs
        assert recorded
    finally:
        service.stop()


def get(url: str, path: str) -> Any:
    answer = httpx.get(f"{url}{path}", timeout=60.0)
    assert answer.status_code == 200, answer.text
    return answer.json()


def pages(url: str, path: str) -> list[Any]:
    """All items; runs that are taken up again add some meanwhile, which moves the pages on."""
    found: dict[Any, Any] = {}
    behind = ""
    while True:
        joint = "&" if "?" in path else "?"
        page = get(url, f"{path}{joint}limit=200{behind}")
        found |= {item["id"]: item for item in page["items"]}
        if page["next_cursor"] is None:
            return list(found.values())
        behind = f"&cursor={page['next_cursor']}"


def check_calibrations(url: str, acknowledged: dict[str, str]) -> None:
    """All are there, and whole: their content has the hash that was acknowledged."""
    listed = {item["id"]: item["content_hash"] for item in pages(url, "/api/v1/calibrations")}
    for name, content_hash in acknowledged.items():
        assert listed[name] == content_hash
    for name in random.Random().sample(sorted(listed), min(3, len(listed))):
        document = get(url, f"/api/v1/calibrations/{name}")
        content = {key: document[key] for key in ("provenance", "points", "result")}
        content["device"] = document["device_id"]
        text = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
        assert hashlib.sha256(text.encode()).hexdigest() == document["content_hash"]


def check_runs(url: str, acknowledged: list[str]) -> None:
    """Each is known, and one that succeeded has its result."""
    found = {run["id"]: run for run in pages(url, "/api/v1/runs")}
    for name in acknowledged:
        run = found[name]
        assert run["state"] in ENDED | {"queued", "running"}
        if run["state"] == "succeeded":
            get(url, run["result_path"])


def check_recordings(url: str, folder: Path, clients: Clients) -> int:
    """Each file can be read to what was said to be safe, and beyond; return its frames."""
    states = {item["id"]: item["state"] for item in pages(url, "/api/v1/recordings")}
    for name, safe in clients.recordings.items():
        assert states[name] == ("complete" if name in clients.complete else "incomplete")
        with RecordingReader(folder / name) as recording:
            sequences = [frame.sequence for frame in recording.frames()]
            assert len(sequences) >= safe
            assert recording.info.complete is (name in clients.complete)
        assert sequences == sorted(set(sequences))
    return sum(clients.recordings.values())


def check_activations(url: str, clients: Clients) -> None:
    """The pointer, its history and the audit log tell the same, and lack nothing acknowledged."""
    history = pages(url, "/api/v1/devices/sim/activations")[::-1]
    previous = None
    for move in history:
        assert move["previous_calibration_id"] == previous
        previous = move["calibration_id"]
    assert get(url, "/api/v1/devices/sim")["active_calibration_id"] == previous
    # The last acknowledged, or the one whose answer was cut off.
    if clients.activations:
        assert previous in {clients.activations[-1], clients.attempts[-1]}
    moved = [name for name, after in zip(clients.activations, clients.activations[1:], strict=False)
             if name != after]  # fmt: skip
    known = [move["calibration_id"] for move in history]
    assert is_subsequence(moved, known)
    audited = [
        entry["after"]["calibration_id"]
        for entry in pages(url, "/api/v1/audit")
        if entry["outcome"] == "done" and "calibration_id" in (entry["after"] or {})
    ][::-1]
    assert audited == known[1:], "all but the move that came with the database"


def is_subsequence(part: list[str], whole: list[str]) -> bool:
    rest = iter(whole)
    return all(item in rest for item in part)
