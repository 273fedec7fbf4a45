"""Recordings with results and calibrations, read while written."""

import tempfile
from itertools import pairwise
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.errors import InvalidRecording
from hardware.recording.frame_block import FrameBlock
from hardware.recording.layout import Losses
from hardware.recording.reader import RecordingReader
from hardware.recording.writer import RecordingWriter
from tests.hardware.recording.blocks import (
    PIXELS,
    SENSORS,
    assert_same_block,
    block,
    described,
    joined,
    read_recording,
)


def write(path: Path, sizes: list[int], *, lines: bool = True) -> FrameBlock:
    """Write blocks of these sizes; returns all of them as one."""
    starts = np.cumsum([0, *sizes])[:-1].tolist()
    blocks = [block(start, size) for start, size in zip(starts, sizes, strict=True)]
    with RecordingWriter(path, described(), lines=lines, results=True) as writer:
        for one in blocks:
            assert writer.append_block(one) == 0
    return joined(blocks)


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(
    sizes=st.lists(st.integers(1, 64), min_size=1, max_size=6),
    cuts=st.lists(st.integers(0, 300), max_size=4),
    lines=st.booleans(),
)
def test_results_are_read_as_written_from_any_row(
    sizes: list[int], cuts: list[int], lines: bool
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "r.h5"
        whole = write(path, sizes, lines=lines)
        frames = sum(sizes)
        bounds = [0, *sorted(min(cut, frames) for cut in cuts), frames]
        with RecordingReader(path) as reader:
            assert (reader.info.lines, reader.info.results) == (lines, True)
            parts = [reader.block(*pair) for pair in pairwise(bounds)]
    if not lines:
        assert all(part.lines is None for part in parts)
        empty = np.empty((0, SENSORS, PIXELS), np.uint16)
        parts = [FrameBlock(one.rows, empty, one.peaks, one.points) for one in parts]
        whole = FrameBlock(whole.rows, empty, whole.peaks, whole.points)
    assert_same_block(joined(parts), whole)


def test_frames_that_do_not_follow_are_left_out_with_their_results(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "r.h5", described(), results=True) as writer:
        first, second = block(10, 20), block(20, 30)
        assert writer.append_block(first) == 0
        assert writer.append_block(second) == 10
        back = block(60, 5)
        back.rows["exposure_device_ns"][2] = 0
        assert writer.append_block(back) == 1
        writer.flush(Losses(3, 4, 11))
    kept = np.array([True, True, False, True, True])
    expected = joined([first, second.select(np.arange(30) >= 10), back.select(kept)])
    with RecordingReader(tmp_path / "r.h5") as reader:
        assert_same_block(reader.block(0, 100), expected)
        assert reader.info.lost == reader.info.state.missing == 11


def test_active_calibrations_are_read_as_written(tmp_path: Path) -> None:
    table = bytes(range(256)) * 700
    with RecordingWriter(tmp_path / "r.h5", described(), provenance={"by": "me"}) as writer:
        assert writer.put_active_calibration(b'{"id": "a"}', table) == 0
        writer.append_block(block(0, 3, calibration_row=0))
        assert writer.put_active_calibration(b'{"id": "b"}') == 1
        writer.append_block(block(3, 3, calibration_row=1))
    with RecordingReader(tmp_path / "r.h5") as reader:
        assert reader.column("active_calibration").tolist() == [0, 0, 0, 1, 1, 1]
        assert reader.active_calibration(0) == (b'{"id": "a"}', table)
        assert reader.active_calibration(1) == (b'{"id": "b"}', b"")
        with pytest.raises(InvalidRecording, match="has no row 2 of active_calibrations; it has 2"):
            reader.active_calibration(2)
        assert reader.info.provenance == {"by": "me"}


@pytest.mark.parametrize("at", ["document", "table", "rows"])
def test_active_calibration_with_a_flipped_bit_is_refused(tmp_path: Path, at: str) -> None:
    document, table = b'{"id": "sim-nominal", "bad_pixels": [7]}', bytes(range(256))
    with RecordingWriter(tmp_path / "r.h5", described()) as writer:
        for _ in range(2):
            writer.put_active_calibration(document, table)
        writer.append_block(block(0, 3, calibration_row=1))
    with h5py.File(tmp_path / "r.h5", "r+") as file:
        group = file["active_calibrations"]
        extent = group["rows"][1]
        if at == "rows":  # the other one's extent: as whole, and of another calibration
            group["rows"][1] = group["rows"][0]
        else:
            group["bytes"][int(extent[f"{at}_start"]) + 10] ^= 1
    with RecordingReader(tmp_path / "r.h5") as reader:
        assert reader.active_calibration(0) == (document, table)
        with pytest.raises(InvalidRecording, match="damaged data in active_calibrations"):
            reader.active_calibration(1)


def test_a_reader_follows_the_writer_flush_by_flush(tmp_path: Path) -> None:
    path = tmp_path / "live.h5"
    blocks = [block(0, 50), block(50, 7), block(57, 60)]
    with RecordingWriter(path, described(), results=True) as writer:
        with RecordingReader(path) as reader:
            assert (reader.info.frames, reader.info.complete) == (0, False)
            for number, one in enumerate(blocks):
                before = reader.info.frames
                writer.append_block(one)
                assert reader.refresh().frames == before
                assert writer.flush().frames == before + len(one.rows)
                assert reader.refresh().frames == before + len(one.rows)
                assert_same_block(reader.block(0, 1000), joined(blocks[: number + 1]))
        writer.close(reason="enough")
    info = read_recording(path)
    assert (info.frames, info.complete, info.state.reason) == (117, True, "enough")


@pytest.mark.parametrize("number", [0, 1])
def test_one_damaged_state_leaves_the_other(tmp_path: Path, number: int) -> None:
    write(tmp_path / "r.h5", [40])
    with h5py.File(tmp_path / "r.h5", "r+") as file:
        rows = file["state"][:]
        rows["frames"][number] += 1
        file["state"][:] = rows
    # Row 1 was written last but one: the last says that the file is complete.
    last = int(np.argmax(rows["number"]))
    info = read_recording(tmp_path / "r.h5")
    assert (info.frames, info.complete) == (40, number != last)
    rows["frames"] += 1
    with h5py.File(tmp_path / "r.h5", "r+") as file:
        file["state"][:] = rows
    with pytest.raises(InvalidRecording, match="has no whole state"):
        read_recording(tmp_path / "r.h5")


@pytest.mark.parametrize(
    ("dataset", "what"),
    [("peaks", "results"), ("points", "results"), ("frames/exposure_host_ns", "lines")],
)
def test_a_changed_value_is_found(tmp_path: Path, dataset: str, what: str) -> None:
    write(tmp_path / "r.h5", [40])
    with h5py.File(tmp_path / "r.h5", "r+") as file:
        values = file[dataset][:]
        values[5:6].view(np.uint8)[0] ^= 1
        file[dataset][:] = values
    with (
        RecordingReader(tmp_path / "r.h5") as reader,
        pytest.raises(InvalidRecording, match=f"damaged data in frames/{what} .the checksum of"),
    ):
        reader.block(0, 40)


def test_a_recording_of_results_has_nothing_to_replay(tmp_path: Path) -> None:
    write(tmp_path / "r.h5", [4], lines=False)
    with (
        RecordingReader(tmp_path / "r.h5") as reader,
        pytest.raises(InvalidRecording, match="holds results only"),
    ):
        next(reader.frames())


def test_an_existing_file_is_left_on_request(tmp_path: Path) -> None:
    write(tmp_path / "r.h5", [4])
    with pytest.raises(FileExistsError):
        RecordingWriter(tmp_path / "r.h5", described(), exclusive=True)
    assert read_recording(tmp_path / "r.h5").frames == 4
    assert [path.name for path in tmp_path.iterdir()] == ["r.h5"]
