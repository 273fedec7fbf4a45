"""ReplayDriver: paced and unpaced replay, close from another thread."""

import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from compute.errors import InvalidParameter, InvalidRecording
from hardware.line_frame import LineFrame
from hardware.recording.layout import CHUNK_FRAMES
from hardware.recording.reader import RecordingReader
from hardware.recording.writer import RecordingWriter
from hardware.replay import ReplayDriver
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.settings import SimulationSettings


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """0.1 s of the simulated bar, with a hole."""
    path = tmp_path_factory.mktemp("recordings") / "bar.h5"
    driver = SimulatedDriver("bar", SimulationSettings(realtime=False, duration_s=0.1))
    driver.open()
    with RecordingWriter(path, driver.description) as writer:
        for frame in driver.frames():
            if not 40 <= frame.sequence < 47:
                writer.append(frame)
    return path


def original(path: Path) -> list[LineFrame]:
    with RecordingReader(path) as reader:
        return list(reader.frames())


def played(path: Path, speed: float | None) -> list[LineFrame]:
    driver = ReplayDriver("again", path, speed)
    driver.open()
    frames = list(driver.frames())
    driver.close()
    return frames


def assert_same_run(frames: list[LineFrame], recorded: list[LineFrame]) -> None:
    assert len(recorded) == 93
    for one, other in zip(frames, recorded, strict=True):
        assert one.device == "again"
        assert one.sequence == other.sequence
        assert one.exposure_device_ns == other.exposure_device_ns
        assert (one.marker, one.flags) == (other.marker, other.flags)
        np.testing.assert_array_equal(one.lines, other.lines)


def test_recorded_frames_are_those_of_the_simulation(recording: Path) -> None:
    driver = SimulatedDriver("bar", SimulationSettings(realtime=False, duration_s=0.1))
    driver.open()
    simulated = [frame for frame in driver.frames() if not 40 <= frame.sequence < 47]
    for one, other in zip(original(recording), simulated, strict=True):
        assert (one.sequence, one.marker) == (other.sequence, other.marker)
        np.testing.assert_array_equal(one.lines, other.lines)


def test_as_fast_as_taken_everything_is_as_recorded(recording: Path) -> None:
    recorded = original(recording)
    frames = played(recording, None)
    assert_same_run(frames, recorded)
    assert [f.exposure_host_ns for f in frames] == [f.exposure_host_ns for f in recorded]


@pytest.mark.parametrize("speed", [1.0, 10.0])
def test_paced_the_bits_are_the_same_and_the_host_times_are_of_now(
    recording: Path, speed: float
) -> None:
    recorded = original(recording)
    started_ns = time.monotonic_ns()
    before_ns = time.time_ns()
    driver = ReplayDriver("again", recording, speed)
    driver.open()
    frames = []
    for frame in driver.frames():
        passed_ns = frame.exposure_device_ns - recorded[0].exposure_device_ns
        assert time.monotonic_ns() >= started_ns + passed_ns / speed
        assert frame.exposure_host_ns >= before_ns
        frames.append(frame)
    driver.close()
    assert_same_run(frames, recorded)


def test_the_description_is_the_recorded_one_under_the_new_name(recording: Path) -> None:
    driver = ReplayDriver("again", recording)
    with pytest.raises(RuntimeError, match="call open"):
        _ = driver.description
    driver.open()
    recorded = SimulatedDriver("bar", SimulationSettings()).description
    assert driver.description == replace(recorded, name="again")
    driver.close()


def test_opened_again_it_starts_at_the_first_frame(recording: Path) -> None:
    driver = ReplayDriver("again", recording, None)
    driver.open()
    old = driver.frames()
    for _ in range(50):
        next(old)
    driver.open()
    assert [frame.sequence for frame in driver.frames()][:3] == [0, 1, 2]
    assert list(old) == []
    driver.close()


def test_close_from_another_thread_ends_a_waiting_host_at_once(recording: Path) -> None:
    """The second frame is 1000 s away."""
    driver = ReplayDriver("again", recording, 1e-6)
    driver.open()
    first = threading.Event()
    got: list[LineFrame] = []

    def read() -> None:
        for frame in driver.frames():
            got.append(frame)
            first.set()

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    assert first.wait(240.0)
    driver.close()
    driver.close()
    reader.join(timeout=240.0)
    assert not reader.is_alive()
    assert [frame.sequence for frame in got] == [0]


@pytest.mark.parametrize("taken", [1, CHUNK_FRAMES, CHUNK_FRAMES + 1])
def test_close_while_reading_ends_without_an_error(recording: Path, taken: int) -> None:
    driver = ReplayDriver("again", recording, None)
    driver.open()
    frames = driver.frames()
    for _ in range(taken):
        next(frames)
    driver.close()
    assert list(frames) == []


def test_a_bad_file_is_refused_when_opened(tmp_path: Path) -> None:
    (tmp_path / "bad.h5").write_text("not a recording")
    driver = ReplayDriver("again", tmp_path / "bad.h5")
    with pytest.raises(InvalidRecording, match=r"bad\.h5 is not an HDF5 file"):
        driver.open()


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan"), float("inf")])
def test_a_speed_without_meaning_is_refused(recording: Path, speed: float) -> None:
    with pytest.raises(InvalidParameter, match=f"speed is {speed}; it must be positive"):
        ReplayDriver("again", recording, speed)
