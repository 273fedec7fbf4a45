"""One calibration, from its POST to the active pointer: the modules that run."""

from pathlib import Path
from unittest.mock import patch

from service.api.calibrations.examples import NEW_CALIBRATIONS
from service.application.app import create_app
from service.application.bootstrap import prepare
from service.database.engine import Database
from service.settings import Settings
from tests.architecture.walks import differences, listed, tracing
from tests.service.fake_pipeline import FakePipeline, TestClient

MAX_MODULES = 51


def test_walk_of_a_calibration_runs_the_modules_of_the_table(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    database = Database(settings.effective_database_url)
    prepare(settings, database)
    database.close()
    points = NEW_CALIBRATIONS["frame"]["value"]["points"]

    def calibrate(client: TestClient, identity: str) -> None:
        body = {"id": identity, "device": "sim", "points": points, "distortion": "none"}
        made = client.post("/api/v1/calibrations", json=body)
        assert made.status_code == 201, made.text
        active = client.post(f"/api/v1/calibrations/{identity}/activate")
        assert active.status_code == 200, active.text

    with (
        # Looks after recordings in a thread of its own, whatever is asked for.
        patch("service.api.recordings.recording_manager.RecordingManager._settle"),
        tracing() as trace,
        TestClient(create_app(settings, FakePipeline())) as client,
    ):
        calibrate(client, "first")
        trace.on = True
        calibrate(client, "second")
        trace.on = False
    assert not differences(trace.modules, listed("Calibration"))
    assert len(trace.modules) <= MAX_MODULES
