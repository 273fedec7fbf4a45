"""`lumiline calibrate` and `lumiline map` as a user runs them."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

import service.api
from compute.camera.field_distortion import FieldDistortion
from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from service.cli import app
from service.cli.calibrate import label_message
from service.cli.json_files import read_calibration
from tests.compute.rig import rig
from tests.service.cli.test_commands import QUICK, frame_csv, here
from validation.thesis_data import DFW_V500, load_test

__all__ = ["frame_csv"]

SIGMA_PX = 0.03


def bent_rig() -> tuple[SensorModel, ...]:
    """The rig behind lenses that bend by some pixels."""
    bend = FieldDistortion(((3, 0), (1, 2)), (0.25, 0.3), 0.0, 30.0)
    return tuple(replace(model, distortion=bend) for model in rig())


@pytest.fixture(scope="module")
def mapping_csv(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """200 places in a cube of half a metre, read with noise."""
    rng = np.random.default_rng(4)
    points = np.array([0.0, 0.0, 1500.0]) + rng.uniform(-250.0, 250.0, (200, 3))
    readings = CameraStack.of(bent_rig()).project(points)
    readings += rng.normal(0.0, SIGMA_PX, readings.shape)
    path: Path = tmp_path_factory.mktemp("map") / "map.csv"
    names = [model.name for model in bent_rig()]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        head = [f"{name}{end}" for name in names for end in ("_px", "_sigma_px")]
        writer.writerow(["X_mm", "Y_mm", "Z_mm", *head])
        for point, row in zip(points.tolist(), readings.tolist(), strict=True):
            writer.writerow([*point, *(cell for value in row for cell in (value, SIGMA_PX))])
    return path


@pytest.mark.slow
def test_calibrate_writes_what_the_service_would_compute(frame_csv: Path, tmp_path: Path) -> None:
    output, report = tmp_path / "calibration.json", tmp_path / "report.html"
    figures = tmp_path / "figures"
    shown = here(
        "calibrate", frame_csv, "--pixels", "640", "--output", output, "--report", report,
        "--report-figures", figures,
    ).stdout  # fmt: skip
    assert "cam3" in shown
    assert "leave one out" in shown
    document = json.loads(output.read_text(encoding="utf-8"))
    names = [s.name for s in DFW_V500]
    assert [fit["model"]["name"] for fit in document["sensors"]] == names
    counts = [model.parameter_count for model in read_calibration(output).calibration.models]
    assert len(document["covariance"]) == sum(counts)
    page = report.read_text(encoding="utf-8")
    assert all(name in page for name in names)
    assert list(figures.glob("*.png"))


def thesis_csv(path: Path, exchanged: tuple[int, int] | None = None) -> Path:
    """Test 5.3 with the pixels' pitch only, and two readings of camera 4 exchanged back."""
    test = load_test("5.3")
    readings = np.asarray(test.readings_mm) / 0.0127
    if exchanged is not None:
        pair = [point - 1 for point in exchanged]
        readings[pair, 3] = readings[pair[::-1], 3]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["X_mm", "Y_mm", "Z_mm", *(f"cam{number}_px" for number in range(1, 5))])
        writer.writerows(np.hstack([test.points_mm, readings]).tolist())
    return path


def error_rows(shown: str) -> dict[str, list[str]]:
    """The table of errors by its rows' labels."""
    cells = [
        [cell.strip() for cell in line.split("│")[1:-1]]
        for line in shown.splitlines()
        if line.startswith("│")
    ]
    return {row[0]: row[1:] for row in cells if len(row) == 8}


@pytest.mark.slow
def test_distortion_of_few_points_is_estimated_with_a_reason(tmp_path: Path) -> None:
    output = tmp_path / "calibration.json"
    shown = here(
        "calibrate", thesis_csv(tmp_path / "frame.csv"), "--pixels", "640", "--output", output
    ).stdout
    found = read_calibration(output).calibration.distortion
    assert found is not None
    assert found.scale is not None
    assert f"distortion: auto ({found.reason})" in " ".join(shown.split())


@pytest.mark.slow
def test_errors_are_over_the_readings_that_the_calibration_used(tmp_path: Path) -> None:
    wrong = thesis_csv(tmp_path / "wrong.csv")
    right = thesis_csv(tmp_path / "right.csv", (14, 16))
    given = ("--pixels", "640", "--distortion", "none")
    repaired = here("calibrate", wrong, *given, "--labels", "repair").stdout
    by_hand = here("calibrate", right, *given, "--labels", "off").stdout
    assert error_rows(repaired) == error_rows(by_hand)
    # Three points cannot be predicted without their block of space; they are in no row.
    assert {row[-1] for row in error_rows(repaired).values()} == {str(16 * 4)}
    assert "3 of 19 points are in no row" in " ".join(repaired.split())
    for options in (("--labels", "exclude"), ("--labels", "off", "--loss", "robust")):
        shown = here("calibrate", wrong, *given, *options).stdout
        rows = error_rows(shown)
        missing = "points are in no row" in shown
        assert (rows["fitted"][-1] == str(19 * 4 - 2)) != missing, options
        assert len({row[-1] for row in rows.values()}) == 1, options


def test_calibrate_refuses_with_a_reason(frame_csv: Path, tmp_path: Path) -> None:
    rows = frame_csv.read_text(encoding="utf-8").splitlines()
    few = tmp_path / "few.csv"
    few.write_text("\n".join(rows[:6]), encoding="utf-8")
    assert "at least 7" in here("calibrate", few, "--pixels", "640", code=2).stderr
    for option, value, reason in (
        ("--distortion", "barrel", "symmetric-3"),
        ("--distortion", "3,0 0,1", "roll"),
        ("--distortion", "3;0", '"i,j"'),
        ("--labels", "mend", "report"),
        ("--position-sigma", "-1", "--position-sigma"),
    ):
        given = ["calibrate", str(frame_csv), "--pixels", "640", option, value]
        wrong = CliRunner().invoke(app, given)
        assert wrong.exit_code == 2
        assert reason in " ".join(wrong.stderr.split()), (option, value)


@pytest.mark.slow
def test_a_wide_field_is_calibrated_with_its_distortion(mapping_csv: Path, tmp_path: Path) -> None:
    output = tmp_path / "calibration.json"
    given = ("calibrate", mapping_csv, "--pixels", "2048", "--pitch-um", "10", "--output", output)
    here(*given, "--labels", "off")
    found = read_calibration(output).calibration
    for model, true, fit in zip(found.models, bent_rig(), found.sensors, strict=True):
        assert model.distortion is not None
        assert fit.rms_px == pytest.approx(SIGMA_PX, rel=0.2)
        assert model.principal_distance_px == pytest.approx(true.principal_distance_px, abs=3.0)


@pytest.mark.slow
def test_map_writes_a_table_that_mends_a_plain_calibration(
    mapping_csv: Path, tmp_path: Path
) -> None:
    plain, table = tmp_path / "plain.json", tmp_path / "table.h5"
    here("calibrate", mapping_csv, "--pixels", "2048", *QUICK, "--output", plain)
    given = ("map", mapping_csv, "--calibration", plain, "--calibration-points", "--output", table)
    shown = here(*given).stdout
    assert "s1" in shown
    with h5py.File(table) as file:
        assert file.attrs["calibration_hash"].decode() == read_calibration(plain).content_hash
        validation = json.loads(file.attrs["validation"])
    for sensor in validation["sensors"]:
        assert sensor["before_rms_px"] > 10.0 * SIGMA_PX
        assert sensor["left_out_rms_px"] < 3.0 * SIGMA_PX
    assert "--force" in " ".join(here(*given, code=2).stderr.split())


def test_map_refuses_with_a_reason(mapping_csv: Path, frame_csv: Path, tmp_path: Path) -> None:
    table, other = tmp_path / "table.h5", tmp_path / "other.json"
    other.write_text('{"cameras": []}', encoding="utf-8")
    wrong = here("map", mapping_csv, "--calibration", other, "--output", table, code=2)
    assert "holds no calibration" in " ".join(wrong.stderr.split())
    calibration = tmp_path / "calibration.json"
    here("calibrate", frame_csv, "--pixels", "640", *QUICK, "--output", calibration)
    wrong = here("map", mapping_csv, "--calibration", calibration, "--output", table, code=2)
    assert "cam1" in wrong.stderr
    assert not table.exists()


def test_findings_are_told_in_words() -> None:
    from compute.calibration.mislabels.repair import LabelFinding

    numbers = [str(number) for number in range(1, 17)]
    exchanged = LabelFinding("exchanged", "cam4", (14, 16), 0.999, (12.0, -11.0), (9.0, -8.0))
    assert label_message(exchanged, numbers) == (
        "sensor cam4: the readings of points 14 and 16 are exchanged (probability 0.999)"
    )
    outlier = LabelFinding("outlier", "cam1", (3,), 1.0, (25.0,), (-20.0,))
    assert "point 3 is an outlier, off by 25 px or 20 sigma" in label_message(outlier, numbers)
    wrong = LabelFinding("wrong-label", "cam2", (4, 7), 0.9, (25.0, None), (20.0, None))
    assert label_message(wrong, "abcdefgh").startswith(
        "sensor cam2: the reading labelled d is point g's"
    )


def test_error_rows_points_not_predicted_are_in_no_row(monkeypatch: pytest.MonkeyPatch) -> None:
    from types import SimpleNamespace
    from typing import Any, cast

    from service.cli import calibrate

    full = np.ones((4, 3))
    readings = np.ones((4, 5))
    monkeypatch.setattr(calibrate, "control_errors", lambda *_: (full, 20))
    monkeypatch.setattr(calibrate, "effective_readings", lambda _, used: (used, None))
    points = SimpleNamespace(scheme="points", groups=4, differences_mm=[None, *full[1:]])
    blocks = SimpleNamespace(scheme="blocks", groups=2, differences_mm=[None] * 3 + [full[0]])
    table = SimpleNamespace(points_mm=full, readings_px=readings, sigma_px=None)
    result = SimpleNamespace(cross_validation=(points, blocks))
    errors = calibrate._error_rows(cast("Any", result), cast("Any", table))
    assert [(label, one.points, count) for label, one, count in errors.rows] == [
        ("fitted", 3, 15),
        ("leave one out", 3, 15),
    ]
    assert errors.missing_points == [0]
    assert "2 blocks left out: no row, because only 1 of 4" in errors.remarks[0]


def test_read_calibration_sent_by_the_service_names_its_device(tmp_path: Path) -> None:
    """So that a table that is made from it can be uploaded."""
    examples = json.loads(
        (Path(service.api.__file__).parent / "answer_examples.json").read_text(encoding="utf-8")
    )
    sent = examples["get-calibration"]
    path = tmp_path / "sent.json"
    path.write_text(json.dumps(sent), encoding="utf-8")
    read = read_calibration(path)
    assert (read.device, read.content_hash) == (sent["device_id"], sent["content_hash"])
