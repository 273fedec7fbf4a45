"""The README's five-minute tour, run as it is written."""

import json
import os
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from tests.running_server import serving

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
ADDRESS = "localhost:8000"


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


@pytest.mark.slow
def test_the_table_of_errors_is_what_the_command_prints() -> None:
    from validation.published_errors import DLT, PUBLISHED
    from validation.tests_5_1_to_5_8 import CASES, LEAVE_ONE_OUT, METRIC

    result = CASES["test-5.4"].run()
    rows = {
        "thesis, DLT": PUBLISHED["test-5.4"][DLT],
        "Lumiline, fitted points": result.column(METRIC).errors,
        "Lumiline, points left out of the calibration": result.column(LEAVE_ONE_OUT).errors,
    }
    for label, errors in rows.items():
        assert errors is not None
        x, y, z = errors.mean_absolute_mm
        assert f"| {label} | {x:.2f} | {y:.2f} | {z:.2f} |" in README


def test_linked_files_exist() -> None:
    links = re.findall(r"\]\(([^)#]+)\)", README)
    assert links
    for link in links:
        assert (ROOT / link).exists(), link


@pytest.mark.slow
def test_the_calibration_as_it_is_written(tmp_path: Path) -> None:
    command = next(line for line in README.splitlines() if "frame-at-1-m.csv" in line)
    words = [
        str(ROOT / word) if word.startswith("docs/") else word for word in shlex.split(command)
    ]
    assert words[0] == "lumiline"
    run = subprocess.run(
        [sys.executable, "-m", "service.cli", *words[1:]],
        cwd=tmp_path, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    assert "the reading of point 17 is an outlier" in " ".join(run.stdout.split())
    assert {path.name for path in tmp_path.iterdir()} == {"report.html", "camera.json"}


# These are last: the server that they share measures, and takes a processor, until the end.
@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with serving(tmp_path_factory.mktemp("readme")) as url:
        yield url.removeprefix("http://")


@pytest.mark.slow
def test_curl_tour(address: str) -> None:
    tour, _ = blocks("bash")
    device, calibration, activated, reconstruction = answers_to(tour, address)
    assert device["id"] == "frame-rig"
    assert calibration["id"] == "frame-at-1-m"
    assert activated["state"] == "active"
    # What the README says of the two LEDs, within the largest fitted error of the frame.
    said = re.findall(r"\((-?\d+), (-?\d+), (-?\d+)\)", tour)
    for point, estimate in zip(said, reconstruction["estimates"], strict=True):
        for given, found in zip(point, estimate["position_mm"], strict=True):
            assert float(given) == pytest.approx(found, abs=15.0)


def answers_to(tour: str, address: str) -> list[Any]:
    answers = []
    for command in (line for line in tour.splitlines() if line.startswith("curl")):
        assert ADDRESS in command
        words = shlex.split(command.replace(ADDRESS, address))
        run = subprocess.run([*words, "--fail-with-body"], cwd=ROOT, capture_output=True, text=True)
        assert run.returncode == 0, (command, run.stdout, run.stderr)
        answers.append(json.loads(run.stdout))
    return answers


def test_websocket_client(address: str) -> None:
    (program,) = blocks("python")
    assert len(program.strip().splitlines()) <= 11
    run = subprocess.run(
        [sys.executable, "-c", program.replace(ADDRESS, address)],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    lines = run.stdout.splitlines()
    assert len(lines) > 900
    sequence, marker, position = lines[-1].split(maxsplit=2)
    assert int(sequence) > 900
    assert marker in "01"
    assert len(json.loads(position)) == 3


def test_a_tool_in_a_minute(address: str) -> None:
    _, tour = blocks("bash")
    _, _, tool, pose = answers_to(tour, address)
    assert tool["id"] == pose["tool_id"] == "pointer"
    end = time.monotonic() + 240.0
    while pose["status"] != "OK":
        assert time.monotonic() < end, pose
        time.sleep(0.1)
        pose = httpx.get(f"http://{address}/api/v1/tools/pointer/pose").json()
    # Somewhere in the middle of the volume: the scene's tool swings there.
    assert np.linalg.norm(np.subtract(pose["tip_mm"], [0.0, 0.0, 1500.0])) < 400.0
