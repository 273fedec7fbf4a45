"""A radiometric calibration in the frame processor, in stream messages and in recordings."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter, InvalidRecording
from hardware.line_frame import LineFrame
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.pixel_defects import PixelDefects
from hardware.simulated.scenes import EvenLight, Scene, StillPoints
from hardware.simulated.settings import SimulationSettings
from hardware.simulated.simulated_rig import simulated_sensor_models
from service.api.radiometric_calibrations.content import RadiometricContent, estimate_sensors
from service.api.radiometric_calibrations.frame_statistics import statistics_of
from service.api.recordings.active_calibration_file import (
    dump_active_calibration,
    load_active_calibration,
)
from service.pipeline.active_calibration import (
    NO_ACTIVE_CALIBRATION,
    ActiveCalibration,
    ActiveRadiometric,
)
from service.pipeline.frame_processor import FrameProcessor
from service.protocols.stream.messages import StreamBatch

if TYPE_CHECKING:
    from compute.signal.radiometric_calibration import RadiometricCalibration

DEFECTS = PixelDefects(response_nonuniformity=0.05, dead_pixels=0, hot_pixels=0, stuck_pixels=0)
POINTS = tuple((x, y, 1500.0) for x in (-250.0, -40.0, 170.0) for y in (-200.0, 20.0, 210.0))


def frames(scene: Scene, count: int) -> list[LineFrame]:
    settings = SimulationSettings(
        scene, duration_s=count / 1000.0, pixels=DEFECTS, realtime=False, seed=3
    )
    driver = SimulatedDriver("sim", settings)
    driver.open()
    return list(driver.frames())


@pytest.fixture(scope="module")
def radiometric() -> ActiveRadiometric:
    names = [model.name for model in simulated_sensor_models()]
    dark, *flats = (
        statistics_of((frame.lines for frame in frames(EvenLight(electrons), 48)), len(names))
        for electrons in (0.0, 12_000.0, 24_000.0, 36_000.0)
    )
    sensors = estimate_sensors(names, dark, flats, full_scale_counts=4095)
    content = RadiometricContent("sim", sensors)
    return ActiveRadiometric("r1", sensors, content.content_hash(), content.document())


def test_peaks_are_found_with_it_from_the_next_batch_on(radiometric: ActiveRadiometric) -> None:
    seen = frames(StillPoints(POINTS), 36)
    truth = CameraStack.of(simulated_sensor_models()).project(np.array(POINTS))
    description = SimulatedDriver("sim", SimulationSettings()).description
    processor = FrameProcessor("sim", replace(description, markers=len(POINTS)), "cpu")

    def errors() -> tuple[float, str | None, bytes]:
        batch = processor.process(seen)
        position = batch.peaks.position_px[:, 0].reshape(len(seen), -1)
        off = position - truth[[frame.marker or 0 for frame in seen]]
        (header,) = StreamBatch(batch).headers(0, 1)
        assert header["radiometric_id"] == batch.radiometric_id
        return float(np.sqrt(np.nanmean(off**2))), batch.radiometric_id, position.tobytes()

    plain, no_id, bits = errors()
    assert no_id is None
    processor.set_calibration(ActiveCalibration(radiometric=radiometric))
    calibrated, used, _ = errors()
    assert used == "r1"
    assert calibrated < 0.6 * plain
    processor.set_calibration(NO_ACTIVE_CALIBRATION)
    assert errors()[1:] == (None, bits)


def test_of_other_sensors_is_refused_and_nothing_changes(radiometric: ActiveRadiometric) -> None:
    description = SimulatedDriver("sim", SimulationSettings()).description
    processor = FrameProcessor("sim", description, "cpu")
    (_, one), *_ = radiometric.sensors.items()
    other = replace(radiometric, sensors={"another": one}, content_hash="x")
    with pytest.raises(InvalidParameter, match=r"is of another \(2048 px\); the device has"):
        processor.set_calibration(ActiveCalibration(radiometric=other))
    assert processor.radiometric_id is None


def test_a_recording_holds_it_with_and_without_a_calibration(
    radiometric: ActiveRadiometric,
) -> None:
    document, table = dump_active_calibration(ActiveCalibration(radiometric=radiometric))
    found = load_active_calibration(document, table, "r").radiometric
    assert found is not None
    assert (found.radiometric_id, found.content_hash) == ("r1", radiometric.content_hash)
    for name, one in radiometric.sensors.items():
        kept: RadiometricCalibration = found.sensors[name]
        assert kept.content_hash() == one.content_hash()
    changed = document.replace(b'"captures": 192', b'"captures": 193')
    assert changed != document
    with pytest.raises(InvalidRecording, match="was changed after it was written"):
        load_active_calibration(changed, table, "r")
