"""`lumiline readings`: from a recording to the CSV that the calibrating commands read."""

import json
from pathlib import Path

import numpy as np
import pytest

from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from hardware.driver import SensorDescription
from hardware.simulated.calibration_target import calibration_target_points_mm
from hardware.simulated.simulated_rig import simulated_sensor_models
from service.api.captures.schema import Target
from service.api.recordings.recorded_readings import StrobeCycles, still_periods, target_readings
from service.cli.observations_csv import read_observations, read_wand
from service.cli.readings import SEEN_SHARE, _poses
from tests.service.cli.test_commands import here

POINTS = np.add(calibration_target_points_mm(), (0.0, 0.0, 1500.0))


@pytest.fixture(scope="module")
def frame(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The calibration frame of 19 strobed markers, 10 cycles."""
    folder: Path = tmp_path_factory.mktemp("readings")
    settings = folder / "settings.json"
    settings.write_text('{"scene": {"kind": "calibration-frame"}}', encoding="utf-8")
    here("record", folder / "frame.h5", "--seconds", "0.19", "--simulation", settings)
    return folder / "frame.h5"


def targets(path: Path, **changed: object) -> Path:
    listed = [
        {"name": f"P{number}", "position_mm": point, "marker": number}
        for number, point in enumerate(POINTS.tolist())
    ]
    listed[0] |= changed
    path.write_text(json.dumps({"targets": listed}), encoding="utf-8")
    return path


def test_readings_of_targets_are_those_of_the_cameras(frame: Path, tmp_path: Path) -> None:
    output = tmp_path / "frame.csv"
    here("readings", frame, "--targets", targets(tmp_path / "targets.json"), "--output", output)
    table = read_observations(output)
    assert np.array_equal(table.points_mm, POINTS)
    assert output.read_text(encoding="utf-8").splitlines()[1].startswith("P0,")
    expected = CameraStack.of(simulated_sensor_models()).project(POINTS)
    assert table.sigma_px is not None
    error = np.abs(table.readings_px - expected) / np.hypot(table.sigma_px, 0.01)
    assert np.isfinite(error).mean() > 0.9
    assert np.nanmax(error) < 6.0


@pytest.mark.slow
def test_readings_of_still_markers_are_one_pose_of_a_wand(frame: Path, tmp_path: Path) -> None:
    still, every = tmp_path / "still.csv", tmp_path / "every.csv"
    here("readings", frame, "--still", "--output", still)
    here("readings", frame, "--output", every)
    assert read_wand(still, 19).readings_px.shape == (1, 19, 4)
    poses = read_wand(every, 19).readings_px
    assert poses.shape == (10, 19, 4)
    mean = read_wand(still, 19).readings_px[0]
    both = np.isfinite(mean) & np.isfinite(poses).all(axis=0)
    assert both.any()
    assert np.allclose(poses.mean(axis=0)[both], mean[both], atol=1e-6)


def test_readings_refuse_with_the_way_out(frame: Path, tmp_path: Path) -> None:
    output = tmp_path / "out.csv"

    def refusal(*arguments: str | Path) -> str:
        return " ".join(
            here("readings", frame, *arguments, "--output", output, code=2).stderr.split()
        )

    wrong = targets(tmp_path / "wrong.json", marker=19)
    assert "markers 0 to 18" in refusal("--targets", wrong)
    wrong.write_text('[{"name": "P"}]', encoding="utf-8")
    assert "position_mm" in refusal("--targets", wrong)
    assert not output.exists()
    output.write_text("mine", encoding="utf-8")
    assert "exists" in refusal()
    assert output.read_text(encoding="utf-8") == "mine"


SENSORS = tuple(SensorDescription(name, 2048, 10.0) for name in "abc")


def moved_marker() -> StrobeCycles:
    """One marker at rest at three places, moved slowly between them."""
    rest, way = np.ones(20), np.arange(1.0, 20.0)
    track = np.concatenate([100 * rest, 100 + 10 * way, 300 * rest, 300 + 5 * way, 400 * rest])
    noise = np.random.default_rng(1).normal(0.0, 0.02, (len(track), 1, 3))
    values = track[:, None, None] + noise
    return StrobeCycles(SENSORS, values, np.full(values.shape, 0.02), strobed=False)


def test_control_points_are_the_still_periods_in_order() -> None:
    cycles = moved_marker()
    visited = [Target(name=f"P{x}", position_mm=(x, 0.0, 0.0)) for x in range(3)]
    found = target_readings(cycles, visited, 0.5, SEEN_SHARE)
    means = [mean.mean_px for mean in found]
    assert np.allclose(means, [[100] * 3, [300] * 3, [400] * 3], atol=0.02)
    assert [mean.total_frames for mean in found] == [20, 20, 20]
    assert [place for place, *_ in _poses(cycles, 0.5)] == [[1, 1], [2, 1], [3, 1]]
    with pytest.raises(InvalidParameter, match=r"3 still periods .* 2 targets"):
        target_readings(cycles, visited[:2], 0.5, SEEN_SHARE)


def test_still_periods_end_where_a_reading_moves() -> None:
    values = np.concatenate([np.zeros(12), np.full(9, 3.0), np.full(15, 6.0)])
    found = still_periods(np.stack([values, np.full(36, np.nan)], axis=1), 1.0)
    assert found == [slice(0, 12), slice(21, 36)]
