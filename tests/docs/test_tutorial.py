"""The tutorial's commands and programs, run in order as they are written."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.running_server import serving

pytestmark = pytest.mark.slow


ROOT = Path(__file__).parents[2]
TUTORIAL = ROOT / "docs" / "tutorial"
LESSONS = ("calibrate-and-measure", "track-a-tool")
ADDRESS = "localhost:8000"


def blocks(lesson: str) -> list[tuple[str, str]]:
    text = (TUTORIAL / f"{lesson}.md").read_text(encoding="utf-8")
    return re.findall(r"```(bash|python)\n(.*?)```", text, flags=re.DOTALL)


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with serving(tmp_path_factory.mktemp("server")) as url:
        yield url.removeprefix("http://")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the repository's `docs`, and with `lumiline` in its `bin`."""
    folder = tmp_path_factory.mktemp("tutorial")
    (folder / "docs").symlink_to(ROOT / "docs")
    command = folder / "bin" / "lumiline"
    command.parent.mkdir()
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m service.cli "$@"\n')
    command.chmod(0o755)
    return folder


@pytest.fixture(scope="module")
def outputs(address: str, folder: Path) -> dict[str, list[str]]:
    """What each block printed, by lesson."""
    environment = {
        **os.environ,
        "PATH": f"{folder / 'bin'}:{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "COLUMNS": "120",
    }
    printed: dict[str, list[str]] = {}
    for lesson in LESSONS:
        for language, block in blocks(lesson):
            program = block.replace(ADDRESS, address)
            start = ["bash", "-euo", "pipefail", "-c"]
            if language == "python":
                start = [sys.executable, "-c"]
            run = subprocess.run(
                [*start, program],
                cwd=folder,
                env=environment,
                capture_output=True,
                text=True,
                timeout=240,
            )
            assert run.returncode == 0, (block, run.stdout, run.stderr)
            printed.setdefault(lesson, []).append(run.stdout)
    return printed


def test_tutorial_lesson_1_prints_what_it_says(outputs: dict[str, list[str]], folder: Path) -> None:
    text = (TUTORIAL / "calibrate-and-measure.md").read_text(encoding="utf-8")
    data, first, second, _, points = outputs["calibrate-and-measure"]
    shown, label = [
        shown
        for shown in re.findall(r"```text\n(.*?)```", text, flags=re.DOTALL)
        if "lumiline serve" not in shown
    ]
    assert data == shown
    assert " ".join(label.split()) in " ".join(first.split())
    (rms,) = re.findall(r"falls to ([0-9.]+) px", text)
    assert f"cam1 │ 18 │ {rms}" in " ".join(second.split())
    assert (folder / "camera.json").is_file()
    assert (folder / "report.html").is_file()
    # Within the largest fitted error of the frame.
    said = re.findall(r"\((-?\d+), (-?\d+), (-?\d+)\) mm", text)
    found = re.findall(r": (-?\d+), (-?\d+), (-?\d+) mm", points)
    for true, estimate in zip(said, found, strict=True):
        for expected, value in zip(true, estimate, strict=True):
            assert float(value) == pytest.approx(float(expected), abs=15.0)


def test_tutorial_lesson_2_streams_the_tip(outputs: dict[str, list[str]]) -> None:
    _, pose, stream = outputs["track-a-tool"]
    assert "tip [mm]: (" in pose
    lines = stream.splitlines()
    assert len(lines) == 20
    assert all(line.split()[1] == "pointer" for line in lines)
