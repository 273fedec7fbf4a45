"""`lumiline radiometric-calibration`: from recordings to a file, and to a server."""

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from hardware.recording.writer import RecordingWriter
from service.cli import app
from tests.service.api.radiometric_calibrations.frames import driver

LEVELS = {"dark": 0.0, "low": 12_000.0, "high": 36_000.0}


def run(*arguments: object, answers: str = "") -> Any:
    return CliRunner().invoke(
        app,
        ["radiometric-calibration", *map(str, arguments)],
        env={"COLUMNS": "200"},
        input=answers,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recordings of covered sensors and of two levels of light."""
    folder = tmp_path_factory.mktemp("radiometric")
    for name, electrons in LEVELS.items():
        source = driver(electrons, 32)
        source.open()
        with RecordingWriter(folder / f"{name}.h5", source.description) as writer:
            for frame in source.frames():
                writer.append(frame)
    return folder


def test_recordings_become_a_file(folder: Path, tmp_path: Path) -> None:
    files = ["--dark", folder / "dark.h5", "--flat", folder / "low.h5", "--flat",
             folder / "high.h5", "--output", tmp_path / "r.json"]  # fmt: skip
    done = run("estimate", *files, "--light", 1, "--light", 3, "--temperature-c", 25, "--json")
    assert done.exit_code == 0, done.output
    figures = json.loads(done.stdout)
    assert len(figures) == 4
    assert all(abs(one["gain_electrons_per_count"] / 12.0 - 1.0) < 0.05 for one in figures)
    assert figures[0]["temperature_c"] == 25.0
    written = json.loads((tmp_path / "r.json").read_text())
    assert list(written["sensors"]) == [one["sensor"] for one in figures]
    again = run("estimate", *files)
    assert again.exit_code == 2
    assert "--force" in again.output


def test_recordings_that_are_not_what_they_should_be_are_told(folder: Path, tmp_path: Path) -> None:
    swapped = run("estimate", "--dark", folder / "low.h5", "--flat", folder / "dark.h5", "--flat",
                  folder / "high.h5", "--output", tmp_path / "x.json")  # fmt: skip
    assert swapped.exit_code == 2
    assert "light in the dark" in swapped.output
    single = run("estimate", "--dark", folder / "dark.h5", "--flat", folder / "high.h5",
                 "--output", tmp_path / "x.json")  # fmt: skip
    assert single.exit_code == 2
    assert "1 levels of light" in single.output
    assert not (tmp_path / "x.json").exists()


@pytest.mark.slow
def test_a_server_stores_and_uses_it(server: str, folder: Path, tmp_path: Path) -> None:
    output = tmp_path / "r.json"
    run("estimate", "--dark", folder / "dark.h5", "--flat", folder / "low.h5", "--flat",
        folder / "high.h5", "--output", output)  # fmt: skip
    uploaded = run("upload", output, "sim", "--id", "by-hand", "--url", server)
    assert uploaded.exit_code == 0, uploaded.output
    assert "stored as by-hand" in uploaded.output
    assert run("activate", "by-hand", "--url", server).output == "device sim uses by-hand\n"
    (one,) = json.loads(run("list", "--url", server, "--json").stdout)
    assert (one["id"], one["active"], one["origin"]) == ("by-hand", True, "document")
    # The simulated bar shows lights: that is no dark capture, and the reason is told.
    told = run("capture", "sim", "--frames", 16, "--url", server, answers="\nq\n")
    assert told.exit_code == 1
    assert "Cover all sensors" in told.output
    assert "light in the dark" in told.output
    assert run("deactivate", "by-hand", "--url", server).exit_code == 0
