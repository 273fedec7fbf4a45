"""The files, read back: by others' libraries where there are any."""

import csv
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from compute.errors import InvalidParameter
from compute.pose.rigid_body import PoseStatus
from compute.tracking.track_batch import TrackState
from hardware.errors import MissingLibrary
from service.api.exports.c3d_file import MAX_FRAMES, RESIDUAL_STEP_MM, TIME_CHANNEL
from service.api.exports.formats import SUFFIXES, suffix_of, write_export
from service.api.exports.motion_table import MotionTable
from service.api.exports.tabular_files import COLUMNS, NUMBERS, TEXTS, tidy_columns
from service.api.exports.trajectories import trajectories
from tests.service.api.exports.motion_tables import table
from tests.service.api.exports.readers import matrix, read_sequence, read_trc


def written(tmp_path: Path, suffix: str, given: MotionTable, **options: bool) -> Path:
    path = tmp_path / f"out{suffix}"
    write_export(given, path, **options)
    return path


@pytest.mark.parametrize("predicted", [False, True])
def test_c3d(tmp_path: Path, predicted: bool) -> None:
    ezc3d = pytest.importorskip("ezc3d")
    given = table()
    path = written(tmp_path, ".c3d", given, predicted=predicted)
    found = ezc3d.c3d(str(path))
    expected = trajectories(given, predicted=predicted)
    point = found["parameters"]["POINT"]
    assert list(point["LABELS"]["value"]) == [one.label for one in expected]
    assert list(point["UNITS"]["value"]) == ["mm"]
    assert point["RATE"]["value"] == [100.0]
    place = given.sequence - given.sequence[0]
    frames = place[-1] + 1
    positions = np.full((frames, len(expected), 3), np.nan, np.float32)
    for index, one in enumerate(expected):
        positions[place, index] = one.position_mm
    data = found["data"]["points"][:3].transpose(2, 1, 0)
    # The same single-precision numbers, and gaps at the same places.
    assert data.shape == positions.shape
    assert np.array_equal(data.astype(np.float32), positions, equal_nan=True)
    residuals = found["data"]["meta_points"]["residuals"][0].T
    gaps = np.isnan(positions).any(axis=2)
    assert (residuals[gaps] == -1.0).all()
    standard_deviations = np.full((frames, len(expected)), np.nan)
    for index, one in enumerate(expected):
        standard_deviations[place, index] = one.sd_mm
    kept = np.minimum(standard_deviations[~gaps], 255 * RESIDUAL_STEP_MM)
    assert np.abs(residuals[~gaps] - kept).max() <= 0.51 * RESIDUAL_STEP_MM
    _check_times(found, given, place)
    _check_rotations(found, given, place)
    own = found["parameters"]["LUMILINE"]
    assert own["START_HOST_NS"]["value"] == [str(given.host_ns[0])]
    assert own["CALIBRATION"]["value"] == ["cal-1"]


def _check_times(found: Any, given: MotionTable, place: Any) -> None:
    labels = found["parameters"]["ANALOG"]["LABELS"]["value"]
    assert labels == [TIME_CHANNEL]
    late_us = found["data"]["analogs"][0, 0]
    times = place / 100.0 + late_us[place] * 1e-6
    # A thousandth of a microsecond, at 100 us: what single precision leaves.
    assert np.abs(times - given.time_s).max() < 1e-10


def _check_rotations(found: Any, given: MotionTable, place: Any) -> None:
    assert list(found["parameters"]["ROTATION"]["LABELS"]["value"]) == list(given.tools)
    turns = found["data"]["rotations"]
    poses = given.poses
    for row, status in enumerate(poses.status):
        turn = turns[:, :, poses.tool[row], place[poses.frame[row]]]
        if status == PoseStatus.OK:
            assert np.array_equal(turn[:3, :3], poses.rotation[row].astype(np.float32))
            assert np.array_equal(turn[:3, 3], poses.translation_mm[row].astype(np.float32))
        else:
            assert np.isnan(turn).all()


def test_c3d_holds_so_many_frames(tmp_path: Path) -> None:
    """Writers cut the rest off without a word."""
    ezc3d = pytest.importorskip("ezc3d")
    given = table(frames=2, tools=())
    given.tracks.state[:] = TrackState.CONFIRMED
    frames = np.arange(MAX_FRAMES)
    long = replace(given, sequence=frames, device_ns=frames, host_ns=frames, marker=frames * 0)
    path = written(tmp_path, ".c3d", long)
    assert ezc3d.c3d(str(path))["data"]["points"].shape[2] == MAX_FRAMES
    frames = np.arange(MAX_FRAMES + 1)
    longer = replace(given, sequence=frames, device_ns=frames, host_ns=frames, marker=frames * 0)
    with pytest.raises(InvalidParameter, match="65536 exposures"):
        write_export(longer, tmp_path / "longer.c3d")


def test_c3d_is_not_made_of_gaps(tmp_path: Path) -> None:
    given = table()
    given.sequence[-1] += 10_000
    with pytest.raises(InvalidParameter, match="one rate"):
        written(tmp_path, ".c3d", given)


@pytest.mark.parametrize("predicted", [False, True])
def test_trc(tmp_path: Path, predicted: bool) -> None:
    given = table()
    path = written(tmp_path, ".trc", given, predicted=predicted)
    facts, labels, numbers, times, positions = read_trc(path)
    expected = trajectories(given, predicted=predicted)
    assert labels == [one.label for one in expected]
    assert (facts["Units"], float(facts["DataRate"])) == ("mm", 100.0)
    assert np.array_equal(numbers, given.sequence - given.sequence[0] + 1)
    assert np.abs(times - given.time_s).max() < 1e-9
    whole = np.stack([one.position_mm for one in expected], axis=1)
    assert np.allclose(positions, whole, rtol=0.0, atol=0.51e-6, equal_nan=True)


def cell(text: str, name: str) -> Any:
    if name in TEXTS:
        return text
    if name in NUMBERS:
        return float(text) if text else np.nan
    return int(text)


def test_csv(tmp_path: Path) -> None:
    given = table()
    path = written(tmp_path, ".csv", given)
    with path.open(newline="", encoding="utf-8") as file:
        head, *rows = csv.reader(file)
    assert tuple(head) == COLUMNS
    assert not any("nan" in text for row in rows for text in row)
    expected = tidy_columns(given)
    for index, name in enumerate(COLUMNS):
        found = np.array([cell(row[index], name) for row in rows])
        # Bit by bit, and in the order of the frames.
        assert np.array_equal(found, expected[name], equal_nan=name in NUMBERS), name
    assert (np.diff(expected["frame"]) >= 0).all()


@pytest.mark.slow
def test_parquet(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    given = table()
    found = parquet.read_table(written(tmp_path, ".parquet", given))
    assert tuple(found.column_names) == COLUMNS
    for name, column in tidy_columns(given).items():
        values = found[name].to_pylist()
        if name in NUMBERS:
            assert [value is None for value in values] == np.isnan(column).tolist()
            values = [np.nan if value is None else value for value in values]
            assert np.array_equal(values, column, equal_nan=True)
        else:
            assert values == column.tolist()
    facts = json.loads(found.schema.metadata[b"lumiline"])
    assert (facts["device"], facts["rate_hz"], facts["calibration"]) == ("bar", 100.0, "cal-1")


def test_rows_are_what_was_found() -> None:
    """The tables' rows against the motion table's."""
    given = table()
    columns = tidy_columns(given)
    for kind, rows, position in (
        ("point", given.points, given.points.position_mm),
        ("track", given.tracks, given.tracks.position_mm),
        ("tool", given.poses, given.poses.translation_mm),
    ):
        own = columns["kind"] == kind
        assert np.array_equal(columns["frame"][own], rows.frame)
        place = np.stack([columns[f"{axis}_mm"][own] for axis in "xyz"], axis=1)
        assert np.array_equal(place, position, equal_nan=True)
        assert np.array_equal(columns["host_ns"][own], given.host_ns[rows.frame])
    tools = columns["kind"] == "tool"
    assert columns["status"][tools].tolist() == given.poses.status.tolist()
    assert set(columns["label"][tools]) == {"probe", "ref"}
    flags = columns["flags"][columns["kind"] == "track"]
    assert any("merged ambiguous" in text for text in flags)


def test_sequence(tmp_path: Path) -> None:
    given = table()
    fields, frames = read_sequence(written(tmp_path, ".igs.mha", given))
    assert int(fields["LumilineStartHostNs"]) == given.host_ns[0]
    assert [int(frame["FrameNumber"]) for frame in frames] == given.sequence.tolist()
    times = np.array([float(frame["Timestamp"]) for frame in frames])
    assert np.abs(times - given.time_s).max() < 1e-9
    words = {"HIGH_ERROR": "INVALID", "LOW_RELIABILITY": "INVALID", "UNKNOWN": "MISSING"}
    for row, status in enumerate(given.poses.status.tolist()):
        frame = frames[given.poses.frame[row]]
        name = ("ProbeToTracker", "RefToTracker")[given.poses.tool[row]]
        assert frame[f"{name}TransformStatus"] == words.get(status, status)
        found = matrix(frame[f"{name}Transform"])
        expected = np.eye(4)
        if np.isfinite(given.poses.translation_mm[row]).all():
            expected[:3, :3] = given.poses.rotation[row]
            expected[:3, 3] = given.poses.translation_mm[row]
        assert np.array_equal(found, expected)


@pytest.mark.parametrize("given", [table(tools=()), table(frames=2)])
def test_a_sequence_is_of_tools(tmp_path: Path, given: MotionTable) -> None:
    if given.tools:
        written(tmp_path, ".igs.mha", given)
    else:
        with pytest.raises(InvalidParameter, match="--tools"):
            written(tmp_path, ".igs.mha", given)


@pytest.mark.parametrize(
    "name", ["out.xyz", "out", "c3d", ".c3d", "out.mha", "out.csv.gz", "out.h5"]
)
def test_a_suffix_that_is_none(name: str) -> None:
    with pytest.raises(InvalidParameter) as caught:
        suffix_of(Path(name))
    assert all(suffix in caught.value.detail for suffix in SUFFIXES)


def test_suffixes() -> None:
    for suffix in SUFFIXES:
        assert suffix_of(Path(f"a/b.c{suffix.upper()}")) == suffix


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_nothing_is_overwritten(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"out{suffix}"
    path.write_text("mine")
    with pytest.raises(InvalidParameter, match="exists"):
        write_export(table(), path)
    assert path.read_text() == "mine"


@pytest.mark.parametrize(("suffix", "library"), [(".c3d", "ezc3d"), (".parquet", "pyarrow")])
def test_a_library_that_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str, library: str
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(MissingLibrary, match=r"pip install 'lumiline\[export\]'") as caught:
        written(tmp_path, suffix, table())
    assert library in caught.value.detail
    assert not list(tmp_path.iterdir())
