"""`--sensors`: sensors of different pixels and pitch, from a device, a profile or a list."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from compute.calibration.assessment.assess import calibrate_and_assess
from compute.calibration.settings import CalibrationSettings
from compute.camera.model import SensorGeometry
from compute.errors import InvalidParameter
from compute.optics.profiles.profile_loader import load_profile
from service.api.devices.schema import check_sensors
from service.cli.json_files import read_calibration
from service.cli.observations_csv import read_observations
from service.cli.sensor_geometry import read_sensors, with_geometry
from tests.service.cli.test_commands import QUICK, here

EXAMPLES = Path(__file__).parents[3] / "docs" / "examples"
FRAME = EXAMPLES / "frame-at-1-m.csv"
DEVICE = json.loads((EXAMPLES / "device.json").read_text(encoding="utf-8"))
SENSORS = tuple(SensorGeometry(**one) for one in DEVICE["source"]["sensors"])
LISTED = ", ".join(f"{one.name} = {one.pixels}@{one.pitch_um}" for one in SENSORS)


def _reversed_columns(path: Path) -> Path:
    """The frame with its sensors in another order than the device's."""
    with FRAME.open(encoding="utf-8") as file:
        rows = list(csv.reader(file))
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([*row[:3], *reversed(row[3:])] for row in rows)
    return path


def test_calibrate_sensors_of_different_pixels_equal_to_library(tmp_path: Path) -> None:
    frame, output = _reversed_columns(tmp_path / "frame.csv"), tmp_path / "camera.json"
    here("calibrate", frame, "--sensors", EXAMPLES / "device.json", "--output", output, *QUICK)
    found = read_calibration(output).calibration
    table = read_observations(FRAME)
    settings = CalibrationSettings("none", labels="off")
    expected = calibrate_and_assess(
        table.points_mm, table.readings_px, SENSORS, table.sigma_px, settings
    )
    assert found.models == expected.models
    assert found.covariance == expected.covariance
    assert [model.pixels for model in found.models] == [480, 640, 480, 480]
    check_sensors("frame-rig", [*map(_described, DEVICE["source"]["sensors"])], found.models)


def _described(sensor: dict[str, Any]) -> Any:
    from hardware.driver import SensorDescription

    return SensorDescription(**sensor)


def test_read_sensors_device_sent_or_posted_and_list_are_alike(tmp_path: Path) -> None:
    sent = tmp_path / "sent.json"
    sent.write_text(json.dumps({"id": "x", "sensors": DEVICE["source"]["sensors"]}), "utf-8")
    for text in (str(sent), str(EXAMPLES / "device.json"), LISTED):
        assert read_sensors(text) == SENSORS, text


def test_read_sensors_profile_has_those_of_its_device() -> None:
    profile = load_profile("optotrak")
    assert read_sensors("optotrak") == tuple(
        SensorGeometry(one.name, profile.pixels.count, profile.pixels.pitch_um)
        for one in profile.sensors
    )


def test_read_sensors_without_pitch_pitch_is_not_known() -> None:
    assert read_sensors("a=480,b=640@7") == (
        SensorGeometry("a", 480), SensorGeometry("b", 640, 7.0),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a=480,b", '"b" must be a sensor\'s name, its pixels and'),
        ("a=many", "pixels: Input should be a valid integer"),
        ("a=480.5", "pixels: Input should be a valid integer"),
        ("a=4", "greater than or equal to 8"),
        ("a=480@0", "pitch_um: Input should be greater than 0"),
        ("a=480@nan", "pitch_um: Input should be a finite number"),
        ("a=480@", "pitch_um: Input should be a valid number"),
        ("=480", "name: String should have at least 1 character"),
        ("a=480,a=640", '"a" twice; give each sensor once'),
        ("no-such-thing", "neither a file nor the name of a profile"),
        ("none.json", "cannot be read"),
    ],
)
def test_read_sensors_wrong_text_is_refused_in_words(text: str, message: str) -> None:
    with pytest.raises(InvalidParameter) as raised:
        read_sensors(text)
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], "names no sensors; it must be a device as GET"),
        ({"items": [DEVICE]}, "names no sensors; it must be a device as GET"),
        ({"source": {"kind": "simulated"}}, "names no sensors"),
        ({"sensors": [{"name": "a"}]}, "0.pixels: Field required"),
        ({"sensors": [{"name": "a", "pixels": 0, "pitch_um": 1}]}, "greater than or equal to 8"),
    ],
)
def test_read_sensors_file_of_no_device_is_refused(
    content: Any, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "device.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(InvalidParameter) as raised:
        read_sensors(str(path))
    assert message in str(raised.value)


@pytest.mark.parametrize(
    ("sensors", "message"),
    [
        ("cam1=480,cam2=640,cam3=480", "add cam4 to --sensors;"),
        (f"{LISTED},cam5=480", "leave cam5 out of it, or add its readings"),
        (LISTED.replace("cam4", "cam5"), "add cam4 to --sensors and leave cam5 out of it"),
        (None, "give --sensors with a device's JSON file or as cam1=480@10.58,cam2="),
    ],
)
def test_with_geometry_other_sensors_than_the_file_has_is_refused(
    sensors: str | None, message: str
) -> None:
    with pytest.raises(InvalidParameter) as raised:
        with_geometry(read_observations(FRAME), sensors, None)
    assert message in str(raised.value)


def test_with_geometry_alike_sensors_need_pixels_only() -> None:
    table, sensors = with_geometry(read_observations(FRAME), None, 640, 10.0)
    assert sensors == tuple(SensorGeometry(name, 640, 10.0) for name in table.sensors)


def test_with_geometry_readings_are_in_the_order_of_sensors(tmp_path: Path) -> None:
    table, sensors = with_geometry(
        read_observations(_reversed_columns(tmp_path / "frame.csv")), LISTED, None
    )
    assert sensors == SENSORS
    assert table.sensors == tuple(one.name for one in SENSORS)
    np.testing.assert_array_equal(table.readings_px, read_observations(FRAME).readings_px)
