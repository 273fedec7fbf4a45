"""The live pipeline without a server: from a driver's frames to what the hub publishes."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from compute.calibration.result import Calibration, SensorFit
from compute.camera.model import SensorModel
from compute.errors import InvalidParameter, InvalidRecording, LumilineError
from hardware.driver import DeviceDescription
from hardware.line_frame import LineFrame
from hardware.recording.writer import RecordingWriter
from hardware.replay import ReplayDriver
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.scenes import RotatingBar, StillPoints
from hardware.simulated.settings import SimulationSettings
from hardware.simulated.simulated_rig import simulated_rig
from service.pipeline import pipeline_manager
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.device_session import (
    BATCH_SECONDS,
    ENTER_SHARE,
    LEAVE_SHARE,
    DeviceSession,
    RunToCompletion,
)
from service.pipeline.device_status import DeviceStatus
from service.pipeline.frame_batch import FrameBatch
from service.pipeline.frame_processor import FrameProcessor
from service.pipeline.pipeline_manager import PipelineManager
from service.pipeline.threads import ComputeThread
from service.protocols.stream.hub import Hub
from service.protocols.stream.messages import StreamBatch

WAIT_S = 240.0


class RecordingHub(Hub):
    """Keeps everything that is published."""

    def __init__(self) -> None:
        super().__init__()
        self.batches: list[FrameBatch] = []
        self.messages: list[dict[str, Any]] = []

    def publish_batch(self, batch: FrameBatch) -> None:
        self.batches.append(batch)
        super().publish_batch(batch)

    def publish(self, device_id: str, message: dict[str, Any]) -> None:
        self.messages.append(message)
        super().publish(device_id, message)


def models() -> tuple[SensorModel, ...]:
    return tuple(sensor.model for sensor in simulated_rig())


def nominal(offset_mm: float = 0.0) -> Calibration:
    """The simulator's own cameras, its world moved along X."""
    moved = [
        replace(
            model,
            offset_x_mm=model.offset_x_mm - float(model.rotation[0, 0]) * offset_mm,
            offset_z_mm=model.offset_z_mm - float(model.rotation[2, 0]) * offset_mm,
        )
        for model in models()
    ]
    fits = tuple(SensorFit(model, 0, 0.0, 0.0, 1e-3, "given", None) for model in moved)
    size = 7 * len(fits)
    return Calibration("metric", fits, tuple(tuple([0.0] * size) for _ in range(size)), ())


@pytest.fixture
def live() -> Iterator[PipelineManager]:
    manager = PipelineManager(Hub(), "cpu")
    manager.streams = RecordingHub()
    yield manager
    manager.close()


def wait_for(condition: Callable[[], bool], seconds: float = 240.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not come true"
        time.sleep(0.005)


def simulation(**changes: Any) -> SimulationSettings:
    return replace(SimulationSettings(realtime=False, duration_s=0.2), **changes)


def run_to_the_end(
    live: PipelineManager, settings: SimulationSettings, calibration: Calibration | None
) -> list[dict[str, Any]]:
    """Run a simulation; returns its frame messages."""
    hub = live.streams
    assert isinstance(hub, RecordingHub)
    identity = None if calibration is None else "c1"
    live.start_device(
        "sim", SimulatedDriver("sim", settings), ActiveCalibration(identity, calibration)
    )
    wait_for(lambda: any(message["state"] == "ended" for message in hub.messages))
    return [
        message
        for batch in hub.batches
        for message in StreamBatch(batch).messages(frozenset({"points", "peaks"}))
    ]


def test_every_frame_becomes_a_message_with_a_point_where_the_marker_is(
    live: PipelineManager,
) -> None:
    bar = RotatingBar()
    messages = run_to_the_end(live, simulation(scene=bar), nominal())
    assert [message["sequence"] for message in messages] == list(range(200))
    errors, squares = [], []
    for message in messages:
        (point,) = message["points"]
        true = bar.points(message["device_ns"] * 1e-9)[message["marker"]]
        error = np.array(point["position_mm"]) - true
        errors.append(error)
        squares.append(error @ np.linalg.solve(np.array(point["covariance_mm2"]), error))
        assert point["marker"] == message["marker"] == message["sequence"] % 2
        assert len(point["sensors"]) == 4
        assert message["calibration_id"] == "c1"
        assert len(message["peaks"]) == 4
    # The stated covariance is that of the errors: chi2 of 3 has mean 3 and variance 6. The peaks'
    # error within a pixel is an average over widths, so it may be off by a fifth of the variance.
    assert np.mean(squares) == pytest.approx(3.0, abs=0.6 + 5.0 * np.sqrt(6 / len(messages)))
    residuals = [message["points"][0]["residual_sigma"] for message in messages]
    assert np.mean(np.square(residuals)) == pytest.approx(
        1.0, abs=0.2 + 5.0 * np.sqrt(2 / len(messages))
    )
    assert np.abs(np.mean(errors, axis=0)).max() < 0.05
    assert live.status("sim") == DeviceStatus(
        "ended", "the source has no more frames", "c1", None, 200, 0, 0, 200, 0
    )


def test_the_same_frames_give_the_same_messages(live: PipelineManager) -> None:
    settings = simulation(duration_s=0.05)
    first = run_to_the_end(live, settings, nominal())
    assert isinstance(live.streams, RecordingHub)
    live.streams.batches.clear()
    live.streams.messages.clear()
    second = run_to_the_end(live, settings, nominal())
    for message in (*first, *second):
        del message["exposure_ns"]
    assert first == second


def test_a_replay_gives_the_same_bits(live: PipelineManager, tmp_path: Path) -> None:
    settings = simulation(duration_s=0.1)
    path = tmp_path / "bar.h5"
    driver = SimulatedDriver("sim", settings)
    driver.open()
    with RecordingWriter(path, driver.description) as writer:
        for frame in driver.frames():
            writer.append(frame)
    direct = run_to_the_end(live, settings, nominal())
    hub = live.streams
    assert isinstance(hub, RecordingHub)
    hub.batches.clear()
    hub.messages.clear()
    live.start_device(
        "sim", ReplayDriver("sim", path, speed=None), ActiveCalibration("c1", nominal())
    )
    wait_for(lambda: any(message["state"] == "ended" for message in hub.messages))
    replayed = [
        message
        for batch in hub.batches
        for message in StreamBatch(batch).messages(frozenset({"points", "peaks"}))
    ]
    assert len(replayed) == 100
    for message in (*direct, *replayed):
        del message["exposure_ns"]
    assert replayed == direct


def test_markers_lit_together_are_told_apart_by_the_fourth_sensor(live: PipelineManager) -> None:
    scene = StillPoints(
        points_mm=((-90.0, 30.0, 1450.0), (60.0, -45.0, 1560.0), (10.0, 80.0, 1500.0))
    )
    messages = run_to_the_end(
        live, simulation(scene=scene, illumination="simultaneous", duration_s=0.05), nominal()
    )
    true = np.array(scene.points_mm)
    for message in messages:
        assert message["marker"] is None
        positions = np.array([point["position_mm"] for point in message["points"]])
        assert len(positions) == 3
        distance = np.linalg.norm(positions[:, None] - true, axis=2)
        assert sorted(distance.argmin(axis=1)) == [0, 1, 2]
        assert distance.min(axis=1).max() < 0.5


@pytest.mark.parametrize("illumination", ["strobed", "simultaneous"])
def test_a_line_over_the_sensors_end_is_not_used(live: PipelineManager, illumination: str) -> None:
    """It is drawn inwards by many times its deviation."""
    model = next(model for model in models() if model.name == "horizontal")
    lens = -model.offset_x_mm * model.rotation[0] - model.offset_z_mm * model.rotation[2]
    middle = model.rotation @ (np.array([0.0, 0.0, 1500.0]) - lens)
    u = (model.pixels - 1.5 - model.principal_point_px) / model.principal_distance_px
    point = lens + np.array([u * middle[2], middle[1], middle[2]]) @ model.rotation
    scene = StillPoints(points_mm=(tuple(point.tolist()),))
    messages = run_to_the_end(
        live, simulation(scene=scene, duration_s=0.05, illumination=illumination), nominal()
    )
    for message in messages:
        peaks = {peak["sensor"]: peak["flags"] for peak in message["peaks"]}
        assert peaks["horizontal"] == ("clipped",)
        (found,) = message["points"]
        assert "horizontal" not in found["sensors"]
        assert np.linalg.norm(np.subtract(found["position_mm"], point)) < 1.0


def test_the_misfit_counts_once_however_markers_are_lit(live: PipelineManager) -> None:
    """One marker, the same lines: strobed or not, the point and its covariance are the same."""
    known = nominal()
    fits = tuple(replace(fit, sigma_px=0.01, chi2_per_dof=26.0) for fit in known.sensors)
    misfit = replace(known, sensors=fits)
    scene = StillPoints(points_mm=((0.0, 0.0, 1500.0),))
    found = []
    for illumination in ("strobed", "simultaneous"):
        hub = live.streams
        assert isinstance(hub, RecordingHub)
        hub.batches.clear()
        hub.messages.clear()
        settings = simulation(scene=scene, illumination=illumination, duration_s=0.02)
        messages = run_to_the_end(live, settings, misfit)
        found.append([message["points"][0]["covariance_mm2"] for message in messages])
    assert np.allclose(found[0], found[1], rtol=1e-9)


def test_a_saturated_peak_makes_a_doubtful_point(live: PipelineManager) -> None:
    scene = StillPoints(points_mm=((0.0, 0.0, 1500.0),))
    for electrons, flagged in ((1e5, False), (5e6, True)):
        hub = live.streams
        assert isinstance(hub, RecordingHub)
        hub.batches.clear()
        hub.messages.clear()
        settings = simulation(scene=scene, signal_electrons=electrons, duration_s=0.02)
        for message in run_to_the_end(live, settings, nominal()):
            assert ("suspect-peak" in message["points"][0]["flags"]) == flagged


def test_without_a_calibration_there_are_peaks_and_no_points(live: PipelineManager) -> None:
    messages = run_to_the_end(live, simulation(duration_s=0.02), None)
    assert all(message["points"] == [] for message in messages)
    assert all(message["calibration_id"] is None for message in messages)
    assert all(len(message["peaks"]) == 4 for message in messages)


def test_a_hidden_marker_is_a_point_without_position_and_with_a_reason(
    live: PipelineManager,
) -> None:
    scene = StillPoints(points_mm=((0.0, 0.0, 1500.0),))
    messages = run_to_the_end(
        live, simulation(scene=scene, signal_electrons=0.0, duration_s=0.02), nominal()
    )
    for message in messages:
        (point,) = message["points"]
        assert point["position_mm"] is None
        assert point["flags"] == ("too-few-sensors",)


def test_calibrations_are_switched_between_two_frames(live: PipelineManager) -> None:
    """No frame is lost, and each message's point belongs to the calibration that it names."""
    hub = live.streams
    assert isinstance(hub, RecordingHub)
    scene = StillPoints(points_mm=((0.0, 0.0, 1500.0),))
    settings = SimulationSettings(scene=scene, frame_rate_hz=500.0)
    live.start_device("sim", SimulatedDriver("sim", settings), ActiveCalibration("zero", nominal()))
    wait_for(lambda: len(hub.batches) > 20)
    for turn in range(20):
        name, shift = (("ten", 10.0), ("zero", 0.0))[turn % 2]
        live.set_calibration("sim", ActiveCalibration(name, nominal(shift)))
        seen = len(hub.batches)
        wait_for(lambda seen=seen: len(hub.batches) > seen + 1)  # type: ignore[misc]
    live.stop_device("sim")
    messages = [m for b in hub.batches for m in StreamBatch(b).messages(frozenset({"points"}))]
    sequences = [message["sequence"] for message in messages]
    assert sequences == list(range(sequences[0], sequences[0] + len(sequences)))
    assert {message["calibration_id"] for message in messages} == {"zero", "ten"}
    for message in messages:
        expected = {"zero": 0.0, "ten": 10.0}[message["calibration_id"]]
        assert message["points"][0]["position_mm"][0] == pytest.approx(expected, abs=0.5)


class FaultyDriver(SimulatedDriver):
    """Fails after some frames, as a driver with a bug or an unplugged device does."""

    def __init__(self, error: Exception) -> None:
        super().__init__("sim", simulation())
        self._error = error

    def frames(self) -> Iterator[LineFrame]:
        for count, frame in enumerate(super().frames()):
            if count == 5:
                raise self._error
            yield frame


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (InvalidRecording("the file ends in frame 5"), "the file ends in frame 5"),
        (OSError("secret path"), "the driver failed: OSError"),
    ],
)
def test_a_failing_driver_is_a_state_with_a_reason(
    live: PipelineManager, error: Exception, reason: str
) -> None:
    hub = live.streams
    assert isinstance(hub, RecordingHub)
    live.start_device("sim", FaultyDriver(error), ActiveCalibration("c1", nominal()))
    wait_for(lambda: any(message["state"] == "failed" for message in hub.messages))
    status = live.status("sim")
    assert (status.state, status.reason) == ("failed", reason)
    assert status.frames_processed == 5


def test_a_driver_that_cannot_be_opened_starts_nothing(live: PipelineManager) -> None:
    class Closed(SimulatedDriver):
        def open(self) -> None:
            raise InvalidRecording("no such recording")

    with pytest.raises(InvalidRecording):
        live.start_device("sim", Closed("sim", simulation()))
    assert live.status("sim") == DeviceStatus("failed", "no such recording")
    live.start_device("sim", SimulatedDriver("sim", simulation()))
    assert live.status("sim").state != "failed"


def test_a_description_that_the_kernel_cannot_take_closes_the_driver(live: PipelineManager) -> None:
    closed = threading.Event()

    class Tiny(SimulatedDriver):
        @property
        def description(self) -> DeviceDescription:
            known = super().description
            sensors = tuple(replace(sensor, pixels=3) for sensor in known.sensors)
            return replace(known, sensors=sensors)

        def close(self) -> None:
            super().close()
            closed.set()

    driver = Tiny("sim", simulation())
    with pytest.raises(Exception, match="3 pixels"):
        live.start_device("sim", driver)
    assert closed.is_set()


def test_stopping_and_starting_again(live: PipelineManager) -> None:
    endless = SimulationSettings()
    for _ in range(3):
        live.start_device(
            "sim", SimulatedDriver("sim", endless), ActiveCalibration("c1", nominal())
        )
        wait_for(lambda: live.status("sim").frames_processed > 3)
        live.stop_device("sim")
        assert live.status("sim").state == "stopped"
    live.start_device("sim", SimulatedDriver("sim", endless), ActiveCalibration("c1", nominal()))
    live.start_device("sim", SimulatedDriver("sim", endless), ActiveCalibration("c1", nominal()))
    assert live.status("sim").state == "running"
    names = [thread.name for thread in threading.enumerate()]
    assert names.count("reader-sim") == 1
    live.forget_device("sim")
    assert live.status("sim") == DeviceStatus("stopped")


def test_a_calibration_of_other_sensors_is_refused(live: PipelineManager) -> None:
    known = nominal()
    first = replace(known.sensors[0], model=replace(known.sensors[0].model, name="another"))
    other = replace(known, sensors=(first, *known.sensors[1:]))
    with pytest.raises(InvalidParameter, match="another"):
        live.start_device(
            "sim", SimulatedDriver("sim", simulation()), ActiveCalibration("c1", other)
        )
    assert live.status("sim").state == "failed"

    # A running one goes on with what it has: its source was changed, and works from the next start.
    live.start_device(
        "sim", SimulatedDriver("sim", SimulationSettings()), ActiveCalibration("c1", known)
    )
    live.set_calibration("sim", ActiveCalibration("c2", other))
    assert live.status("sim").calibration_id == "c1"
    live.set_calibration("sim", ActiveCalibration("c3", known))
    assert live.status("sim").calibration_id == "c3"
    live.stop_device("sim")
    live.set_calibration("sim", ActiveCalibration("c4", known))
    assert live.status("sim").calibration_id == "c3"


def test_a_failure_of_the_processing_ends_the_device(
    live: PipelineManager, monkeypatch: pytest.MonkeyPatch
) -> None:
    hub = live.streams
    assert isinstance(hub, RecordingHub)
    process = FrameProcessor.process

    def fail_after_20(
        self: FrameProcessor, frames: Sequence[LineFrame], **members: Any
    ) -> FrameBatch:
        if frames[-1].sequence > 20:
            raise ArithmeticError("singular")
        return process(self, frames, **members)

    monkeypatch.setattr(FrameProcessor, "process", fail_after_20)
    driver = SimulatedDriver("sim", SimulationSettings())
    live.start_device("sim", driver, ActiveCalibration("c1", nominal()))
    wait_for(lambda: any(message["state"] == "failed" for message in hub.messages))
    status = live.status("sim")
    assert status.state == "failed"
    assert status.reason is not None
    assert "singular" in status.reason
    wait_for(lambda: "reader-sim" not in [thread.name for thread in threading.enumerate()])
    monkeypatch.setattr(FrameProcessor, "process", process)
    live.start_device(
        "sim", SimulatedDriver("sim", simulation()), ActiveCalibration("c1", nominal())
    )
    assert live.status("sim").state != "failed"


def test_a_device_with_slow_frames_takes_few_at_a_time(
    live: PipelineManager, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Other devices wait for one batch: 64 slow frames would be seconds."""
    hub = live.streams
    assert isinstance(hub, RecordingHub)
    process = FrameProcessor.process

    def slow(self: FrameProcessor, frames: Sequence[LineFrame], **members: Any) -> FrameBatch:
        time.sleep(2.0 * BATCH_SECONDS * len(frames))
        return process(self, frames, **members)

    monkeypatch.setattr(FrameProcessor, "process", slow)
    live.start_device(
        "sim", SimulatedDriver("sim", SimulationSettings()), ActiveCalibration("c1", nominal())
    )
    wait_for(lambda: len(hub.batches) > 5)
    assert {len(batch.frames) for batch in hub.batches[1:]} == {1}


def test_status_never_waits(live: PipelineManager) -> None:
    """The event loop asks for it; a start or stop may hold the manager for seconds."""
    live.start_device(
        "sim", SimulatedDriver("sim", SimulationSettings()), ActiveCalibration("c1", nominal())
    )
    answers: list[DeviceStatus] = []
    with live._lock:
        asking = threading.Thread(
            target=lambda: (live.describe("sim"), answers.append(live.status("sim")))
        )
        asking.start()
        asking.join(240.0)
        assert len(answers) == 1


def test_a_closed_manager_starts_nothing_and_does_not_hang() -> None:
    manager = PipelineManager(Hub(), "cpu")
    manager.start_device("sim", SimulatedDriver("sim", SimulationSettings()))
    manager.close()
    assert not manager.ready
    with pytest.raises(RuntimeError, match="closed"):
        manager.start_device("other", SimulatedDriver("sim", SimulationSettings()))
    names = [thread.name for thread in threading.enumerate()]
    assert "reader-sim" not in names


def test_worker_that_a_job_removes_is_not_called_again_in_the_same_round() -> None:
    """Else frames of a device that was stopped come behind the message that says so."""
    compute = ComputeThread()
    began, go_on = threading.Event(), threading.Event()
    calls: list[str] = []

    def first() -> bool:
        calls.append("first")
        began.set()
        go_on.wait(WAIT_S)
        return False

    def second() -> bool:
        calls.append("second")
        return False

    def add() -> None:
        compute.add("first", first)
        compute.add("second", second)

    try:
        compute.submit(add)
        assert began.wait(WAIT_S)
        removed = compute.submit(lambda: compute.remove("second"))
        go_on.set()
        removed.result(WAIT_S)
        compute.submit(lambda: None).result(WAIT_S)
    finally:
        compute.close()
    assert set(calls) == {"first"}


class Working:
    """A compute thread with a worker that says where it took a frame, and waits if told to."""

    def __init__(self) -> None:
        self.compute = ComputeThread()
        self.frames = 0
        self.threads: list[str] = []
        self.go_on, self.began = threading.Event(), threading.Event()
        self.go_on.set()
        self.compute.submit(lambda: self.compute.add("sim", self.work)).result(WAIT_S)

    def work(self) -> bool:
        if not self.frames:
            return False
        self.frames -= 1
        self.threads.append(threading.current_thread().name)
        self.began.set()
        self.go_on.wait(WAIT_S)
        return True


@pytest.fixture
def working() -> Iterator[Working]:
    working = Working()
    yield working
    working.go_on.set()
    working.compute.close()


def test_frame_is_processed_where_it_was_read(working: Working) -> None:
    # Not while the thread is still busy with how the worker was added.
    wait_for(lambda: working.compute.busy_s == 0.0)
    working.frames = 1
    working.compute.work_now("sim")
    assert len(working.threads) == 1
    assert working.compute.busy_s == 0.0


def test_worker_is_never_called_twice_at_a_time(working: Working) -> None:
    working.go_on.clear()
    working.frames = 2
    working.compute.wake()
    assert working.began.wait(WAIT_S)
    working.compute.work_now("sim")  # leaves it to the thread that is busy
    assert working.threads == ["compute"]
    working.go_on.set()
    wait_for(lambda: working.threads == ["compute"] * 2)


def test_job_waits_for_a_worker_in_another_thread_and_then_goes_first(working: Working) -> None:
    working.go_on.clear()
    wait_for(lambda: working.compute.busy_s == 0.0)
    working.frames = 1
    reader = threading.Thread(target=working.compute.work_now, args=("sim",), name="reader")
    reader.start()
    assert working.began.wait(WAIT_S)
    order: list[str] = []
    job = working.compute.submit(lambda: order.extend(working.threads))
    assert not job.done()
    assert working.compute.busy_s > 0.0
    wait_for(lambda: working.compute._waits)
    working.frames = 1
    working.compute.work_now("sim")  # not before the job
    working.go_on.set()
    job.result(WAIT_S)
    reader.join(WAIT_S)
    assert order[:1] == working.threads[:1]
    assert len(order) == 1


def test_removed_and_failed_workers_are_not_called_where_frames_are_read(working: Working) -> None:
    working.compute.submit(lambda: working.compute.remove("sim")).result(WAIT_S)
    working.frames = 1
    working.compute.work_now("sim")
    assert working.threads == []
    calls: list[str] = []

    def fail() -> bool:
        calls.append("failed")
        raise ArithmeticError("singular")

    working.compute.submit(lambda: working.compute.add("other", fail))
    wait_for(lambda: bool(calls))
    working.compute.work_now("other")
    assert calls == ["failed"]


def test_nothing_is_called_in_a_closed_thread(working: Working) -> None:
    working.compute.close()
    working.frames = 1
    working.compute.work_now("sim")
    assert working.threads == []


def counted(
    decision: RunToCompletion,
    share: float,
    cycle: float = 1.0,
    frames: int = 300,
    begin_s: float = 0.0,
) -> RunToCompletion:
    """Let frames of a device of 1 kHz be processed, so many periods apart; return the decision."""
    for number in range(frames):
        decision.count(begin_s + 1e-3 * cycle * number, 1e-3 * share)
    return decision


@pytest.mark.parametrize(("share", "alone"), [(0.3, True), (0.9, False)])
def test_frames_that_take_a_small_part_of_their_period_run_to_completion(
    share: float, alone: bool
) -> None:
    decision = RunToCompletion(1000.0)
    assert not decision.is_due
    assert counted(decision, share).is_due is alone
    # Between the two limits it stays as it is; a single long frame changes it for a while only.
    between = (ENTER_SHARE + LEAVE_SHARE) / 2.0
    assert counted(decision, between, begin_s=0.3).is_due is alone
    decision.count(0.601, 0.05)
    assert not decision.is_due
    assert counted(decision, share, begin_s=0.7).is_due is alone


@pytest.mark.parametrize("cycle", [0.25, 1.2])
def test_frames_of_another_rate_than_the_devices_do_not_run_to_completion(cycle: float) -> None:
    """A replay at four times the speed; a machine for which reading and processing is too much."""
    decision = counted(RunToCompletion(1000.0), 0.4)
    assert decision.is_due
    assert not counted(decision, 0.4, cycle, begin_s=0.3).is_due
    assert counted(decision, 0.4, begin_s=1.0).is_due


def test_pause_of_a_device_changes_little() -> None:
    decision = counted(RunToCompletion(1000.0), 0.3)
    assert counted(decision, 0.3, frames=100, begin_s=60.0).is_due


@pytest.mark.parametrize("rate_hz", [0.0, 30.0])
def test_frames_of_an_unknown_or_a_low_rate_do_not_run_to_completion(rate_hz: float) -> None:
    decision = RunToCompletion(rate_hz)
    for number in range(200):
        decision.count(number / 30.0, 1e-6)
    assert not decision.is_due


def test_device_runs_to_completion_while_its_source_cannot_wait(live: PipelineManager) -> None:
    """By the session of a real device: not of a replay, and not of frames that wait already."""
    live.start_device("sim", SimulatedDriver("sim", SimulationSettings()), ActiveCalibration())
    session = live.known_session("sim")
    assert session is not None
    assert session.reader is not None
    live.stop_device("sim")
    session.ring.take(1000)
    frame = LineFrame("sim", 10**9, 0, 0, None, np.zeros((4, 8), np.uint16))
    session._run_to_completion.is_due = True
    assert not session.runs_to_completion
    session.ring.put(frame)
    assert session.runs_to_completion
    session.reader.lossless = True
    assert not session.runs_to_completion
    session.reader.lossless = False
    session.processor.uses_gpu = True
    assert not session.runs_to_completion
    session.processor.uses_gpu = False
    session.ring.put(replace(frame, sequence=10**9 + 1))
    assert not session.runs_to_completion


class BrokenDriver(SimulatedDriver):
    """Has a fault of its own."""

    def open(self) -> None:
        raise KeyError("firmware")


def test_unexpected_error_of_a_driver_is_the_devices_state() -> None:
    hub = RecordingHub()
    live = PipelineManager(hub, "cpu")
    try:
        with pytest.raises(LumilineError, match="the driver failed: KeyError"):
            live.start_device("sim", BrokenDriver("sim", SimulationSettings()))
        assert live.status("sim").state == "failed"
    finally:
        live.close()
    assert hub.messages[-1]["state"] == "failed"
    assert "KeyError" in hub.messages[-1]["reason"]


def test_change_of_a_link_leaves_frames_that_come_meanwhile_to_the_next_round() -> None:
    session: Any = SimpleNamespace(
        ring=SimpleNamespace(received=3), _accounted=0, connected=True, stopped=True
    )

    def work() -> bool:
        session._accounted += 1
        session.ring.received += 1
        assert session._accounted < 100
        return True

    session.work = work
    DeviceSession.publish_change(session)
    assert session._accounted == 3


class TracingDriver(SimulatedDriver):
    """Says that it prepares itself, until it is let go on."""

    def __init__(self, go_on: threading.Event) -> None:
        super().__init__("one", SimulationSettings(frame_rate_hz=200.0))
        self.preparation: str | None = "it prepares itself"
        self._go_on = go_on

    def _prepare(self, closed: threading.Event) -> None:
        self._go_on.wait(WAIT_S)
        self.preparation = None


def test_what_a_driver_does_before_its_first_frame_is_told(live: PipelineManager) -> None:
    go_on = threading.Event()
    live.start_device("one", TracingDriver(go_on))
    status = live.status("one")
    assert (status.state, status.reason, status.frames_received) == (
        "running", "it prepares itself", 0,
    )  # fmt: skip
    go_on.set()
    wait_for(lambda: live.status("one").reason is None)
    # Clients are told when it begins and when it is over.
    streams = live.streams
    assert isinstance(streams, RecordingHub)
    wait_for(lambda: streams.messages[-1].get("reason") is None)
    told = [one.get("reason") for one in streams.messages if one.get("state") == "running"]
    assert told == ["it prepares itself", None]


def test_running_device_says_that_its_calibration_is_a_profiles_nominal_one(
    live: PipelineManager,
) -> None:
    content = {"provenance": "nominal", "profile": {"profile_id": "bar", "content_hash": "0" * 64}}
    active = ActiveCalibration("n", nominal(), calibration_content=content)
    settings = SimulationSettings(frame_rate_hz=200.0)
    live.start_device("one", SimulatedDriver("one", settings), active)
    assert 'nominal: computed from the profile "bar"' in (live.status("one").reason or "")
    live.set_calibration("one", ActiveCalibration("measured", nominal()))
    wait_for(lambda: live.status("one").reason is None)


class HangingDriver(SimulatedDriver):
    """Opening it takes until it is let go on."""

    def __init__(self, go_on: threading.Event) -> None:
        super().__init__("hanging", SimulationSettings(frame_rate_hz=200.0))
        self._go_on = go_on

    def open(self) -> None:
        self._go_on.wait(WAIT_S)
        super().open()


@pytest.fixture
def hanging(live: PipelineManager, monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """What the driver of the device "hanging" waits for, which was started."""
    go_on = threading.Event()
    with monkeypatch.context() as patch:
        patch.setattr(pipeline_manager, "OPEN_S", 0.01)
        assert live.start_device("hanging", HangingDriver(go_on)) is None
    return go_on


def test_driver_that_hangs_while_it_is_opened_keeps_no_other_device_waiting(
    live: PipelineManager, hanging: threading.Event
) -> None:
    assert live.status("hanging").state == "starting"
    live.start_device("one", SimulatedDriver("one", SimulationSettings(frame_rate_hz=200.0)))
    assert live.status("one").state == "running"
    live.stop_device("hanging")
    assert live.status("hanging").state == "stopped"
    hanging.set()
    # Once it can be opened, it stays as it was told to be.
    live.start_device("hanging", HangingDriver(hanging))
    wait_for(lambda: live.status("hanging").frames_received > 0)
    live.stop_device("hanging")
    assert live.status("hanging").state == "stopped"


def test_driver_that_is_opened_late_runs_then(
    live: PipelineManager, hanging: threading.Event
) -> None:
    hanging.set()
    wait_for(lambda: live.status("hanging").state == "running")
