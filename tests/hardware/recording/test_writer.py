"""RecordingWriter: bit-identical round trip; invalid frames are refused."""

import json
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.errors import InvalidParameter, InvalidRecording
from hardware.driver import DeviceDescription, SensorDescription
from hardware.line_frame import FrameFlag, LineFrame
from hardware.recording.layout import CHUNK_FRAMES
from hardware.recording.reader import RecordingReader
from hardware.recording.writer import RecordingWriter
from tests.hardware.recording.blocks import read_recording


def described(sensors: int = 2, pixels: int = 16, markers: int = 3) -> DeviceDescription:
    return DeviceDescription(
        name="bar",
        sensors=tuple(SensorDescription(f"s{n}", pixels, 12.0) for n in range(sensors)),
        frame_rate_hz=1000.0,
        bits=12,
        electrons_per_count=12.5,
        read_noise_electrons=30.0,
        offset_counts=64.0,
        markers=markers,
    )


def numbered(sequence: int, description: DeviceDescription) -> LineFrame:
    shape = (len(description.sensors), description.sensors[0].pixels)
    rng = np.random.default_rng(sequence)
    return LineFrame(
        device=description.name,
        sequence=sequence,
        exposure_device_ns=sequence * 10**6,
        exposure_host_ns=1_000 + sequence * 10**6,
        marker=sequence % description.markers if description.markers else None,
        lines=rng.integers(0, 65536, shape, dtype=np.uint16),
    )


def assert_same(one: LineFrame, other: LineFrame) -> None:
    for name in LineFrame.__slots__:
        if name != "lines":
            assert getattr(one, name) == getattr(other, name), name
    assert one.lines.dtype == other.lines.dtype == np.uint16
    np.testing.assert_array_equal(one.lines, other.lines)


@st.composite
def recorded(draw: st.DrawFn) -> tuple[DeviceDescription, list[LineFrame]]:
    description = described(
        draw(st.integers(1, 3)), draw(st.integers(1, 40)), draw(st.integers(0, 20))
    )
    count = draw(st.integers(0, 2 * CHUNK_FRAMES + 3))
    gaps = draw(st.lists(st.integers(1, 2**40), min_size=count, max_size=count))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    shape = (len(description.sensors), description.sensors[0].pixels)
    markers = st.integers(0, description.markers - 1) if description.markers else st.nothing()
    frames = [
        LineFrame(
            device="bar",
            sequence=int(sequence),
            exposure_device_ns=int(sequence) * 1000,
            exposure_host_ns=draw(st.integers(-(2**63), 2**63 - 1)),
            marker=draw(st.none() | markers),
            lines=rng.integers(0, 65536, shape, dtype=np.uint16),
            flags=FrameFlag(draw(st.integers(0, 3))),
        )
        for sequence in np.cumsum(gaps, dtype=np.int64)
    ]
    return description, frames


@settings(max_examples=15, deadline=None)
@given(
    source=recorded(),
    compression=st.sampled_from([None, "gzip"]),
    flush_after=st.none() | st.integers(0, 70),
)
def test_what_is_written_is_read(
    source: tuple[DeviceDescription, list[LineFrame]],
    compression: Literal["gzip"] | None,
    flush_after: int | None,
) -> None:
    description, frames = source
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recording.h5"
        with RecordingWriter(path, description, compression) as writer:
            for number, frame in enumerate(frames):
                writer.append(frame)
                if number == flush_after:
                    writer.flush()
        info = read_recording(path)
        with RecordingReader(path) as reader:
            read = list(reader.frames())
            host = reader.column("exposure_host_ns").tolist()
    assert info.description == description
    assert info.frames == len(read) == len(frames)
    assert info.complete
    for one, other in zip(read, frames, strict=True):
        assert_same(one, other)
    assert host == [frame.exposure_host_ns for frame in frames]


def write(path: Path, count: int = 70, **changes: Any) -> Path:
    description = replace(described(), **changes)
    with RecordingWriter(path, description) as writer:
        for sequence in range(count):
            writer.append(numbered(sequence, description))
    return path


def test_the_summary_tells_duration_and_losses(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "r.h5", described()) as writer:
        for sequence in (5, 6, 9, 12):
            writer.append(numbered(sequence, described()))
    info = read_recording(tmp_path / "r.h5")
    assert (info.frames, info.lost) == (4, 4)
    assert info.duration_s == pytest.approx(0.007)


def record_until_it_breaks(path: Path) -> None:
    with RecordingWriter(path, described()) as writer:
        for sequence in range(10):
            writer.append(numbered(sequence, described()))
        raise OSError("the device was unplugged")


def test_a_recording_cut_short_by_an_error_says_so(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="unplugged"):
        record_until_it_breaks(tmp_path / "r.h5")
    info = read_recording(tmp_path / "r.h5")
    assert (info.frames, info.complete) == (10, False)


def test_a_file_whose_writer_died_holds_what_was_flushed(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "live.h5", described())
    for sequence in range(40):
        writer.append(numbered(sequence, described()))
    writer.flush()
    for sequence in range(40, 50):
        writer.append(numbered(sequence, described()))
    shutil.copy(tmp_path / "live.h5", tmp_path / "copy.h5")
    writer.close()
    info = read_recording(tmp_path / "copy.h5")
    assert (info.frames, info.complete) == (40, False)
    assert (read_recording(tmp_path / "live.h5").frames, writer.close()) == (50, None)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lines": np.zeros((2, 17), dtype=np.uint16)}, r"shape \(2, 17\); this recording takes"),
        ({"lines": np.zeros((2, 16), dtype=np.int16)}, "lines are int16"),
        ({"device": "other"}, "of device 'other'; this recording is of 'bar'"),
        ({"sequence": 4}, "sequence number is 4; it must be larger than the last one, 4"),
        ({"exposure_device_ns": 3}, "device time is 3 ns; it must not be before"),
        ({"marker": 3}, "marker is 3; the device has 3 strobed markers"),
        ({"marker": -1}, "marker is -1; the device has 3 strobed markers"),
    ],
)
def test_a_frame_that_does_not_belong_is_refused_and_not_written(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    with RecordingWriter(tmp_path / "r.h5", described()) as writer:
        writer.append(numbered(4, described()))
        with pytest.raises(InvalidParameter, match=message):
            writer.append(replace(numbered(5, described()), **changes))
        writer.append(numbered(6, described()))
    with RecordingReader(tmp_path / "r.h5") as reader:
        assert [frame.sequence for frame in reader.frames()] == [4, 6]


@pytest.mark.parametrize(
    "sensors",
    [(), (SensorDescription("a", 16, 12.0), SensorDescription("b", 17, 12.0))],
)
def test_a_device_without_one_length_of_line_is_refused(
    tmp_path: Path, sensors: tuple[SensorDescription, ...]
) -> None:
    with pytest.raises(InvalidParameter, match="all of them of one length"):
        RecordingWriter(tmp_path / "r.h5", replace(described(), sensors=sensors))
    assert not (tmp_path / "r.h5").exists()


def describe(file: h5py.File, description: dict[str, Any]) -> None:
    """Give a recording another description."""
    file.attrs["description"] = np.bytes_(json.dumps(description))


def refuse(path: Path, message: str) -> None:
    with pytest.raises(InvalidRecording, match=message) as refused:
        read_recording(path)
    assert path.name in refused.value.detail
    assert str(path.parent) not in refused.value.detail


def test_files_that_are_none_are_refused(tmp_path: Path) -> None:
    refuse(tmp_path / "absent.h5", "is not a file")
    (tmp_path / "folder.h5").mkdir()
    refuse(tmp_path / "folder.h5", "is not a file")
    (tmp_path / "empty.h5").touch()
    refuse(tmp_path / "empty.h5", "is not an HDF5 file, or is cut short")
    (tmp_path / "text.h5").write_text("time,x,y\n0,1,2\n" * 1000)
    refuse(tmp_path / "text.h5", "is not an HDF5 file, or is cut short")


@pytest.mark.parametrize("kept", [0.02, 0.3, 0.7, 0.999])
def test_a_file_cut_short_is_refused(tmp_path: Path, kept: float) -> None:
    data = write(tmp_path / "r.h5").read_bytes()
    (tmp_path / "r.h5").write_bytes(data[: int(kept * len(data))])
    refuse(tmp_path / "r.h5", "is cut short")


def test_an_hdf5_file_of_somebody_else_is_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["frames/lines"] = np.zeros((3, 2, 16), dtype=np.uint16)
    refuse(tmp_path / "other.h5", "is an HDF5 file of format None, version None; this")


@pytest.mark.parametrize(
    ("attribute", "value", "message"),
    [
        ("format", "something", "of format 'something', version 3; this program reads 'lumiline-"),
        ("format", 7, "of format 7"),
        ("format", ["lumiline-recording"] * 2, "of format None"),
        ("version", 2, "of format 'lumiline-recording', version 2; this program reads .*version 3"),
        ("version", "one", "version 'one'"),
        ("version", [1, 1], r"version \[1, 1\]"),
        ("version", None, "version None"),
        ("description", None, "has an unusable description"),
        ("description", 5, "has an unusable description"),
        ("description", "{", "has an unusable description"),
        ("description", "{}", "has an unusable description of the device: name: Field required"),
    ],
)
def test_attributes_of_another_make_are_refused(
    tmp_path: Path, attribute: str, value: object, message: str
) -> None:
    with h5py.File(write(tmp_path / "r.h5"), "r+") as file:
        del file.attrs[attribute]
        if value is not None:
            file.attrs[attribute] = np.bytes_(value) if isinstance(value, str) else value
    refuse(tmp_path / "r.h5", message)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sensors": []}, "describes an unusable device: the sensors have"),
        ({"bits": "many"}, "has an unusable description of the device: bits"),
        ({"markers": 2}, "has marker 2 in row 2; it must be below .* markers, 2"),
        ({"markers": 0}, "has marker 0 in row 0; it must be below .* markers, 0"),
    ],
)
def test_a_description_that_contradicts_the_frames_is_refused(
    tmp_path: Path, change: dict[str, object], message: str
) -> None:
    with h5py.File(write(tmp_path / "r.h5"), "r+") as file:
        description = json.loads(file.attrs["description"])
        describe(file, {**description, **change})
    refuse(tmp_path / "r.h5", message)


@pytest.mark.parametrize(
    "name",
    ["sequence", "exposure_device_ns", "exposure_host_ns", "marker", "flags", "lines"],
)
def test_datasets_missing_or_of_another_length_or_type_are_refused(
    tmp_path: Path, name: str
) -> None:
    with h5py.File(write(tmp_path / "r.h5"), "r+") as file:
        file[f"frames/{name}"].resize(69, axis=0)
    refuse(tmp_path / "r.h5", f"holds 69 rows in frames/{name}; its state says 70")
    with h5py.File(tmp_path / "r.h5", "r+") as file:
        values = file[f"frames/{name}"][:]
        del file[f"frames/{name}"]
        file[f"frames/{name}"] = values.astype(np.float32)
    refuse(tmp_path / "r.h5", f"holds frames/{name} as float32")
    with h5py.File(tmp_path / "r.h5", "r+") as file:
        del file[f"frames/{name}"]
        file[f"frames/{name}"] = values[..., None]
    refuse(tmp_path / "r.h5", f"holds frames/{name} as .* of shape")
    with h5py.File(tmp_path / "r.h5", "r+") as file:
        del file[f"frames/{name}"]
        file.create_group(f"frames/{name}")
    refuse(tmp_path / "r.h5", f"lacks the dataset frames/{name}")
    with h5py.File(tmp_path / "r.h5", "r+") as file:
        del file["frames"]
    refuse(tmp_path / "r.h5", "lacks the dataset frames/sequence")


@pytest.mark.parametrize(
    ("name", "row", "value", "message"),
    [
        ("sequence", 0, -1, "has sequence -1 in row 0; it must increase"),
        ("sequence", 40, 39, "has sequence 39 in row 40; it must increase"),
        ("exposure_device_ns", 40, 1, "has exposure_device_ns 1 in row 40; it must not decrease"),
        ("marker", 33, -2, "has marker -2 in row 33"),
        ("marker", 33, 3, "has marker 3 in row 33"),
    ],
)
def test_columns_that_contradict_themselves_are_refused(
    tmp_path: Path, name: str, row: int, value: int, message: str
) -> None:
    with h5py.File(write(tmp_path / "r.h5"), "r+") as file:
        file[f"frames/{name}"][row] = value
    refuse(tmp_path / "r.h5", message)


def test_a_changed_byte_in_the_lines_is_found(tmp_path: Path) -> None:
    path = write(tmp_path / "r.h5")
    with h5py.File(path, "r") as file:
        place = file["frames/lines"].id.get_chunk_info(2).byte_offset
    data = bytearray(path.read_bytes())
    data[place + 5] ^= 1
    path.write_bytes(data)
    assert read_recording(path).frames == 70
    with (
        RecordingReader(path) as reader,
        pytest.raises(InvalidRecording, match=r"r\.h5 has damaged data in frames/lines"),
    ):
        list(reader.frames())


@pytest.mark.parametrize("method", ["fit", "centroid"])
def test_description_is_read_with_the_method_of_its_peaks(
    tmp_path: Path, method: Literal["fit", "centroid"]
) -> None:
    known = read_recording(write(tmp_path / "r.h5", peaks=method)).description
    assert known == replace(described(), peaks=method)


def rewritten(path: Path, **changes: Any) -> Path:
    """A recording whose description was changed after it was written."""
    write(path)
    with h5py.File(path, "r+") as file:
        description = json.loads(file.attrs["description"])
        for name, value in changes.items():
            if name in description:
                description[name] = value
            else:
                description["sensors"][1][name.removeprefix("sensor_")] = value
        describe(file, description)
    return path


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sensor_name": ""}, "a sensor's name is ''; it must be 1 to 64 characters"),
        ({"sensor_name": "n" * 65}, "n'; it must be 1 to 64 characters"),
        ({"sensor_name": "a\0b"}, "without NUL"),
        ({"sensor_name": "s0"}, "a sensor's name is 's0'; it must be a name of its own"),
        ({"sensor_pitch_um": 0.0}, "pitch_um is 0.0; it must be positive, at most 1000"),
        ({"sensor_pitch_um": float("nan")}, "pitch_um is nan"),
        ({"sensor_pitch_um": 1000.5}, "pitch_um is 1000.5"),
        ({"bits": 0}, "bits is 0; it must be 1 to 16"),
        ({"bits": 17}, "bits is 17; it must be 1 to 16"),
        ({"electrons_per_count": 0.0}, "electrons_per_count is 0.0; it must be positive"),
        ({"electrons_per_count": float("inf")}, "electrons_per_count is inf"),
        ({"read_noise_electrons": -1.0}, "read_noise_electrons is -1.0; it must be 0 or more"),
        ({"offset_counts": float("-inf")}, "offset_counts is -inf; it must be within -65535"),
        ({"frame_rate_hz": float("inf")}, r"frame_rate_hz is inf; it must be 0 \(not known\) to"),
        ({"frame_rate_hz": float("nan")}, "frame_rate_hz is nan"),
        ({"frame_rate_hz": -1.0}, "frame_rate_hz is -1.0"),
        ({"frame_rate_hz": 1e300}, r"frame_rate_hz is 1e\+300"),
    ],
)
def test_a_description_that_means_nothing_is_refused(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    refuse(rewritten(tmp_path / "r.h5", **changes), f"describes an unusable device: .*{message}")


@pytest.mark.parametrize(
    "changes",
    [
        {"sensor_name": "n" * 64},
        {"sensor_pitch_um": 1000.0},
        {"bits": 1},
        {"bits": 16},
        {"frame_rate_hz": 0.0},
        {"read_noise_electrons": 0.0},
    ],
)
def test_what_is_just_possible_is_read(tmp_path: Path, changes: dict[str, Any]) -> None:
    assert read_recording(rewritten(tmp_path / "r.h5", **changes)).frames > 0
