"""Line shapes from a recording of a moved marker: estimated, stored, used by the pipeline."""

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from typer.testing import CliRunner

from compute.errors import InvalidParameter
from hardware.recording.writer import RecordingWriter
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.scenes import RotatingBar, StillPoints
from hardware.simulated.settings import SimulationSettings
from service.api.radiometric_calibrations.content import RadiometricContent, content_of
from service.api.radiometric_calibrations.recorded_lines import with_line_shapes
from service.cli import app
from service.pipeline.active_calibration import ActiveCalibration, ActiveRadiometric
from service.pipeline.frame_processor import FrameProcessor

if TYPE_CHECKING:
    from hardware.line_frame import LineFrame

pytestmark = pytest.mark.slow
URL = "/api/v1/radiometric-calibrations"


def moved(frames: int) -> tuple[SimulatedDriver, list["LineFrame"]]:
    """One marker on a slanting circle: its line passes over pixels of all sensors, with no gap."""
    rim = RotatingBar(
        length_mm=500.0, period_s=frames / 1000.0, plane_normal=(0.3, 0.2, 1.0)
    ).points(np.arange(frames) / 1000.0)[:, 0]
    seen = []
    for number, point in enumerate(rim):
        settings = SimulationSettings(
            StillPoints((tuple(point.tolist()),)), duration_s=0.001, realtime=False, seed=number
        )
        driver = SimulatedDriver("sim", settings)
        driver.open()
        seen += driver.frames()
    sequence = range(len(seen))
    return driver, [
        replace(frame, sequence=one, exposure_device_ns=one * 1_000_000, exposure_host_ns=one)
        for one, frame in zip(sequence, seen, strict=True)
    ]


def record(path: Path, frames: int) -> Path:
    driver, seen = moved(frames)
    with RecordingWriter(path, driver.description) as writer:
        for frame in seen:
            writer.append(frame)
    return path


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("lines") / "moved.h5", 1000)


def test_command_measures_shapes_that_the_pipeline_fits_with(
    recording: Path, tmp_path: Path
) -> None:
    output = tmp_path / "shape.json"
    arguments = ["radiometric-calibration", "line-shape", str(recording), "--output", str(output)]
    done = CliRunner().invoke(app, [*arguments, "--json"])
    assert done.exit_code == 0, done.output
    figures = json.loads(done.stdout)
    # The simulator's lines are Gaussians.
    assert max(one["line_skewness"] for one in figures) < 0.1
    table = CliRunner().invoke(app, [*arguments, "--force", "--estimate-file", str(output)])
    assert table.exit_code == 0, table.output
    assert "skewness" in table.output

    content = content_of(json.loads(output.read_text()))
    shape = content.sensors["vertical"].line_shape
    assert shape is not None
    assert shape.reduced_chi2 == pytest.approx(1.0, abs=0.1)
    driver, seen = moved(64)
    processor = FrameProcessor("sim", driver.description, "cpu")
    before = processor.process(seen).peaks
    used = ActiveRadiometric("r", content.sensors, content.content_hash(), content.document())
    processor.set_calibration(ActiveCalibration(radiometric=used))
    after = processor.process(seen).peaks
    assert after.count.tolist() == before.count.tolist()
    change = (after.position_px - before.position_px)[:, 0]
    assert 0.0 < np.abs(change).max() < 0.05
    # A shape that is shifted by a fifth of a pixel moves the readings by that.
    aside = {}
    for name, one in content.sensors.items():
        assert one.line_shape is not None
        first_px = one.line_shape.first_px + 0.2
        aside[name] = replace(one, line_shape=replace(one.line_shape, first_px=first_px))
    other = RadiometricContent("sim", aside)
    processor.set_calibration(
        ActiveCalibration(
            radiometric=ActiveRadiometric("s", aside, other.content_hash(), other.document())
        )
    )
    moved_px = (processor.process(seen).peaks.position_px - after.position_px)[:, 0]
    assert float(np.median(moved_px)) == pytest.approx(-0.2, abs=0.01)


def test_too_few_frames_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidParameter, match="of 100 scans have one clear line"):
        with_line_shapes(record(tmp_path / "few.h5", 100), {})


def test_recording_on_the_server_becomes_a_calibration(
    sqlite_client: Any, settings: Any, recording: Path
) -> None:
    folder: Path = settings.folders.recordings
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "moved.h5").write_bytes(recording.read_bytes())
    made = sqlite_client.post(
        URL, json={"id": "shaped", "device_id": "sim",
                   "source": {"kind": "lines", "recording_id": "moved.h5"}},
    )  # fmt: skip
    assert made.status_code == 201, made.text
    assert made.json()["origin"] == "lines"
    document = sqlite_client.get(f"{URL}/shaped").json()
    shape = document["content"]["sensors"]["vertical"]["line_shape"]
    assert len(shape["light"]) == 17
    assert sqlite_client.post(f"{URL}/shaped/activate").json()["active"] is True
