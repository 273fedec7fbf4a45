"""A writer that stalls, starts late or cannot go on concerns its recording, and nobody else."""

import logging
import os
import signal
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread
from typing import Any, Final

import pytest

from hardware.recording.reader import RecordingReader
from hardware.recording.writer_process.client import WRITER_LATE
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.settings import SimulationSettings
from service.api.paging import Paging
from service.api.recordings.recorder import Recorder
from service.api.recordings.recording_manager import RecordingManager
from service.api.recordings.schema import NewRecording
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.frame_batch import FrameBatch
from service.pipeline.pipeline_manager import PipelineManager
from service.problems.errors import RecordingExists, RecordingInProgress
from service.protocols.stream.hub import Hub
from tests.hardware.recording.blocks import read_recording
from tests.service.pipeline.test_pipeline_manager import nominal, wait_for

FIRST_PAGE = Paging(10, None, "")

HANGS_S = 20.0
"""What has not returned by then waits for the writer."""
BEYOND_PIPES = bytes(2**20)
"""A table's file that no pipe takes at once."""


@pytest.fixture(scope="module")
def live() -> Iterator[PipelineManager]:
    manager = PipelineManager(Hub(), "cpu")
    for name in ("sim", "other"):
        settings = SimulationSettings(frame_rate_hz=100.0)
        manager.start_device(
            name, SimulatedDriver(name, settings), ActiveCalibration("c1", nominal())
        )
    yield manager
    manager.close()


@pytest.fixture
def recordings(live: PipelineManager, tmp_path: Path) -> Iterator[RecordingManager]:
    made = RecordingManager(live, tmp_path, flush_s=0.05)
    yield made
    made.close()


class Stalled:
    """A recording whose process is stopped, as by a disk that does not answer."""

    wants_pixels: Final = False

    def __init__(self, recordings: RecordingManager, name: str) -> None:
        recordings.start("sim", NewRecording(id=name))
        wait_for(lambda: (recordings.get(name).frames_written or 0) > 0)
        self._pid = recordings._active[name]._feed.pid
        os.kill(self._pid, signal.SIGSTOP)

    def __enter__(self) -> "Stalled":
        return self

    def __exit__(self, *_: object) -> None:
        os.kill(self._pid, signal.SIGCONT)


def returns(call: Callable[[], Any]) -> None:
    """It returns, whatever the writer does."""
    thread = Thread(target=call, daemon=True)
    thread.start()
    thread.join(HANGS_S)
    assert not thread.is_alive(), "it waits for the writer"


def goes_on(live: PipelineManager) -> bool:
    """Wait until the device has had some more frames processed."""
    before = live.status("sim").frames_processed
    wait_for(lambda: live.status("sim").frames_processed > before + 3)
    return live.status("sim").state == "running"


def test_activations_frames_and_stops_do_not_wait_for_a_writer_that_stalls(
    live: PipelineManager, recordings: RecordingManager
) -> None:
    with Stalled(recordings, "r.h5"):
        for number in range(3):
            found = ActiveCalibration(f"n{number}", nominal(), table_file=BEYOND_PIPES)
            returns(lambda found=found: live.set_calibration("sim", found))
            assert goes_on(live)
        recorder = recordings._active["r.h5"]
        returns(lambda: recorder.stop("stopped by request"))
        assert recordings.get("r.h5").state == "recording"
        assert len(recordings.page(None, FIRST_PAGE).items) == 1
        assert recordings.written()["sim"].open == 1
    # It goes on, and all that it was given is in the file.
    done = recordings.stop("r.h5")
    assert (done.state, done.reason) == ("complete", "stopped by request")
    assert [one.calibration_id for one in done.calibrations][-3:] == ["n0", "n1", "n2"]
    with RecordingReader(recordings.finished_path("r.h5")) as reader:
        last = len(done.calibrations) - 1
        assert reader.active_calibration(last)[1] == BEYOND_PIPES
        assert reader.column("active_calibration")[-1] == last


def test_a_writer_that_does_not_stop_is_killed(
    live: PipelineManager, recordings: RecordingManager, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hardware.recording.writer_process.client.STOP_S", 0.2)
    recordings.start("sim", NewRecording(id="r.h5"))
    wait_for(lambda: (recordings.get("r.h5").frames_written or 0) > 0)
    os.kill(recordings._active["r.h5"]._feed.pid, signal.SIGSTOP)
    done = recordings.stop("r.h5")
    assert (done.state, done.reason) == ("failed", WRITER_LATE.format(0.2))
    info = read_recording(recordings.finished_path("r.h5"))
    assert not info.complete
    assert info.frames > 0
    assert goes_on(live)


def test_the_servers_end_leaves_a_writer_that_stalls_to_itself(
    live: PipelineManager, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.api.recordings.recording_manager._SHUTDOWN_S", 0.1)
    recordings = RecordingManager(live, tmp_path, flush_s=0.05)
    with Stalled(recordings, "r.h5"):
        returns(recordings.close)
        assert not read_recording(tmp_path / "r.h5").complete
    wait_for(lambda: read_recording(tmp_path / "r.h5").complete)
    assert read_recording(tmp_path / "r.h5").state.reason == "the server was shut down"


def test_others_do_not_wait_for_a_recording_that_begins(
    recordings: RecordingManager, monkeypatch: pytest.MonkeyPatch
) -> None:
    begins, goes = Event(), Event()

    def slow(*arguments: Any) -> Recorder:
        begins.set()
        assert goes.wait(HANGS_S)
        return Recorder(*arguments)

    monkeypatch.setattr("service.api.recordings.recording_manager.Recorder", slow)
    request = NewRecording(id="r.h5")
    first = Thread(target=lambda: recordings.start("sim", request), daemon=True)
    first.start()
    assert begins.wait(HANGS_S)
    returns(lambda: (recordings.written(), recordings.page(None, FIRST_PAGE)))
    with pytest.raises(RecordingInProgress, match=r'"sim" is being recorded to "r\.h5"'):
        recordings.start("sim", NewRecording(id="s.h5"))
    with pytest.raises(RecordingExists):
        recordings.start("other", request)
    # The file has its name before the process has told of it.
    path = recordings.library.folder / "r.h5"
    path.write_bytes(b"its first bytes")
    assert recordings.get("r.h5").state == "recording"
    with pytest.raises(RecordingInProgress, match="is being written"):
        recordings.delete("r.h5", lambda _: None)
    path.unlink()
    goes.set()
    first.join(HANGS_S)
    assert recordings.stop("r.h5").state == "complete"


def test_a_recording_that_begins_while_the_server_ends_is_closed(
    live: PipelineManager, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recordings = RecordingManager(live, tmp_path)

    def late(*arguments: Any) -> Recorder:
        recordings.close()
        return Recorder(*arguments)

    monkeypatch.setattr("service.api.recordings.recording_manager.Recorder", late)
    recordings.start("sim", NewRecording(id="r.h5"))
    wait_for(lambda: read_recording(tmp_path / "r.h5").complete)
    assert read_recording(tmp_path / "r.h5").state.reason == "the server was shut down"


def test_a_tap_that_fails_is_detached_and_the_device_goes_on(
    live: PipelineManager, caplog: pytest.LogCaptureFixture
) -> None:
    class Failing:
        offered = 0

        def prepare(self, found: ActiveCalibration) -> None: ...

        def offer(self, batch: FrameBatch) -> None:
            self.offered += 1
            raise ValueError("of this tap only")

    tap = Failing()
    session = live.session("sim")
    with caplog.at_level(logging.ERROR):
        session.attach(tap)
        wait_for(lambda: tap.offered > 0)
        assert goes_on(live)
    assert tap.offered == 1
    assert tap not in session.taps
    assert "device sim: Failing failed and has no more of its frames" in caplog.text
    assert "of this tap only" in caplog.text


def test_frames_that_cannot_be_handed_over_end_the_recording_with_the_reason(
    live: PipelineManager, recordings: RecordingManager, monkeypatch: pytest.MonkeyPatch
) -> None:
    recordings.start("sim", NewRecording(id="r.h5"))
    wait_for(lambda: (recordings.get("r.h5").frames_written or 0) > 0)

    def fails(_: FrameBatch) -> None:
        raise ValueError("no rows of these")

    monkeypatch.setattr("service.api.recordings.recorder.point_rows", fails)
    wait_for(lambda: recordings.get("r.h5").state == "complete")
    reason = recordings.get("r.h5").reason
    assert reason == "frames could not be handed over: ValueError: no rows of these"
    assert goes_on(live)


def test_a_calibration_that_cannot_be_kept_fails_the_recording_only(
    live: PipelineManager, recordings: RecordingManager
) -> None:
    recordings.start("sim", NewRecording(id="r.h5"))
    wait_for(lambda: (recordings.get("r.h5").frames_written or 0) > 0)
    good = live.session("sim").processor.active_calibration
    content = {"result": float("nan")}
    live.set_calibration("sim", replace(good, calibration_content=content, calibration_hash="h"))
    wait_for(lambda: recordings.get("r.h5").state == "failed")
    assert "the active calibration cannot be kept: ValueError" in str(recordings.get("r.h5").reason)
    assert goes_on(live)
    live.set_calibration("sim", good)
