"""The page on a first device: its example is built, connected, calibrated and measured with."""

import json
import os
import re
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.hardware.serial.firmware_library import c_compiler
from tests.running_server import serving

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "how-to" / "your-first-device.md").read_text(encoding="utf-8")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(c_compiler() is None, reason="no C compiler (cc, gcc)"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder in which all commands of the page were run, in their order."""
    folder = tmp_path_factory.mktemp("first")
    (folder / "hardware").symlink_to(ROOT / "hardware")
    command = folder / "bin" / "lumiline"
    command.parent.mkdir()
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m service.cli "$@"\n')
    command.chmod(0o755)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with serving(tmp_path_factory.mktemp("server")) as url:
        environment = {
            **os.environ, "PATH": f"{command.parent}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT),
            "LUMILINE_URL": url, "COLUMNS": "200",
        }  # fmt: skip
        device: subprocess.Popen[bytes] | None = None
        try:
            for language, block in re.findall(r"```(bash|python)\n(.*?)```", PAGE, re.DOTALL):
                program = block.replace("localhost:8000", url.removeprefix("http://"))
                program = program.replace("127.0.0.1:5000", f"127.0.0.1:{port}")
                if language == "bash":
                    start = ["bash", "-euo", "pipefail", "-c", program]
                else:
                    start = [sys.executable, "-c", program]
                run = subprocess.run(
                    start, cwd=folder, env=environment, capture_output=True, text=True
                )
                assert run.returncode == 0, f"{block}\n{run.stdout}\n{run.stderr}"
                with (folder / "printed").open("a") as printed:
                    printed.write(run.stdout)
                if device is None:
                    device = subprocess.Popen([folder / "example_device", str(port)])
            yield folder
        finally:
            if device is not None:
                device.kill()
                device.wait()


def test_the_link_works_and_each_sensor_has_a_peak(folder: Path) -> None:
    printed = (folder / "printed").read_text()
    assert "running connected" in printed
    assert len(re.findall(r"marker [01]: \w+ \d+\.\d\d px, sd 0\.0\d\d", printed)) == 4


def test_the_calibration_finds_the_cameras_of_the_example(folder: Path) -> None:
    models = json.loads((folder / "first.json").read_text())["sensors"]
    assert len(models) == 4
    for model in models:
        camera = model.get("model", model)
        assert camera["principal_distance_px"] == pytest.approx(37.0 / 0.008, rel=1e-3)


def test_the_ends_of_the_wand_keep_their_distance(folder: Path) -> None:
    times: dict[int, list[float]] = {0: [], 1: []}
    places: dict[int, list[list[float]]] = {0: [], 1: []}
    for line in (folder / "wand.jsonl").read_text().splitlines():
        message = json.loads(line)
        for point in message.get("points", ()):
            if point["position_mm"] is not None:
                times[point["marker"]].append(message["device_ns"] * 1e-9)
                places[point["marker"]].append(point["position_mm"])
    assert min(map(len, times.values())) > 100
    # The ends are lit in turn: one end's places at the other's times, by a cubic of neighbours.
    first = np.array(places[0])
    inside = [at for at, t in enumerate(times[1]) if times[0][1] < t < times[0][-2]]
    lengths = []
    for at in inside:
        nearest = np.argsort(np.abs(np.array(times[0]) - times[1][at]))[:4]
        fit = np.polyfit(np.array(times[0])[nearest] - times[1][at], first[nearest], 3)
        lengths.append(np.linalg.norm(fit[-1] - places[1][at]))
    assert np.sqrt(np.mean((np.array(lengths) - 300.0) ** 2)) < 0.2
