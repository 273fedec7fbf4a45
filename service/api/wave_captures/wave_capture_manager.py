"""WaveCaptureManager: threads that take poses of waved targets from running devices."""

import logging
import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from threading import Event, Lock, Thread
from typing import Final

import numpy as np

from compute.calibration.self_calibration.strobed_poses import PoseCounts, StrobedPoseCollector
from compute.calibration.self_calibration.targets import CalibrationTarget, Recording, Wand
from compute.calibration.self_calibration.uncalibrated_start import (
    UncalibratedStart,
    uncalibrated_start,
)
from compute.calibration.self_calibration.wave_coverage import (
    DIRECTION_RINGS,
    FIRST_CAMERAS_POSES,
    GROWTH,
    MIN_CELL_READINGS,
    MIN_DIRECTION_POSES,
    WaveCoverage,
    wave_coverage,
)
from compute.camera.model import SensorGeometry, SensorModel
from compute.errors import LumilineError
from service.api.quality.point_tap import check_strobed
from service.api.wave_captures.exposure_tap import ExposureTap
from service.api.wave_captures.schema import (
    MAX_POSES,
    WaveDirections,
    WaveExposures,
    WaveProgress,
    WaveSensor,
    WaveSettings,
    WaveVolume,
)
from service.api.wave_captures.store import WAVE_CAPTURES, keep_wave
from service.api.wave_captures.stored_wave import StoredWave
from service.database.engine import Database
from service.jobs.call_process import CallProcess
from service.pipeline.interface import Pipeline, RunningDevice
from service.pipeline.tap_collection import collect
from service.problems.errors import Busy, NotReady

_log = logging.getLogger(__name__)

CHECK_INTERVAL_S: Final = 0.5
"""Time between two judgements of the coverage [s]."""
CAMERAS_TIMEOUT_S: Final = 60.0
_MEMORY_BYTES: Final = 4 * 1024**3
_PEAK_BYTES: Final = 1024**3
_JOIN_S: Final = 30.0
_STOPPED: Final = "the server stopped; the poses so far are kept"


@dataclass(frozen=True)
class WaveTask:
    """Task of a wave capture: the device, the target, and when it ends.

    Args:
        capture_id: the session.
        device_id: its device.
        sensors: names and pixels, in order.
        target: what is waved.
        markers: its strobed markers.
        settings: when it ends.
        models: approximate cameras to judge by; None: computed from the readings.
    """

    capture_id: str
    device_id: str
    sensors: tuple[SensorGeometry, ...]
    target: CalibrationTarget
    markers: tuple[int, ...]
    settings: WaveSettings
    models: tuple[SensorModel, ...] | None


class WaveCaptureManager:
    """Takes poses of waved targets, of each device for one session at a time.

    Args:
        database: where what was taken is stored at the end.
        live: the live pipeline.
    """

    def __init__(self, database: Database, live: Pipeline) -> None:
        self._database = database
        self._live = live
        self._waves: dict[str, _Wave] = {}
        self._lock = Lock()
        self._closed = False
        self._process = CallProcess(_MEMORY_BYTES, _PEAK_BYTES)
        self._pool = ThreadPoolExecutor(1, "wave-cameras")

    def start(self, task: WaveTask) -> WaveProgress:
        """Take poses from now on, until enough, the end of the time, or ``stop``.

        Raises:
            UnknownWaveCapture: the session was deleted meanwhile.
            DeviceNotRunning: the device does not run.
            InvalidParameter: it does not strobe the target's markers.
            Busy: poses of this device are being taken already.
        """
        running = self._live.session(task.device_id)
        check_strobed(task.device_id, task.markers, running.description.markers)
        with self._lock:
            if self._closed:
                raise NotReady("the server stops; start it again when it is up", part="server")
            for other in self._waves.values():
                if other.task.device_id == task.device_id and other.alive:
                    raise Busy(
                        f'session "{other.task.capture_id}" takes poses of device '
                        f'"{task.device_id}"; stop it first'
                    )
            # Not before: a wave that ended just now has stored its poses.
            with self._database.read() as session:
                row = WAVE_CAPTURES.get(session, task.capture_id)
                stored = StoredWave.unpack(row.data)
            wave = _Wave(task, stored, self, running)
            self._waves[task.capture_id] = wave
            wave.start()
        return wave.progress

    def progress(self, capture_id: str) -> WaveProgress | None:
        """Return what is covered; None: no poses of this session are being taken."""
        wave = self._waves.get(capture_id)
        return wave.progress if wave is not None and wave.alive else None

    def stop(self, capture_id: str, reason: str = "stopped") -> None:
        """End the taking of poses and store what there is; nothing happens when none are taken."""
        wave = self._waves.get(capture_id)
        if wave is not None:
            wave.end(reason)

    def discard(self, capture_id: str) -> None:
        """End the taking of poses and store nothing."""
        wave = self._waves.pop(capture_id, None)
        if wave is not None:
            wave.end(None)

    def close(self) -> None:
        """Store what there is of all sessions, and end."""
        with self._lock:
            self._closed = True
        for name in tuple(self._waves):
            self.stop(name, _STOPPED)
        self._pool.shutdown(wait=False, cancel_futures=True)
        self._process.close()

    def compute_cameras(self, task: WaveTask, recording: Recording) -> "Future[UncalibratedStart]":
        """Compute cameras from the readings so far, in a process of their own."""
        return self._pool.submit(
            self._process.call,
            uncalibrated_start,
            list(task.sensors),
            [recording],
            timeout_s=CAMERAS_TIMEOUT_S,
        )

    def collect(self, wave: "_Wave") -> None:
        """Attach a wave's tap until it ends."""
        collect(
            self._live, wave.running, wave.tap, wave.task.settings.duration_s, wave.tap.ended,
            wave.poll,
        )  # fmt: skip

    def forget(self, wave: "_Wave") -> None:
        """Drop a wave that has ended."""
        with self._lock:
            if self._waves.get(wave.task.capture_id) is wave:
                del self._waves[wave.task.capture_id]

    def store(self, wave: "_Wave") -> None:
        """Store what a wave has taken."""
        with self._database.write() as session:
            keep_wave(session, wave.task.capture_id, wave.taken(), wave.progress, wave.reason)


class _Wave:
    """The thread that takes the poses of one session."""

    def __init__(
        self,
        task: WaveTask,
        stored: StoredWave,
        manager: WaveCaptureManager,
        running: RunningDevice,
    ) -> None:
        self.task = task
        self.stored = stored
        """What was taken before."""
        self.running = running
        self.tap = ExposureTap(running.last_sequence, task.markers, len(task.sensors))
        self.reason = ""
        self._manager = manager
        self._collector = StrobedPoseCollector(
            task.markers,
            [sensor.pixels for sensor in task.sensors],
            PoseCounts(*stored.counts),
        )
        self._collector.restore(stored.readings_px, stored.sigma_px)
        self._models = task.models
        self._cameras: Future[UncalibratedStart] | None = None
        self._cameras_due = FIRST_CAMERAS_POSES
        self._check_due_s = 0.0
        self._kept = True
        self._done = Event()
        self.progress = self._check_sufficiency()
        """What is covered; replaced by the thread."""
        name = f"wave-{task.capture_id}"
        self._thread = Thread(target=self._run, name=name, daemon=True)

    @property
    def alive(self) -> bool:
        """Whether poses are still taken, or being stored."""
        return not self._done.is_set()

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def end(self, reason: str | None) -> None:
        """End it and wait until that is done; ``reason`` None: what was taken is not stored."""
        if reason is None:
            self._kept = False
        self.reason = self.reason or reason or ""
        self.tap.ended.set()
        self._thread.join(_JOIN_S)

    def taken(self) -> StoredWave:
        """Return all poses, and the counts."""
        counts = self._collector.counts
        return StoredWave(
            *self._collector.poses(),
            (counts.taken, counts.still, counts.too_few_sensors, counts.not_lit),
            self._visibility_counts(),
        )

    def poll(self) -> bool:
        """Take the exposures that wait; return whether there are enough of them."""
        self._collector.add(self.tap.take())
        now = time.monotonic()
        if now < self._check_due_s:
            return False
        self._check_due_s = now + CHECK_INTERVAL_S
        self.progress = self._check_sufficiency()
        if self._collector.counts.taken >= MAX_POSES:
            self.reason = f"{MAX_POSES} poses are the most that a session takes"
            return True
        if self.progress.enough and self.task.settings.end_when_enough:
            self.reason = "enough"
            return True
        return False

    def _run(self) -> None:
        try:
            self._manager.collect(self)
            self._collector.add(self.tap.take())
            self.reason = self.reason or f"{self.task.settings.duration_s:g} s were over"
        except NotReady:
            self.reason = self.reason or _STOPPED
        except LumilineError as error:
            self.reason = self.reason or error.detail
        except Exception as error:  # noqa: BLE001 - of this session, not of the server
            self.reason = f"it failed: {type(error).__name__}"
            _log.exception("wave capture %s failed", self.task.capture_id)
        try:
            self.progress = self._check_sufficiency()
            if self._kept:
                self._manager.store(self)
        except Exception:  # noqa: BLE001 - nobody waits for the thread's errors
            _log.exception("poses of wave capture %s could not be stored", self.task.capture_id)
        finally:
            self._done.set()
            self._manager.forget(self)

    def _check_sufficiency(self) -> WaveProgress:
        recording = Recording(self.task.target, self._collector.poses()[0])
        coverage = wave_coverage(
            self.task.sensors, recording, self._approximate_cameras(recording, len(self._collector))
        )
        return progress_of(coverage, self._collector.counts, self._visibility_counts())

    def _approximate_cameras(
        self, recording: Recording, poses: int
    ) -> tuple[SensorModel, ...] | None:
        if self.task.models is not None or not isinstance(self.task.target, Wand):
            return self.task.models
        if self._cameras is not None and self._cameras.done():
            # Where the readings are not enough yet, or the process failed, the next time tells.
            if not self._cameras.cancelled() and self._cameras.exception() is None:
                self._models = self._cameras.result().models
            self._cameras = None
        if self._cameras is None and poses >= self._cameras_due and not self.tap.ended.is_set():
            self._cameras_due = int(GROWTH * poses)
            self._cameras = self._manager.compute_cameras(self.task, recording)
        return self._models

    def _visibility_counts(self) -> np.ndarray:
        return self.stored.seen + self.tap.seen


def progress_of(coverage: WaveCoverage, counts: PoseCounts, seen: np.ndarray) -> WaveProgress:
    """Return coverage as clients receive it.

    Args:
        coverage: of the poses.
        counts: what became of the exposures.
        seen: exposures of each sensor with a clear peak, an unclear one, none, shape (3, S).
    """
    directions = volume = None
    if coverage.directions is not None and coverage.direction_bins is not None:
        directions = WaveDirections(
            rms=coverage.directions,
            rings=list(DIRECTION_RINGS),
            bins=list(coverage.direction_bins),
            wanted=MIN_DIRECTION_POSES,
        )
    if coverage.extent_mm is not None and coverage.octants is not None:
        volume = WaveVolume(extent_mm=coverage.extent_mm, octants=list(coverage.octants))
    return WaveProgress(
        poses=coverage.poses,
        wanted_poses=coverage.wanted_poses,
        exposures=WaveExposures(
            all=counts.all,
            taken=counts.taken,
            still=counts.still,
            too_few_sensors=counts.too_few_sensors,
            not_lit=counts.not_lit,
        ),
        sensors=[
            WaveSensor(
                sensor=one.sensor,
                clear=clear,
                unclear=unclear,
                unseen=unseen,
                readings=one.readings,
                cells=list(one.cells),
                wanted=MIN_CELL_READINGS,
                covered=one.covered,
            )
            for one, (clear, unclear, unseen) in zip(coverage.sensors, seen.T.tolist(), strict=True)
        ],
        directions=directions,
        volume=volume,
        missing=list(coverage.missing),
        enough=coverage.enough,
    )


def approximate_models(
    models: Sequence[SensorModel] | None, sensors: Sequence[SensorGeometry]
) -> tuple[SensorModel, ...] | None:
    """Return approximate cameras for the coverage, where they are of these sensors; else None."""
    if models is None:
        return None
    ours = [(sensor.name, sensor.pixels) for sensor in sensors]
    return tuple(models) if [(one.name, one.pixels) for one in models] == ours else None
