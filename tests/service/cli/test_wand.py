"""`lumiline wand`: from a CSV of a waved bar to cameras that measure its length."""

import csv
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from typer.testing import CliRunner

from compute.calibration.calibrate import calibrate
from compute.calibration.self_calibration.targets import Wand
from compute.calibration.self_calibration.uncalibrated_start import pixel_directions
from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.reconstruction.triangulation import reconstruct
from lumiline.client.messages import Frame, Hello, Peak
from service.cli import app
from service.cli.json_files import DOCUMENT, read_calibration
from service.cli.wand_live import wave_live
from service.cli.wand_sources import LiveWand
from tests.compute.rig import control_points, geometry, project, rig

LENGTH_MM, SIGMA_PX, POSES = 300.0, 0.05, 120


def _bar_ends() -> np.ndarray:
    rng = np.random.default_rng(8)
    middle = np.array([0.0, 0.0, 1500.0]) + rng.uniform(-150.0, 150.0, (POSES, 3))
    along = rng.normal(size=(POSES, 3))
    along *= LENGTH_MM / 2.0 / np.linalg.norm(along, axis=1, keepdims=True)
    return np.stack([middle - along, middle + along], axis=1)


@pytest.fixture(scope="module")
def waved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Readings of a waved bar, and cameras 5 % off in their principal distance."""
    folder: Path = tmp_path_factory.mktemp("wand")
    rng = np.random.default_rng(9)
    names = [model.name for model in rig()]
    with (folder / "wand.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["pose", "marker", *(f"{name}_px" for name in names)])
        for pose, ends in enumerate(_bar_ends(), start=1):
            readings = project(rig(), ends) + rng.normal(0.0, SIGMA_PX, (2, 4))
            for marker, row in enumerate(readings.tolist(), start=1):
                writer.writerow([f"take {pose}", marker, *row])
    points = control_points(30)
    away = (points - [0.0, 0.0, 1500.0]) * [1.05, 1.05, 1.0] + [0.0, 0.0, 1500.0]
    near = calibrate(away, project(rig(), points), geometry(rig()))
    (folder / "near.json").write_bytes(DOCUMENT.dump_json(near))
    return folder / "wand.csv", folder / "near.json"


def run(*arguments: object, code: int = 0) -> str:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == code, (result.stdout, result.stderr)
    return " ".join((result.stderr if code else result.stdout).split())


@pytest.mark.slow
def test_a_waved_bar_gives_cameras_that_measure_its_length(
    waved: tuple[Path, Path], tmp_path: Path
) -> None:
    output = tmp_path / "wand.json"
    readings, near = waved
    shown = run("wand", readings, "--calibration", near, "--positions", "0 300", "--output", output)
    assert f"{POSES} of {POSES} poses" in shown
    models = read_calibration(output).calibration.models
    ends = _bar_ends()
    found = reconstruct(models, CameraStack.of(rig()).project(ends.reshape(-1, 3)), np.full(4, 1.0))
    lengths = np.linalg.norm(np.diff(found.position_mm.reshape(-1, 2, 3), axis=1)[:, 0], axis=1)
    assert abs(lengths.mean() - LENGTH_MM) < 0.1
    before = reconstruct(
        read_calibration(near).calibration.models, project(rig(), ends.reshape(-1, 3)), np.ones(4)
    )
    worse = np.linalg.norm(np.diff(before.position_mm.reshape(-1, 2, 3), axis=1)[:, 0], axis=1)
    assert abs(worse.mean() - LENGTH_MM) > 3.0


def test_a_wand_is_refused_with_a_reason(waved: tuple[Path, Path], tmp_path: Path) -> None:
    readings, near = waved
    start = ("--calibration", near, "--positions")
    assert "1 marker" in run("wand", readings, *start, "300", code=2)
    assert 'for example "0 300"' in run("wand", readings, *start, "0 to 300", code=2)
    rows = readings.read_text(encoding="utf-8").splitlines()
    for name, lines, reason in (
        ("twice.csv", [*rows, rows[1]], "given again; it stands in line 2"),
        ("third.csv", [*rows, rows[1].replace(",1,", ",3,", 1)], "from 1 to 2"),
        ("column.csv", [rows[0].replace("pose", "take"), *rows[1:]], "no column pose"),
        ("sensor.csv", [rows[0].replace("s1_px", "x_px"), *rows[1:]], "is of s1"),
    ):
        path = tmp_path / name
        path.write_text("\n".join(lines), encoding="utf-8")
        assert reason in run("wand", path, *start, "0 300", code=2), name


@pytest.mark.slow
def test_a_waved_bar_needs_no_initial_cameras(waved: tuple[Path, Path], tmp_path: Path) -> None:
    output = tmp_path / "wand.json"
    degrees = np.rad2deg(np.arctan2(*pixel_directions(rig()).T[::-1]))
    directions = " ".join(f"{angle:.0f}" for angle in degrees)
    options = ("--positions", "0 300", "--pixels", 2048, "--directions", directions)
    shown = run("wand", waved[0], *options, "--output", output)
    assert f"{POSES} of {POSES} poses" in shown
    assert "WARNING" not in shown
    models = read_calibration(output).calibration.models
    ends = _bar_ends()
    found = reconstruct(models, CameraStack.of(rig()).project(ends.reshape(-1, 3)), np.full(4, 1.0))
    lengths = np.linalg.norm(np.diff(found.position_mm.reshape(-1, 2, 3), axis=1)[:, 0], axis=1)
    assert abs(lengths.mean() - LENGTH_MM) < 0.1


def test_a_wand_of_the_wrong_length_is_warned_of(waved: tuple[Path, Path]) -> None:
    readings, near = waved
    assert "WARNING: The known lengths make the device" in run(
        "wand", readings, "--calibration", near, "--positions", "0 330"
    )


def test_a_wand_without_initial_cameras_wants_a_description(waved: tuple[Path, Path]) -> None:
    options = ("wand", waved[0], "--positions", "0 300")
    assert "give --sensors with a device's JSON file" in run(*options, code=2)
    for directions in ("90 0 45", "up right left down"):
        shown = run(*options, "--pixels", 2048, "--directions", directions, code=2)
        assert "an angle in degrees for each of s1, s2, s3, s4" in shown
    shown = run(*options, "--pixels", 2048, "--distortion", "auto", code=2)
    assert "needs control points" in shown
    some = "s1=2048,s2=2048,s3=2048"
    assert "add s4 to --sensors" in run(*options, "--sensors", some, code=2)
    shown = run(*options, "--sensors", f"{some},s4=1024", "--directions", "90 0 45", code=2)
    assert "an angle in degrees for each of s1, s2, s3, s4" in shown
    shown = run(*options, "--calibration", waved[1], "--pixels", 2048, code=2)
    assert "--pixels has no effect with --calibration" in shown


def _strobed_frames(poses: int) -> list[Frame]:
    """Frames of a bar whose ends are lit in turn and rest meanwhile, as the stream sends them.

    It is out of view for longer than a strobe cycle from one place to the next.
    """
    ends = project(rig(), _bar_ends()[:poses].reshape(-1, 3)).reshape(poses, 2, 4)
    frames = []
    for number in range(8 * poses):
        marker = number % 2
        peaks = []
        for model, value in zip(rig(), ends[number // 8, marker], strict=True):
            stray = Peak(model.name, 5.0, 0.05, 10.0, 4.0, 1.0, ())
            peaks += [stray, Peak(model.name, float(value), 0.05, 900.0, 4.0, 1.0, ())]
        ns = 1_000_000 * number + 20_000_000 * (number // 8)
        frames.append(
            Frame(number, "bar", number, ns, ns, marker, None, None, (), None, tuple(peaks))
        )
    return frames


class _Client:
    """Client of a device that strobes the ends of a bar."""

    def __init__(self, poses: int, markers: int = 2) -> None:
        self._messages = [
            Hello(1, "bar", ("peaks",), "live", "s", 0, False, tuple(one.name for one in rig()),
                  1000.0, markers, *_defaults(Hello)),
            *_strobed_frames(poses),
        ]  # fmt: skip

    def device(self, _device: str) -> SimpleNamespace:
        return SimpleNamespace(sensors=geometry(rig()))

    @contextmanager
    def stream(self, *_arguments: object, **_options: object) -> Iterator[Iterator[object]]:
        yield iter(self._messages)


def _defaults(kind: type) -> list[Any]:
    names = [one.name for one in fields(kind)]
    return [None] * (len(names) - names.index("markers") - 1)


def test_live_wand_collects_poses_of_strobed_ends() -> None:
    source = LiveWand(cast("Any", _Client(30)), "bar", (0, 1))
    tables = list(source.collect(60.0, 0.0))
    table = source.table()
    assert len(tables[0].readings_px) <= len(table.readings_px)
    exact = project(rig(), _bar_ends()[:30].reshape(-1, 3)).reshape(30, 2, 4)
    # Each place makes one pose, but for those that hardly differ from the one before.
    assert 28 <= len(table.readings_px) <= 30
    error = np.abs(table.readings_px[:, None] - exact[None]).max(axis=(2, 3)).min(axis=1)
    assert (error < 1e-6).all()
    with pytest.raises(InvalidParameter, match="strobes markers 0 to 1; it has no marker 2"):
        list(LiveWand(cast("Any", _Client(2)), "bar", (0, 2)).collect(60.0, 0.0))
    with pytest.raises(InvalidParameter, match="lights all markers together"):
        list(LiveWand(cast("Any", _Client(2, 0)), "bar", (0, 1)).collect(60.0, 0.0))


@pytest.mark.slow
def test_live_wave_ends_when_it_is_enough(capsys: pytest.CaptureFixture[str]) -> None:
    source = LiveWand(cast("Any", _Client(120)), "bar", (0, 1))
    table = wave_live(source, Wand((0.0, LENGTH_MM)), rig(), 60.0, every_s=0.0)
    shown = " ".join(capsys.readouterr().out.split())
    assert len(table.readings_px) > 30
    assert "pixels, first to last" in shown


def test_sources_of_readings_exclude_each_other(waved: tuple[Path, Path], tmp_path: Path) -> None:
    options = ("wand", "--positions", "0 300")
    assert "give the wand's readings once" in run(*options, code=2)
    recording = ("--recording", tmp_path / "none.h5")
    assert "give the wand's readings once" in run(*options, waved[0], *recording, code=2)
    assert "the wand has 2" in run(*options, *recording, "--strobe-markers", "0 1 2", code=2)


@pytest.mark.slow
def test_a_recorded_wave_that_is_flat_is_refused_by_name(tmp_path: Path) -> None:
    """The simulated bar turns in a plane; what it covered is shown."""
    path = tmp_path / "bar.h5"
    run("record", path, "--seconds", 2)
    arguments = ("wand", "--recording", path, "--positions", "0 100")
    assert "all in one plane" in run(*arguments, code=2)
    assert "strobes markers 0 to" in run(*arguments, "--strobe-markers", "0 99", code=2)
