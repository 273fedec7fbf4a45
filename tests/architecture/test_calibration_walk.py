"""One calibration, from its POST to the device's active pointer: the modules that run."""

from pathlib import Path
from typing import Any

from service.api.calibrations.examples import NEW_CALIBRATIONS
from service.application.app import create_app
from service.settings import Settings
from tests.architecture.walks import differences, listed, tracing
from tests.service.fake_pipeline import FakePipeline, TestClient

MAX_REQUEST = 12
MAX_CALIBRATION = 30
BACKGROUND = {
    "compute.errors",  # of devices that do not run
    "service.api.quality.drift_monitor",
    "service.api.quality.store",
    "service.api.recordings.recording_manager",
    "service.api.webhooks.sources",
    "service.jobs.run_manager",
    "service.jobs.store",
}
"""Modules of threads that wake by themselves while the requests are served."""


def calibrate(client: Any, name: str) -> None:
    """Post a calibration of the frame and make it the active one."""
    body = {
        "id": name,
        "device_id": "sim",
        "points": NEW_CALIBRATIONS["frame"]["value"]["points"],
        "distortion": "none",
        "labels": "off",
    }
    assert client.post("/api/v1/calibrations", json=body).status_code == 201
    assert client.post(f"/api/v1/calibrations/{name}/activate").status_code == 200


def test_walk_of_a_calibration_runs_the_modules_of_the_tables(tmp_path: Path) -> None:
    app = create_app(Settings(data_dir=tmp_path), FakePipeline())
    with tracing() as trace, TestClient(app) as client:
        calibrate(client, "before")  # what is loaded at first use
        trace.on = True
        calibrate(client, "traced")
        trace.on = False
        assert client.get("/api/v1/devices/sim").json()["active_calibration_id"] == "traced"
    request, calibration = listed("What every request passes"), listed("A calibration")
    assert not differences(trace.modules - BACKGROUND, [*request, *calibration])
    assert len(request) <= MAX_REQUEST
    assert len(calibration) <= MAX_CALIBRATION
