"""The example of a capture session, on the simulated frame that it is of: to a calibration."""

from pathlib import Path

import httpx
import pytest

from service.api.captures.examples import NEW_CAPTURES
from service.api.devices.router import NEW_DEVICES
from tests.running_server import serving
from tests.service.api.runs.test_runs import QUICK, wait


@pytest.mark.slow
def test_the_frame_of_the_examples_calibrates(tmp_path: Path):
    """Its own rate would take 40 s; ten times as many frames a second are the same frames."""
    device = NEW_DEVICES["simulated"]["value"]
    scene = device["source"]["settings"] | {"frame_rate_hz": 2000}
    device = device | {"source": device["source"] | {"settings": scene}}
    session = NEW_CAPTURES["frame"]["value"] | {"device_id": "bench", "settings": {"frames": 10}}
    with serving(tmp_path) as url, httpx.Client(base_url=f"{url}/api/v1", timeout=60.0) as client:
        client.post("/devices/sim/stop")
        assert client.post("/devices", json=device).status_code == 201
        assert client.post("/devices/bench/start").is_success
        assert client.post("/captures", json=session).status_code == 201
        for _ in session["targets"]:
            found = client.post("/captures/sim-capture/capture")
            assert found.status_code == 200, found.text
        assert found.json()["left"] == 0
        # The next marker in place of its own is noticed.
        wrong = session | {"id": "wrong", "targets": [
            target | {"marker": 0} for target in session["targets"][:2]
        ]}  # fmt: skip
        assert client.post("/captures", json=wrong).status_code == 201
        assert client.post("/captures/wrong/capture").status_code == 200
        refused = client.post("/captures/wrong/capture")
        assert refused.json()["type"] == "/problems/marker-not-moved"
        client.post("/devices/bench/stop")
        run = {"id": "captured", "device_id": "bench", "capture_id": "sim-capture"} | QUICK
        assert client.post("/runs/calibration", json=run).status_code == 202
        with httpx.Client(base_url=url, timeout=60.0) as root:
            done = wait(root, "captured")
            assert done["state"] == "succeeded", done
            errors = root.get(done["result_path"]).json()["errors"]["leave_one_out"]["statistics"]
    assert max(errors["mean_absolute_mm"]) < 0.2
