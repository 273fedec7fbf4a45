"""RemotePipeline with a real station: the same results as in one process, and what loss means."""

import asyncio
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, Final

import pytest

from compute.errors import InvalidParameter
from hardware.driver import DeviceDescription
from hardware.line_frame import LineFrame
from hardware.recording.writer import RecordingWriter
from hardware.replay import ReplayDriver
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.settings import SimulationSettings
from service.application.initial_content import nominal_calibration
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.frame_batch import FrameBatch
from service.pipeline.interface import Pipeline
from service.pipeline.pipeline_manager import PipelineManager
from service.pipeline.tracking_config import TrackingConfig
from service.problems.errors import DeviceNotRunning, NotReady
from service.protocols.stream.hub import Hub
from service.protocols.stream.messages import CONTENTS
from service.station import station_process
from service.station.bus_messages import BatchMessage
from service.station.remote_pipeline import RemotePipeline
from service.station.station_process import StationProcess
from service.station.station_starter import StationStarter
from tests.service.api.beam_holds.batches import CHEST, hold
from tests.service.pipeline.test_tools_live import SCENE, tools
from tests.service.station.conftest import WAIT_S, MakePipeline

CALIBRATED = ActiveCalibration("nominal", nominal_calibration())
LIVE = SimulationSettings(frame_rate_hz=200.0)


def wait_for(condition: Callable[[], object]) -> None:
    end = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.01)


def messages(hub: Hub, device_id: str) -> list[dict[str, Any]]:
    """All messages of a device's log, with all contents."""
    return [
        {"n": number} | message
        for entry in hub.log(device_id).since(0, 1 << 20)
        for number, message in enumerate(
            entry.messages(frozenset(CONTENTS), 0, entry.count), entry.first
        )
    ]


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A second of tools."""
    path = tmp_path / "tools.h5"
    driver = SimulatedDriver("sim", SimulationSettings(scene=SCENE, duration_s=1.0, realtime=False))
    driver.open()
    with RecordingWriter(path, driver.description) as writer:
        for frame in driver.frames():
            writer.append(frame)
    return path


def results(live: Pipeline, hub: Hub, path: Path) -> list[dict[str, Any]]:
    """What the streams say of a recording of tools, played as fast as it goes."""
    driver = ReplayDriver("sim", path, speed=None)
    live.set_tracking_config("sim", TrackingConfig(True, tools("strobed")))
    live.start_device("sim", driver, CALIBRATED)
    wait_for(lambda: live.status("sim").state == "ended")
    wait_for(lambda: messages(hub, "sim")[-1].get("state") == "ended")
    return [one for one in messages(hub, "sim") if one["type"] == "frame"]


@pytest.mark.slow
def test_results_are_those_of_one_process(make_pipeline: MakePipeline, recording: Path) -> None:
    hub, own = Hub(), Hub()
    far = results(make_pipeline(hub), hub, recording)
    manager = PipelineManager(own, "cpu")
    try:
        near = results(manager, own, recording)
    finally:
        manager.close()
    assert len(near) == 1000
    assert [one | {"n": 0} for one in far] == [one | {"n": 0} for one in near]
    assert any(tool["status"] == "OK" for one in far for tool in one["tools"])


class KeepingTap:
    """Keeps what it is given, and takes its time."""

    wants_pixels: Final = True

    def __init__(self, pause_s: float = 0.0) -> None:
        self.pause_s = pause_s
        self.events: list[ActiveCalibration | FrameBatch] = []

    def prepare(self, found: ActiveCalibration) -> None:
        self.events.append(found)

    def offer(self, batch: FrameBatch) -> None:
        time.sleep(self.pause_s)
        self.events.append(batch)

    @property
    def batches(self) -> list[FrameBatch]:
        return [one for one in self.events if isinstance(one, FrameBatch)]

    @property
    def frames(self) -> list[LineFrame]:
        return [frame for batch in self.batches for frame in batch.frames]


def test_tap_knows_what_each_batch_was_processed_with(
    pipeline: RemotePipeline, monkeypatch: pytest.MonkeyPatch
) -> None:
    pipeline.start_device("sim", SimulatedDriver("sim", LIVE), ActiveCalibration())
    device, tap = pipeline.session("sim"), KeepingTap()
    device.attach(tap)
    for name in ("first", "second", None):
        count = len(tap.batches)
        wait_for(lambda count=count: len(tap.batches) > count + 3)
        active = ActiveCalibration(name, CALIBRATED.calibration if name else None)
        pipeline.set_calibration("sim", active)
        assert pipeline.status("sim").calibration_id == name
    count = len(tap.batches)
    wait_for(lambda: len(tap.batches) > count + 3)
    device.detach(tap)
    seen = len(tap.events)
    known: list[str | None] = []
    for one in tap.events:
        if isinstance(one, ActiveCalibration):
            known.append(one.calibration_id)
        else:
            assert one.calibration_id == known[-1]
            assert all(frame.lines.shape == (4, 2048) for frame in one.frames)
    assert known == [None, "first", "second", None]
    # Without taps nobody wants pixels.
    later: list[BatchMessage] = []
    monkeypatch.setattr(BatchMessage, "drop_pixels", lambda message: later.append(message))
    wait_for(lambda: len(later) > 3 and later[-1].read().frames[-1].lines.size == 0)
    assert len(tap.events) == seen


def test_tap_that_fails_has_no_more_and_the_device_goes_on(pipeline: RemotePipeline) -> None:
    class Failing(KeepingTap):
        def offer(self, batch: FrameBatch) -> None:
            super().offer(batch)
            raise ValueError

    pipeline.start_device("sim", SimulatedDriver("sim", LIVE), CALIBRATED)
    device, failing, good = pipeline.session("sim"), Failing(), KeepingTap()
    device.attach(failing)
    device.attach(good)
    wait_for(lambda: len(good.batches) > 5)
    assert len(failing.batches) == 1
    assert device.connected


def refuse(description: DeviceDescription) -> None:
    raise InvalidParameter(f"not {description.name}", name=description.name)


@pytest.mark.slow
def test_errors_of_the_station_are_those_of_the_pipeline(
    pipeline: RemotePipeline, event_loop_thread: asyncio.AbstractEventLoop
) -> None:
    # What a call that failed has changed has come by, too, though the gateway has much to do.
    event_loop_thread.call_soon_threadsafe(time.sleep, 1.0)
    with pytest.raises(InvalidParameter, match="not sim") as caught:
        pipeline.start_device("sim", SimulatedDriver("sim", LIVE), CALIBRATED, refuse)
    assert caught.value.context == {"name": "sim"}
    status = pipeline.status("sim")
    assert (status.state, status.reason) == ("failed", "not sim")
    with pytest.raises(DeviceNotRunning):
        pipeline.session("sim")
    assert pipeline.status("other").state == "stopped"


def test_what_was_asked_for_has_happened(pipeline: RemotePipeline) -> None:
    """No call returns before what it caused can be seen here."""
    for _ in range(5):
        pipeline.start_device("sim", SimulatedDriver("sim", LIVE), CALIBRATED)
        assert pipeline.status("sim").state == "running"
        device = pipeline.session("sim")
        assert device.status().calibration_id == "nominal"
        assert device.search_model.fit is not None
        pipeline.stop_device("sim")
        assert pipeline.status("sim").state == "stopped"
        assert not device.connected
    assert messages(pipeline.streams, "sim")[-1]["state"] == "stopped"  # type: ignore[arg-type]


def test_state_is_not_waited_for_where_the_station_is_busy(
    pipeline: RemotePipeline, monkeypatch: pytest.MonkeyPatch
) -> None:
    pipeline.start_device("sim", SimulatedDriver("sim", LIVE), CALIBRATED)
    monkeypatch.setattr("service.station.remote_pipeline.REFRESH_S", 0.2)
    process_id = pipeline.stations[0].process_id
    os.kill(process_id, signal.SIGSTOP)
    try:
        began = time.monotonic()
        pipeline.refresh()
        assert time.monotonic() - began < 5.0
        assert pipeline.status("sim").state == "running"
    finally:
        os.kill(process_id, signal.SIGCONT)


def test_call_in_the_event_loop_is_refused(
    pipeline: RemotePipeline, event_loop_thread: asyncio.AbstractEventLoop
) -> None:
    async def call() -> None:
        pipeline.stop_device("sim")

    with pytest.raises(RuntimeError, match="stop_device waits for the event loop"):
        asyncio.run_coroutine_threadsafe(call(), event_loop_thread).result(WAIT_S)


@pytest.mark.slow
def test_a_source_that_can_wait_waits_for_a_slow_gateway(
    make_pipeline: MakePipeline, recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(station_process, "RING_BYTES", 4 << 20)
    live, tap = make_pipeline(Hub()), KeepingTap(pause_s=0.02)
    live.start_device("sim", ReplayDriver("sim", recording, speed=None), CALIBRATED)
    device = live.session("sim")
    device.attach(tap)
    wait_for(lambda: device.drained)
    first = tap.frames[0].sequence
    assert first < 600
    # Over 6 MB of pixels by a ring of 4.
    assert [frame.sequence for frame in tap.frames] == list(range(first, 1000))
    assert device.frames_dropped == 0


@pytest.mark.slow
def test_a_live_source_waits_for_nobody_and_what_is_missed_is_counted(
    make_pipeline: MakePipeline, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(station_process, "RING_BYTES", 4 << 20)
    live, tap = make_pipeline(Hub()), KeepingTap()
    live.start_device("sim", SimulatedDriver("sim", SimulationSettings()), CALIBRATED)
    device = live.session("sim")
    device.attach(tap)
    wait_for(lambda: len(tap.frames) > 10)
    tap.pause_s = 2.0  # the ring holds a quarter of a second
    count = len(tap.batches)
    wait_for(lambda: len(tap.batches) > count)
    tap.pause_s = 0.0
    count = len(tap.batches)
    wait_for(lambda: len(tap.batches) > count + 20)
    device.detach(tap)
    numbers = [frame.sequence for frame in tap.frames]
    missing = numbers[-1] - numbers[0] + 1 - len(numbers)
    assert missing > 500
    wait_for(lambda: live.status("sim").frames_lost + device.frames_dropped >= missing)
    assert live.stations[0].messages_missed > 0
    # What it is processed with may have been among what was missed, and was told again.
    assert sum(isinstance(one, ActiveCalibration) for one in tap.events) > 1
    known = [one for one in tap.events if isinstance(one, ActiveCalibration)]
    assert {one.calibration_id for one in known} == {"nominal"}


@pytest.fixture
def kept_log(caplog: pytest.LogCaptureFixture) -> Iterator[pytest.LogCaptureFixture]:
    with caplog.at_level(logging.INFO):
        yield caplog


@pytest.mark.slow
def test_lost_station_is_replaced_with_all_it_had(
    make_pipeline: MakePipeline, kept_log: pytest.LogCaptureFixture
) -> None:
    hub = Hub()
    live = make_pipeline(hub)
    watched = hold(CHEST, identity="chest")
    live.set_tracking_config("sim", TrackingConfig(True, holds=(watched,)))
    live.start_device("sim", SimulatedDriver("sim", LIVE), ActiveCalibration())
    live.start_device("ended", SimulatedDriver("ended", LIVE), CALIBRATED)
    live.stop_device("ended")
    live.set_calibration("sim", CALIBRATED)
    device, tap = live.session("sim"), KeepingTap()
    device.attach(tap)
    wait_for(lambda: tap.batches)
    lost = live.stations[0].process_id
    os.kill(lost, signal.SIGKILL)
    wait_for(lambda: live.stations[0].process_id != lost)
    assert not device.connected
    assert device.drained
    wait_for(lambda: live.status("sim").state == "running")
    assert live.status("sim").calibration_id == "nominal"
    assert live.status("ended").state == "stopped"
    again = live.session("sim")
    assert again is not device
    count = len(tap.batches)
    other = KeepingTap()
    again.attach(other)
    wait_for(lambda: len(other.batches) > 3)
    assert len(tap.batches) == count
    states = [
        (one["state"], one["reason"]) for one in messages(hub, "sim") if one["type"] == "state"
    ]
    why = "the process that owns the devices has ended (signal 9) and is started again"
    assert ("starting", why) in states
    assert states[-1] == ("running", None)
    now = live.holds.now("chest")
    assert now is not None
    assert now.held
    assert any(one["reason"] == why for one in messages(hub, "sim") if one["type"] == "hold")
    assert any(record.levelno == logging.CRITICAL for record in kept_log.records)


@pytest.mark.slow
def test_device_that_did_not_start_is_not_started_again(pipeline: RemotePipeline) -> None:
    with pytest.raises(InvalidParameter):
        pipeline.start_device("sim", SimulatedDriver("sim", LIVE), CALIBRATED, refuse)
    pipeline.start_device("other", SimulatedDriver("other", LIVE), CALIBRATED)
    os.kill(pipeline.stations[0].process_id, signal.SIGKILL)
    wait_for(
        lambda: pipeline.stations[0].restarts == 1 and pipeline.status("other").state == "running"
    )
    assert pipeline.status("sim").state == "stopped"


@pytest.mark.slow
def test_devices_of_a_lost_station_are_never_told_to_be_stopped(pipeline: RemotePipeline) -> None:
    for name in ("one", "two", "three"):
        pipeline.start_device(name, SimulatedDriver(name, LIVE), CALIBRATED)
    os.kill(pipeline.stations[0].process_id, signal.SIGKILL)
    seen = set()
    while pipeline.stations[0].restarts == 0 or seen_last(pipeline) != {"running"}:
        seen |= seen_last(pipeline)
        time.sleep(0.001)
    assert seen == {"running", "starting"}


def seen_last(pipeline: RemotePipeline) -> set[str]:
    return {pipeline.status(name).state for name in ("one", "two", "three")}


def waiting_at_the_first_restart(
    pipeline: RemotePipeline, monkeypatch: pytest.MonkeyPatch
) -> threading.Event:
    """Replace the station of devices "one" and "two", up to the first; return what lets it go on.

    The new station is there, and neither device is started at it.
    """
    for name in ("one", "two"):
        pipeline.start_device(name, SimulatedDriver(name, LIVE), CALIBRATED)
    first_again, go_on = threading.Event(), threading.Event()
    call = RemotePipeline.call

    def wait_at_the_first(self: RemotePipeline, method: str, *args: Any, **members: Any) -> Any:
        if method == "start_device" and threading.current_thread().name == "station-lost":
            first_again.set()
            go_on.wait(WAIT_S)
        return call(self, method, *args, **members)

    monkeypatch.setattr(RemotePipeline, "call", wait_at_the_first)
    os.kill(pipeline.stations[0].process_id, signal.SIGKILL)
    assert first_again.wait(WAIT_S)
    return go_on


def test_device_that_is_stopped_while_its_station_is_replaced_stays_stopped(
    pipeline: RemotePipeline, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on = waiting_at_the_first_restart(pipeline, monkeypatch)
    pipeline.stop_device("two")
    assert pipeline.status("two").state == "stopped"
    pipeline.set_tracking_config("two", TrackingConfig(True))
    go_on.set()
    wait_for(lambda: pipeline.status("one").state == "running")
    pipeline.refresh()
    assert pipeline.status("two").state == "stopped"
    assert pipeline.call("last_sequence", "one") >= -1
    with pytest.raises(DeviceNotRunning):
        pipeline.call("last_sequence", "two")


def test_changes_without_a_station_reach_the_next_one(
    pipeline: RemotePipeline, monkeypatch: pytest.MonkeyPatch
) -> None:
    pipeline.start_device("sim", SimulatedDriver("sim", LIVE), ActiveCalibration())
    lost, go_on = threading.Event(), threading.Event()
    replace_station = RemotePipeline._replace

    def later(self: RemotePipeline) -> bool:
        lost.set()
        go_on.wait(WAIT_S)
        return replace_station(self)

    monkeypatch.setattr(RemotePipeline, "_replace", later)
    os.kill(pipeline.stations[0].process_id, signal.SIGKILL)
    assert lost.wait(WAIT_S)
    pipeline.set_calibration("sim", CALIBRATED)
    pipeline.set_tracking_config("sim", TrackingConfig(True))
    go_on.set()
    wait_for(lambda: pipeline.status("sim").state == "running")
    assert pipeline.status("sim").calibration_id == "nominal"
    assert pipeline.tracked("sim").tracks


@pytest.mark.slow
def test_station_that_cannot_be_started_is_tried_again(
    pipeline: RemotePipeline, monkeypatch: pytest.MonkeyPatch, kept_log: pytest.LogCaptureFixture
) -> None:
    pipeline.start_device("sim", SimulatedDriver("sim", LIVE), CALIBRATED)
    start, refused = StationStarter.start, []

    def refuse_once(self: StationStarter, descriptors: Any) -> int:
        if not refused:
            refused.append(descriptors)
            raise OSError("no memory")
        return start(self, descriptors)

    monkeypatch.setattr(StationStarter, "start", refuse_once)
    os.kill(pipeline.stations[0].process_id, signal.SIGKILL)
    wait_for(
        lambda: pipeline.stations[0].restarts == 1 and pipeline.status("sim").state == "running"
    )
    assert refused
    assert "no other station can be started now: no memory" in kept_log.text


@pytest.fixture
def without_station(
    make_pipeline: MakePipeline, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[[Hub], tuple[RemotePipeline, Callable[[], None]]]]:
    """Makes pipelines with a device "sim" whose station has ended; what lets the next one come."""
    go_on = threading.Event()
    replace_station = RemotePipeline._replace

    def later(self: RemotePipeline) -> bool:
        go_on.wait(WAIT_S)
        return replace_station(self)

    monkeypatch.setattr(RemotePipeline, "_replace", later)

    def make(hub: Hub) -> tuple[RemotePipeline, Callable[[], None]]:
        live = make_pipeline(hub)
        watched = TrackingConfig(True, holds=(hold(CHEST, identity="chest"),))
        live.set_tracking_config("sim", watched)
        live.start_device("sim", SimulatedDriver("sim", LIVE), CALIBRATED)
        os.kill(live.stations[0].process_id, signal.SIGKILL)
        wait_for(lambda: live.status("sim").state == "starting")
        return live, go_on.set

    yield make
    go_on.set()


NoStation = Callable[[Hub], tuple[RemotePipeline, Callable[[], None]]]


def states(hub: Hub) -> list[str]:
    return [one["state"] for one in messages(hub, "sim") if one["type"] == "state"]


def test_stop_without_a_station_is_told_to_clients(without_station: NoStation) -> None:
    hub = Hub()
    live, go_on = without_station(hub)
    live.stop_device("sim")
    assert live.status("sim").state == "stopped"
    go_on()
    wait_for(lambda: states(hub)[-1] == "stopped")
    live.refresh()
    assert live.status("sim").state == "stopped"


def test_stop_that_a_station_dies_of_is_told_to_clients(make_pipeline: MakePipeline) -> None:
    hub = Hub()
    live = make_pipeline(hub)
    live.start_device("sim", SimulatedDriver("sim", LIVE), CALIBRATED)
    os.kill(live.stations[0].process_id, signal.SIGSTOP)
    stop = threading.Thread(target=live.stop_device, args=["sim"])
    stop.start()
    wait_for(lambda: "sim" not in live._started)
    os.kill(live.stations[0].process_id, signal.SIGKILL)
    stop.join(WAIT_S)
    assert live.status("sim").state == "stopped"
    assert states(hub)[-1] == "stopped"


def test_device_deleted_without_a_station_ends_its_streams_and_holds(
    without_station: NoStation,
) -> None:
    hub = Hub()
    live, go_on = without_station(hub)
    live.forget_device("sim")
    wait_for(lambda: "sim" not in hub.logs())
    assert live.holds.of_device("sim") == ()
    go_on()
    wait_for(lambda: live.ready)
    live.start_device("other", SimulatedDriver("other", LIVE), CALIBRATED)
    assert "sim" not in hub.logs()
    assert live.status("sim").state == "stopped"


def test_hold_deleted_without_a_station_is_told_to_be_the_last(without_station: NoStation) -> None:
    hub = Hub()
    live, go_on = without_station(hub)
    told: list[tuple[str, bool]] = []
    live.holds.listen(lambda _, now, last: told.append((now.hold_id, last)))
    live.set_tracking_config("sim", TrackingConfig(True))
    go_on()
    wait_for(lambda: live.status("sim").state == "running")
    assert told[-1] == ("chest", True)
    assert live.holds.now("chest") is None


def test_device_that_was_started_at_the_new_station_goes_on(
    pipeline: RemotePipeline, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on = waiting_at_the_first_restart(pipeline, monkeypatch)
    pipeline.start_device("two", SimulatedDriver("two", LIVE), CALIBRATED)
    device = pipeline.session("two")
    go_on.set()
    wait_for(lambda: pipeline.status("one").state == "running")
    pipeline.refresh()
    assert pipeline.session("two") is device
    assert device.running


def test_configuration_that_is_refused_keeps_no_device_from_its_restart(
    pipeline: RemotePipeline, monkeypatch: pytest.MonkeyPatch, kept_log: pytest.LogCaptureFixture
) -> None:
    pipeline.set_tracking_config("sim", TrackingConfig(True))
    pipeline.start_device("sim", SimulatedDriver("sim", LIVE), CALIBRATED)
    call = RemotePipeline.call

    def refuse_configuration(self: RemotePipeline, method: str, *args: Any, **more: Any) -> Any:
        if method == "set_tracking_config":
            raise InvalidParameter("no such tool")
        return call(self, method, *args, **more)

    monkeypatch.setattr(RemotePipeline, "call", refuse_configuration)
    os.kill(pipeline.stations[0].process_id, signal.SIGKILL)
    wait_for(
        lambda: pipeline.stations[0].restarts == 1 and pipeline.status("sim").state == "running"
    )
    assert "does not follow its tools as before" in kept_log.text


def test_tap_that_is_detached_before_it_is_prepared_again_holds_up_no_other(
    pipeline: RemotePipeline,
) -> None:
    pipeline.start_device("sim", SimulatedDriver("sim", LIVE), CALIBRATED)
    device, taps = pipeline.session("sim"), (KeepingTap(), KeepingTap())
    for tap in taps:
        device.attach(tap)
    wait_for(lambda: all(tap.batches for tap in taps))
    with device._lock:
        device.interrupt()
        numbers = {one.tap: number for number, one in device.taps.items()}
        device.prepare(numbers[taps[0]], CALIBRATED)
        device.detach(taps[1])
        count = len(taps[0].batches)
    wait_for(lambda: len(taps[0].batches) > count)


@pytest.mark.parametrize("times", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_station_comes_back_when_what_forks_stations_ends_again_and_again(
    pipeline: RemotePipeline, monkeypatch: pytest.MonkeyPatch, times: int
) -> None:
    pipeline.start_device("sim", SimulatedDriver("sim", LIVE), CALIBRATED)
    start, failed = StationStarter._start, []

    def fail_first(self: StationStarter, descriptors: Any) -> int:
        if len(failed) < times:
            failed.append(descriptors)
            raise EOFError
        return start(self, descriptors)

    monkeypatch.setattr(StationStarter, "_start", fail_first)
    os.kill(pipeline.stations[0].process_id, signal.SIGKILL)
    wait_for(
        lambda: pipeline.stations[0].restarts == 1 and pipeline.status("sim").state == "running"
    )
    assert len(failed) == times


def test_starter_that_is_gone_is_replaced(
    make_pipeline: MakePipeline, starter: StationStarter
) -> None:
    live = make_pipeline(Hub())
    live.start_device("sim", SimulatedDriver("sim", LIVE), CALIBRATED)
    assert starter._process is not None
    os.kill(starter._process.pid, signal.SIGKILL)
    os.kill(live.stations[0].process_id, signal.SIGKILL)
    wait_for(lambda: live.stations[0].restarts == 1 and live.status("sim").state == "running")


def test_call_to_a_lost_station_is_told_to_come_again(pipeline: RemotePipeline) -> None:
    pipeline.start_device("sim", SimulatedDriver("sim", LIVE), CALIBRATED)
    os.kill(pipeline.stations[0].process_id, signal.SIGSTOP)
    caught: list[BaseException] = []

    def ask() -> None:
        try:
            pipeline.call("last_sequence", "sim")
        except NotReady as error:
            caught.append(error)

    thread = threading.Thread(target=ask)
    thread.start()
    time.sleep(0.2)
    os.kill(pipeline.stations[0].process_id, signal.SIGKILL)
    thread.join(WAIT_S)
    assert "is started again; try again" in str(caught[0])


def test_pipeline_that_is_closed_as_its_station_is_lost_releases_each_station_once(
    make_pipeline: MakePipeline, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Descriptors closed twice may be others' by then."""
    released: list[StationProcess] = []
    release = StationProcess.release

    def count(station: StationProcess) -> None:
        released.append(station)
        release(station)

    monkeypatch.setattr(StationProcess, "release", count)
    told = threading.Event()
    hub = Hub()
    live = make_pipeline(hub)
    monkeypatch.setattr(live.holds, "fail", lambda _: told.set())
    os.kill(live.stations[0].process_id, signal.SIGKILL)
    assert told.wait(WAIT_S)
    live.close()
    assert len(released) == len(set(released)) >= 1


def test_lines_of_the_stations_log_come_here(
    pipeline: RemotePipeline, kept_log: pytest.LogCaptureFixture
) -> None:
    with pytest.raises(RuntimeError, match="KeyError"):
        pipeline.start_device(
            "sim", SimulatedDriver("sim", LIVE), CALIBRATED, partial(dict.__getitem__, {})
        )
    wait_for(lambda: any("start_device failed" in one.message for one in kept_log.records))
    [record] = [one for one in kept_log.records if "start_device failed" in one.message]
    assert record.name == "service.station.process"
    assert "KeyError" in str(record.exc_text)


class HangingDriver(SimulatedDriver):
    """Does not come back from being opened."""

    def open(self) -> None:
        time.sleep(3600.0)


_GATEWAY = """
import asyncio, signal, sys, threading, time
from service.pipeline.detection_stage import built_in_profile
from service.protocols.stream.hub import Hub
from service.station.bus_messages import BatchMessage
from service.station.remote_pipeline import RemotePipeline
from service.station.station_process import StationProcess
from service.station.station_starter import StationStarter

# Who starts a shell's job in the background lets it ignore this one.
signal.signal(signal.SIGINT, signal.default_int_handler)

async def main():
    live = RemotePipeline(Hub(), StationStarter(), "cpu", built_in_profile)
    while not live.ready:
        await asyncio.sleep(0.02)
    if "hangs" in sys.argv:
        from tests.service.station.test_remote_pipeline import LIVE, HangingDriver
        driver = HangingDriver("sim", LIVE)
        threading.Thread(target=live.start_device, args=("sim", driver), daemon=True).start()
        while live.status("sim").state != "starting":
            await asyncio.sleep(0.02)
    print(live.stations[0].process_id, flush=True)
    await asyncio.sleep(600)

asyncio.run(main())
"""


def is_there(process_id: int) -> bool:
    """Whether a process runs; one that has ended may wait for whoever inherits it."""
    try:
        state = Path(f"/proc/{process_id}/stat").read_text(encoding="ascii").split(") ")[1][0]
    except (OSError, IndexError):
        return False
    return state not in "ZX"


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="no /proc on this machine")
@pytest.mark.parametrize(
    ("how", "device"),
    [
        (signal.SIGKILL, ""),
        (signal.SIGINT, ""),
        pytest.param(signal.SIGKILL, "hangs", marks=pytest.mark.slow),
    ],
)
def test_station_ends_with_its_gateway(how: signal.Signals, device: str) -> None:
    gateway = subprocess.Popen(
        [sys.executable, "-c", _GATEWAY, device], stdout=subprocess.PIPE, start_new_session=True
    )
    assert gateway.stdout is not None
    station = int(gateway.stdout.readline())
    assert is_there(station)
    try:
        os.killpg(gateway.pid, how) if how == signal.SIGINT else gateway.kill()
        gateway.wait(WAIT_S)
        wait_for(lambda: not is_there(station))
    finally:
        gateway.kill()
        gateway.wait(WAIT_S)
        gateway.stdout.close()
