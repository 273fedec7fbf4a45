"""`--json` prints one document on standard output, with what a person is told."""

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from service.cli import app
from tests.service.cli.test_commands import QUICK


def result(*arguments: str | Path) -> Any:
    run = CliRunner().invoke(app, [*map(str, arguments), "--json"])
    assert run.exit_code == 0, (run.output, run.exception)
    return json.loads(run.stdout)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path: Path = tmp_path_factory.mktemp("json") / "examples"
    names = result("examples", path)["files"]
    assert {Path(name).name for name in names} == {one.name for one in path.iterdir()}
    return path


def test_calibrate_prints_calibration_and_errors(folder: Path, tmp_path: Path) -> None:
    output = tmp_path / "camera.json"
    given = ("calibrate", folder / "volume.csv", "--pixels", "2048", *QUICK)
    printed = result(*given, "--output", output)
    assert printed["calibration"] == json.loads(output.read_text(encoding="utf-8"))
    assert printed["errors"][0]["label"] == "fitted"
    assert printed["errors"][0]["readings"] > 700


def test_wand_prints_calibration_and_targets(folder: Path) -> None:
    nominal = folder / "nominal.json"
    printed = result("wand", folder / "waved.csv", "--positions", "0 300", "--calibration", nominal)
    assert len(printed["calibration"]["sensors"]) == 4
    assert printed["targets"][0]["poses"] == 120
    assert 0.5 < printed["chi2_per_dof"] < 2.0


@pytest.mark.slow
def test_map_prints_validation_by_sensor(folder: Path, tmp_path: Path) -> None:
    printed = result(
        "map", folder / "volume.csv", "--calibration", folder / "nominal.json",
        "--output", tmp_path / "map.h5", "--cell", "120",
    )  # fmt: skip
    assert printed["grid"]["pitch_mm"] == [120.0] * 3
    assert len(printed["validation"]["sensors"]) == 4


def test_record_readings_and_export_print_counts(tmp_path: Path) -> None:
    recording, poses, table = (tmp_path / name for name in ("a.h5", "a.csv", "b.csv"))
    assert result("record", recording, "--seconds", "0.05")["frames"] == 50
    before = recording.read_bytes()
    assert result("record", recording, "--seconds", "0.02", "--force")["frames"] == 20
    assert recording.read_bytes() != before
    assert result("readings", recording, "--output", poses)["rows"] > 0
    assert result("export", recording, "--output", table)["frames"] == 20


def test_database_commands_print_counts_and_keys(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    place = ("--data-dir", tmp_path / "data")
    key = result("keys", "create", "console", "--scope", "read:stream", *place)
    assert key["key"].startswith(f"lumi_{key['id']}")
    assert result("keys", "revoke", key["id"], *place) == {"id": key["id"], "state": "revoked"}
    backup = result("backup", tmp_path / "b", *place)
    assert backup["rows"]["api_keys"] == 1
    assert result("check-database", *place)["inconsistencies"] == []
    restored = result("restore", tmp_path / "b", "--replace", *place)
    assert restored["rows"] == backup["rows"]
    assert restored["previous"]


def test_simulate_serial_prints_where_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.cli.simulate_serial.serve_socket", lambda *_: None)
    assert result("simulate-serial", "--listen", "127.0.0.1:0")["url"].startswith("socket://")


def test_failed_recording_of_no_frames_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("hardware.recording.writer.RecordingWriter.append", broken)
    run = CliRunner().invoke(app, ["record", str(tmp_path / "a.h5"), "--seconds", "0.05"])
    assert run.exit_code == 2
    assert "No space left" in run.stderr
    assert not list(tmp_path.iterdir())
