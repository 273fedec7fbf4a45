"""Damaged recordings: bits flipped, bytes overwritten, files cut short, at random places."""

from pathlib import Path

import h5py
import pytest

from compute.errors import InvalidRecording
from hardware.recording.layout import FORMAT
from hardware.recording.reader import RecordingReader
from hardware.recording.writer import RecordingWriter
from tests.damage import FEW_OR_MANY, damages
from tests.hardware.recording.blocks import assert_same_block, block, described, joined

CALIBRATIONS = [(b'{"id": "sim-nominal-%d"}' % row, bytes(range(256)) * row) for row in range(3)]
STARTS = list(enumerate(range(0, 96, 32)))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("whole") / "r.h5"
    with RecordingWriter(path, described(), lines=True, results=True) as writer:
        for row, start in STARTS:
            writer.put_active_calibration(*CALIBRATIONS[row])
            writer.append_block(block(start, 32, row))
    return path.read_bytes()


def test_recording_has_nothing_of_variable_length(whole: bytes):
    """Where a bit of a length is flipped, HDF5 does not return from reading such a text."""
    assert b"GCOL" not in whole


def test_text_of_variable_length_is_not_read(whole: bytes, tmp_path: Path):
    path = tmp_path / "r.h5"
    path.write_bytes(whole)
    with h5py.File(path, "r+") as file:
        file.attrs["format"] = FORMAT
    data = path.read_bytes()
    at = data.index(b"GCOL") + 16 + 8
    path.write_bytes(data[:at] + (-16).to_bytes(8, "little", signed=True) + data[at + 8 :])
    with pytest.raises(InvalidRecording, match="is an HDF5 file of format None"):
        RecordingReader(path)


def test_damage_in_a_file_that_its_writer_left_open_is_refused_soon(tmp_path: Path):
    """HDF5 reads again there, as the writer may be about to write; not for ever."""
    path = tmp_path / "r.h5"
    with RecordingWriter(tmp_path / "open.h5", described()) as writer:
        writer.append_block(block(0, 40))
        writer.flush()
        left = (tmp_path / "open.h5").read_bytes()
    places = [20, left.index(b"OHDR") + 30]
    for at in places:
        path.write_bytes(left[:at] + bytes([left[at] ^ 1]) + left[at + 1 :])
        with pytest.raises(InvalidRecording, match="incorrect metadata checksum"):
            RecordingReader(path)


@pytest.mark.parametrize("bit", range(8))
def test_flag_of_a_file_that_is_being_written_flipped_is_refused(
    whole: bytes, tmp_path: Path, bit: int
):
    path = tmp_path / "r.h5"
    path.write_bytes(whole[:11] + bytes([whole[11] ^ 1 << bit]) + whole[12:])
    with pytest.raises(InvalidRecording, match=r"cut short \(.*checksum|cut short"):
        RecordingReader(path)


@FEW_OR_MANY
def test_recording_that_is_damaged_is_refused_or_holds_what_was_written(
    whole: bytes, tmp_path: Path, count: int
):
    path, refused = tmp_path / "r.h5", 0
    # Half of the places in the first part, where HDF5 has its headers and trees.
    for data in damages(whole, count, overwritten=64, part=range(4096)):
        path.write_bytes(data)
        try:
            with RecordingReader(path) as reader:
                found = reader.block(0, reader.info.frames)
                assert reader.info.description == described(), data
                count_of = range(reader.info.state.active_calibrations)
                used = [reader.active_calibration(row) for row in count_of]
        except InvalidRecording:
            refused += 1
            continue
        assert used == CALIBRATIONS, data
        assert_same_block(found, joined([block(start, 32, row) for row, start in STARTS]))
    assert count / 10 < refused < count
