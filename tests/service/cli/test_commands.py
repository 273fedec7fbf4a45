"""The commands as a user runs them; in a process of their own where that plays a part."""

import csv
import errno
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from hardware.line_frame import LineFrame
from hardware.recording.writer import RecordingWriter
from service.cli import app
from tests.hardware.recording.blocks import read_recording
from validation.all_cases import ALL_CASES
from validation.thesis_data import DFW_V500, load_test


def lumiline(*arguments: str | Path, code: int = 0) -> "subprocess.CompletedProcess[str]":
    run = subprocess.run(
        [sys.executable, "-m", "service.cli", *map(str, arguments)],
        capture_output=True, text=True, timeout=240, check=False,
    )  # fmt: skip
    assert run.returncode == code, (run.stdout, run.stderr)
    return run


def here(*arguments: str | Path, code: int = 0) -> Result:
    """A command in this process: a new one takes seconds to load what this one has."""
    run = CliRunner().invoke(app, [*map(str, arguments)], env={"COLUMNS": "80"})
    assert run.exit_code == code, (run.output, run.exception)
    return run


QUICK = ("--distortion", "none", "--labels", "off")
"""For calibrations of which it does not matter how good they are."""


@pytest.fixture(scope="module")
def frame_csv(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The thesis's frame at 1 m."""
    test = load_test("5.4")
    path: Path = tmp_path_factory.mktemp("frame") / "frame.csv"
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["X_mm", "Y_mm", "Z_mm", *(f"{scale.name}_px" for scale in DFW_V500)])
        for point, readings in zip(test.points_mm, test.readings_mm, strict=True):
            pixels = [float(s.to_px(r)) for s, r in zip(DFW_V500, readings, strict=True)]
            writer.writerow([*point, *pixels])
    return path


def test_reproduce_lists_the_cases() -> None:
    cases = json.loads(here("reproduce", "--json").stdout)
    assert [case["name"] for case in cases] == list(ALL_CASES)
    assert {f"test-5.{number}" for number in range(1, 9)} < set(ALL_CASES)
    shown = here("reproduce").stdout
    assert all(case["name"] in shown for case in cases)


@pytest.mark.slow
def test_reproduce_prints_both_figures_and_says_them_to_machines() -> None:
    text = lumiline("reproduce", "test-5.4").stdout
    assert re.search(r"thesis: DLT.* 3\.57 .* 4\.6 .* 16 ", text)
    result = json.loads(here("reproduce", "test-5.4", "--json").stdout)
    assert result["published"][0]["errors"]["mean_absolute_mm"] == [3.57, 4.6, 16.04]
    ours = {column["label"]: column["errors"] for column in result["ours"]}
    assert ours["metric (default)"]["mean_absolute_mm"][2] < 3.5


def test_an_unknown_case_names_the_known_ones() -> None:
    assert "test-5.4" in here("reproduce", "test-9", code=2).stderr


def test_bench_lists_what_there_is() -> None:
    assert {"live", "signal"} <= set(here("bench").stdout.split())
    assert "signal" in here("bench", "nothing", code=2).stderr


@pytest.mark.slow
def test_record_and_replay(frame_csv: Path, tmp_path: Path) -> None:
    """Frames recorded, calibrated from their own peaks elsewhere, replayed bit by bit."""
    recording, settings = tmp_path / "frame.h5", tmp_path / "settings.json"
    settings.write_text('{"scene": {"kind": "calibration-frame"}}', encoding="utf-8")
    here("record", recording, "--seconds", "0.1", "--simulation", settings)
    assert "--force" in " ".join(here("record", recording, code=2).stderr.split())

    other = tmp_path / "other.json"
    here("calibrate", frame_csv, "--pixels", "640", "--output", other, *QUICK)
    refused = here("replay", recording, "--calibration", other, code=2)
    assert "cam1" in refused.stderr

    nominal = tmp_path / "nominal.json"
    nominal.write_bytes(nominal_document())
    first, second = tmp_path / "first.jsonl", tmp_path / "second.jsonl"
    for output, command in ((first, lumiline), (second, here)):
        command("replay", recording, "--calibration", nominal, "--output", output)
    assert first.read_bytes() == second.read_bytes()
    messages = [json.loads(line) for line in first.read_text(encoding="utf-8").splitlines()]
    assert [message["sequence"] for message in messages] == list(range(100))
    assert {message["marker"] for message in messages} == set(range(19))
    assert all(message["points"][0]["position_mm"] for message in messages)


def check_replay_and_export(recording: Path) -> None:
    """Points and an export without any file beside the recording."""
    messages = [json.loads(line) for line in here("replay", recording).stdout.splitlines()]
    assert {message["calibration_id"] for message in messages} == {f"{recording.stem}-nominal"}
    assert any(message["points"] for message in messages)
    export = recording.with_suffix(".csv")
    here("export", recording, "--output", export)
    assert "point" in export.read_text(encoding="utf-8")


def test_record_of_the_simulated_bar_holds_its_calibration(tmp_path: Path) -> None:
    recording = tmp_path / "sim.h5"
    here("record", recording, "--seconds", "0.05")
    check_replay_and_export(recording)


@pytest.mark.slow
def test_record_of_a_profile_holds_its_calibration(tmp_path: Path) -> None:
    recording = tmp_path / "optotrak.h5"
    here("record", recording, "--profile", "optotrak", "--seconds", "0.02")
    check_replay_and_export(recording)


@pytest.mark.slow
def test_an_interrupted_recording_is_a_recording(tmp_path: Path) -> None:
    path = tmp_path / "long.h5"
    process = subprocess.Popen(
        [sys.executable, "-m", "service.cli", "record", str(path), "--seconds", "3000"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    end = time.monotonic() + 240.0
    while not any(one.stat().st_size > 5_000_000 for one in tmp_path.glob(".long.h5.*/long.h5")):
        assert process.poll() is None
        assert time.monotonic() < end
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=120.0)
    assert process.returncode == 0, errors
    info = read_recording(path)
    assert info.complete
    assert 100 < info.frames < 3_000_000
    assert list(tmp_path.iterdir()) == [path]


def test_record_that_fails_leaves_the_recording_that_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "there.h5"
    here("record", path, "--seconds", "0.02")
    before = path.read_bytes()
    append, calls = RecordingWriter.append, []

    def full(writer: RecordingWriter, frame: LineFrame, row: int) -> None:
        calls.append(row)
        if len(calls) > 10:
            assert path.read_bytes() == before
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        append(writer, frame, row)

    monkeypatch.setattr(RecordingWriter, "append", full)
    run = here("record", path, "--seconds", "0.05", "--force", code=2)
    assert "there.h5 cannot be written: No space left on device" in " ".join(run.stderr.split())
    assert list(tmp_path.iterdir()) == [path]
    assert path.read_bytes() == before


@pytest.mark.slow
def test_a_reader_that_leaves_is_no_error(tmp_path: Path) -> None:
    recording, nominal = tmp_path / "bar.h5", tmp_path / "nominal.json"
    nominal.write_bytes(nominal_document())
    here("record", recording, "--seconds", "0.3")
    command = ["replay", str(recording), "--calibration", str(nominal)]
    with subprocess.Popen(
        [sys.executable, "-m", "service.cli", *command],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    ) as process:  # fmt: skip
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.readline()
        process.stdout.close()
        errors = process.stderr.read().decode()
        assert process.wait(240.0) == 0
    assert "error" not in errors.lower()


def test_an_output_that_cannot_be_written(frame_csv: Path, tmp_path: Path) -> None:
    output = tmp_path / "nowhere" / "calibration.json"
    given = ("calibrate", frame_csv, "--pixels", "640", *QUICK, "--output", output)
    run = here(*given, code=2)
    assert "cannot be written" in " ".join(run.stderr.split())
    assert "Traceback" not in run.stderr


def nominal_document() -> bytes:
    """The simulator's own cameras, as `lumiline calibrate` writes a calibration."""
    from compute.calibration.result import Calibration, SensorFit
    from hardware.simulated.simulated_rig import simulated_sensor_models
    from service.cli.json_files import DOCUMENT

    fits = tuple(
        SensorFit(model, 0, 0.0, 0.0, 1e-3, "given", None) for model in simulated_sensor_models()
    )
    zeros = tuple(tuple([0.0] * 28) for _ in range(28))
    document: bytes = DOCUMENT.dump_json(Calibration("metric", fits, zeros, ()))
    return document


@pytest.mark.slow
def test_demo_runs_and_draws(tmp_path: Path) -> None:
    run = here("demo", "--output", tmp_path, "--seconds", "2")
    for part in ("Test 5.3", "Test 5.4", "frames/s", "p99", "bar length, mean"):
        assert part in run.stdout
    picture = (tmp_path / "demo.png").read_bytes()
    assert picture.startswith(b"\x89PNG")
    mean = float(re.search(r"bar length, mean, mm\D+([\d.]+)", run.stdout)[1])  # type: ignore[index]
    spread = float(re.search(r"standard deviation, mm\D+([\d.]+)", run.stdout)[1])  # type: ignore[index]
    # Five standard errors of a mean of some hundred lengths, and 1e-4 for the calibration.
    assert abs(mean - 292.0) < 5 * spread / 10 + 0.03
    assert spread < 0.1
