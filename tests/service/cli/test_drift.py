"""`lumiline drift`: a sensor is knocked, told, and mended."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from compute.calibration.calibrate import calibrate
from compute.camera.model import SensorModel
from service.cli import app
from service.cli.json_files import DOCUMENT, read_calibration
from tests.compute.rig import (
    THIRD_LENS_MM,
    control_points,
    geometry,
    project,
    rig,
    turned_about_lens,
)

SIGMA_PX = 0.05


def drift(*arguments: object) -> Any:
    return CliRunner().invoke(app, ["drift", *map(str, arguments)], env={"COLUMNS": "200"})


def knocked() -> tuple[SensorModel, ...]:
    """The rig, its third sensor rolled by 4 mrad."""
    models = list(rig())
    models[2] = turned_about_lens(models[2], [0.0, 0.0, 4e-3], THIRD_LENS_MM)
    return tuple(models)


def write(path: Path, models: tuple[SensorModel, ...], seed: int, markers: int = 8) -> Path:
    points = control_points(markers, 50)
    readings = project(models, points)
    readings = readings + np.random.default_rng(seed).normal(0.0, SIGMA_PX, readings.shape)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        # Another order than the calibration's.
        order = [2, 0, 3, 1]
        writer.writerow(["X_mm", "Y_mm", "Z_mm", *(f"{models[place].name}_px" for place in order)])
        for point, row in zip(points.tolist(), readings[:, order].tolist(), strict=True):
            writer.writerow([*point, *row])
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A calibration, and its markers as they read then, now, and now that it was knocked."""
    folder = tmp_path_factory.mktemp("drift")
    points = control_points(40, 1)
    rng = np.random.default_rng(1)
    readings = project(rig(), points) + rng.normal(0.0, SIGMA_PX, (40, 4))
    found = calibrate(points, readings, geometry(rig()), np.full(readings.shape, SIGMA_PX))
    (folder / "camera.json").write_bytes(DOCUMENT.dump_json(found))
    write(folder / "then.csv", rig(), 2)
    write(folder / "now.csv", rig(), 3)
    write(folder / "knocked.csv", knocked(), 4)
    write(folder / "fewer.csv", knocked(), 4, markers=5)
    return folder


@pytest.mark.parametrize("earlier", [(), ("--earlier", "then.csv")], ids=["places", "earlier"])
def test_a_knocked_sensor_is_told_and_mended(folder: Path, tmp_path: Path, earlier: Any):
    given = ["--calibration", folder / "camera.json", *(folder / name if name.endswith("csv")
             else name for name in earlier)]  # fmt: skip
    good = drift(folder / "now.csv", *given)
    assert good.exit_code == 0, good.output
    assert "The calibration holds (32 readings" in good.output
    bad = drift(folder / "knocked.csv", *given)
    assert bad.exit_code == 1
    assert "Sensor s3 is off by" in bad.output
    assert "rolled about its optical axis, by" in bad.output
    told = json.loads(drift(folder / "knocked.csv", *given, "--json").stdout)
    assert told["status"] == "sensors-moved"
    assert [one["moved"] for one in told["sensors"]] == [False, False, True, False]
    mended = tmp_path / "mended.json"
    written = drift(folder / "knocked.csv", *given, "--update-sensors", "s3", "--output", mended)
    assert written.exit_code == 0, written.output
    assert read_calibration(mended).calibration.method == "update"
    again = drift(folder / "knocked.csv", "--calibration", mended)
    assert again.exit_code == 0, again.output


def test_what_does_not_go_together_is_refused(folder: Path, tmp_path: Path):
    given = ["--calibration", folder / "camera.json"]
    other = tmp_path / "other.csv"
    other.write_text("X_mm,Y_mm,Z_mm,left_px\n1,2,3,4\n", encoding="utf-8")
    for arguments, words in (
        ((other, *given), "the calibration is of s1, s2, s3, s4"),
        ((folder / "now.csv", *given, "--earlier", folder / "fewer.csv"), "the same markers"),
        ((tmp_path / "none.csv", *given), "cannot be read"),
        (
            (
                folder / "now.csv",
                *given,
                "--update-sensors",
                "s9",
                "--output",
                tmp_path / "out.json",
            ),
            "no sensor s9",
        ),
    ):
        wrong = drift(*arguments)
        assert wrong.exit_code == 2
        assert words in " ".join(wrong.stderr.split()), arguments
    assert not (tmp_path / "out.json").exists()
