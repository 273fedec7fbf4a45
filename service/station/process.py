"""The station's process: devices, their threads, beam holds, and the writer's end of the bus.

It has three descriptors of its gateway: a socket for calls, the memory of the ring, and its
doorbell. It ends when the socket does. Nothing here serves clients, reads the database or files.
"""

import contextlib
import gc
import logging
import os
import pickle
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Lock, Thread
from typing import TYPE_CHECKING, Any, Final

from compute.errors import LumilineError
from hardware.driver import DeviceDescription, Driver
from service.logs import DEVICE
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.detection_stage import SearchModel
from service.pipeline.frame_batch import BeamHoldState, FrameBatch, PoseEntry
from service.pipeline.interface import Accept
from service.pipeline.pipeline_manager import PipelineManager
from service.pipeline.tracking_config import TrackingConfig
from service.problems.errors import DeviceNotRunning
from service.station.bus_messages import (
    DeviceFigures,
    StationFigures,
    batch_message,
    calibration_message,
    end_message,
    figures_message,
    hold_message,
    poses_message,
    state_message,
)
from service.station.calls import Answer, Call, LogLine, Start
from service.station.shared_ring import Doorbell, RingWriter

if TYPE_CHECKING:
    from service.pipeline.device_session import DeviceSession

_log = logging.getLogger(__name__)

FIGURES_S: Final = 0.5
"""Time between two messages with a station's figures."""
_SWITCH_S: Final = 5e-4
"""How long a thread may keep the interpreter from another: a frame waits for it at most."""
END_WITHIN_S: Final = 8.0
"""Until a station whose gateway has ended, and whose devices do not, ends all the same."""
_CALLS: Final = 8
"""Calls at a time: the start of a device may take seconds, and keeps no other waiting."""


@dataclass(frozen=True, eq=False)
class VersionedCalibration(ActiveCalibration):
    """A calibration with the number that the gateway knows it by."""

    version: int = 0


class BusPublisher:
    """StreamPublisher of a station: puts everything on the bus, in order."""

    closed: str | None = None

    def __init__(self, ring: RingWriter, doorbell: int) -> None:
        self._ring = ring
        self._doorbell = doorbell
        self.generations: dict[str, int] = {}
        """Number of each device's newest start."""
        self._pixel_taps: dict[str, int] = {}
        """Taps of each device that want pixels."""
        self._pixels_lock = Lock()
        """Held until a batch is on the bus: a tap that wants pixels comes before it or behind."""
        self.clients: dict[str, int] = {}
        """Clients of each device at the gateway."""
        self.figures: Callable[[], StationFigures] | None = None
        """Figures that go before each change of a state."""
        self._figures_lock = Lock()

    @property
    def congested(self) -> bool:
        """Whether the gateway is so far behind that sources that can wait have to."""
        return self._ring.behind > self._ring.capacity // 2

    def put(self, message: bytes) -> None:
        """Put a message on the bus, and wake its readers."""
        self._ring.write(message)
        Doorbell.ring(self._doorbell)

    @property
    def head(self) -> int:
        """Position behind the newest message."""
        return self._ring.head

    def publish_batch(self, batch: FrameBatch) -> None:
        """Put a batch of frames on the bus."""
        with self._pixels_lock:
            pixels = bool(self._pixel_taps.get(batch.device_id))
            self.put(batch_message(batch, pixels=pixels))

    def count_pixel_taps(self, device_id: str, more: int) -> None:
        """Note that so many more taps of a device want pixels, from the next batch on."""
        with self._pixels_lock:
            self._pixel_taps[device_id] = self._pixel_taps.get(device_id, 0) + more

    def publish_status(
        self,
        device_id: str,
        state: str,
        reason: str | None = None,
        link: str | None = None,
        description: DeviceDescription | None = None,
    ) -> None:
        """Put a device's state on the bus, behind the figures that agree with it."""
        if state == "starting":
            self.generations[device_id] = self.generations.get(device_id, 0) + 1
        self.publish_figures()
        self.put(state_message(device_id, state, reason, link, description))

    def publish_figures(self) -> None:
        """Put the figures of all devices on the bus."""
        if self.figures is not None:
            # Together: older ones must not come after newer ones.
            with self._figures_lock:
                self.put(figures_message(self.figures()))

    def publish_hold(self, device_id: str, now: BeamHoldState) -> None:
        """Do nothing: the listener of the registry also knows which change is the last."""

    def put_poses(self, entry: PoseEntry) -> None:
        """Put the newest poses of a device on the bus."""
        self.put(poses_message(entry))

    def put_hold(self, device_id: str, now: BeamHoldState, last: bool) -> None:
        """Put a change of a beam hold on the bus; a ``Listener`` of the registry."""
        self.put(hold_message(device_id, now, last=last))

    def subscribers(self, device_id: str) -> int:
        """Return the number of clients of a device."""
        return self.clients.get(device_id, 0)

    def end(self, device_id: str) -> None:
        """Put on the bus that a device was deleted."""
        self.publish_figures()
        self.put(end_message(device_id))


class BusTap:
    """Stands for a tap at the gateway: tells it what the batches are processed with."""

    def __init__(self, publisher: BusPublisher, tap: int, *, wants_pixels: bool) -> None:
        self.wants_pixels = wants_pixels
        self._publisher = publisher
        self._tap = tap

    def prepare(self, found: ActiveCalibration) -> None:
        """Tell it before the first batch that is processed with this."""
        version = found.version if isinstance(found, VersionedCalibration) else 0
        self._publisher.put(calibration_message(self._tap, version, found.bad_pixels))

    def offer(self, batch: FrameBatch) -> None:
        """Do nothing: it has the batch from the bus."""


class Station:
    """What the gateway calls, by name; all of it may be called from any thread.

    Args:
        ring: takes the messages.
        doorbell: descriptor by which its reader is woken.
        start: what the gateway says at the beginning.
    """

    def __init__(self, ring: RingWriter, doorbell: int, start: Start) -> None:
        self._publisher = BusPublisher(ring, doorbell)
        self._manager = PipelineManager(self._publisher, start.compute_device, start.find_profile)
        self._taps: dict[int, tuple[DeviceSession, BusTap]] = {}
        self._lock = Lock()
        self._manager.holds.listen(self._publisher.put_hold)
        self._manager.poses.call_at_once(self._publisher.put_poses)
        self._publisher.figures = self._figures
        self._ended = threading.Event()
        self._figures_thread = Thread(
            target=self._keep_publishing_figures, name="figures", daemon=True
        )
        self._figures_thread.start()

    @property
    def head(self) -> int:
        """Position behind the newest message of the bus."""
        return self._publisher.head

    def publish_figures(self) -> None:
        """Put the figures of all devices on the bus."""
        self._publisher.publish_figures()

    def close(self) -> None:
        """Stop all devices."""
        self._ended.set()
        self._manager.close()

    def start_device(
        self,
        device_id: str,
        driver: bytes,
        active: ActiveCalibration,
        version: int,
        accept: Accept,
    ) -> DeviceDescription | None:
        """Start a device with a pickled driver; arguments else as of ``Pipeline``."""
        opened: Driver = pickle.loads(driver)  # noqa: S301 - from our own parent process
        with _collected():
            return self._manager.start_device(
                device_id, opened, _versioned(active, version), accept
            )

    def stop_device(self, device_id: str) -> None:
        """As of ``Pipeline``."""
        with _collected():
            self._manager.stop_device(device_id)

    def forget_device(self, device_id: str) -> None:
        """As of ``Pipeline``."""
        self._manager.forget_device(device_id)

    def set_calibration(self, device_id: str, active: ActiveCalibration, version: int) -> None:
        """As of ``Pipeline``, with the number that the gateway knows the calibration by."""
        self._manager.set_calibration(device_id, _versioned(active, version))

    def set_tracking_config(self, device_id: str, tracked: TrackingConfig) -> None:
        """As of ``Pipeline``."""
        self._manager.set_tracking_config(device_id, tracked)

    def attach(
        self, device_id: str, generation: int, tap: int, *, sampled: bool, pixels: bool
    ) -> None:
        """Tell a tap what batches are processed with; ``pixels``: let them have their pixels.

        Raises:
            DeviceNotRunning: the device was started again since.
        """
        session = self._manager.session(device_id)
        if self._publisher.generations.get(device_id) != generation:
            raise DeviceNotRunning(
                f'device "{device_id}" was started again meanwhile; try again', device_id=device_id
            )
        with self._lock:
            self._publisher.count_pixel_taps(device_id, int(pixels))
            bus_tap = BusTap(self._publisher, tap, wants_pixels=pixels)
            self._taps[tap] = session, bus_tap
        session.attach(bus_tap, sampled=sampled)

    def detach(self, tap: int) -> None:
        """End what ``attach`` began."""
        with self._lock:
            session, bus_tap = self._taps.pop(tap, (None, None))
            if session is None or bus_tap is None:
                return
            self._publisher.count_pixel_taps(session.device_id, -int(bus_tap.wants_pixels))
        session.detach(bus_tap)

    def resynchronise(self) -> None:
        """Say again what the gateway may have missed: states, holds, what batches are made with."""
        # First: batches of a device that was started again are for nobody of before.
        self._publisher.publish_figures()
        self._manager.holds.listen(self._publisher.put_hold)()
        with self._lock:
            taps = list(self._taps.values())
        for session, tap in taps:
            session.repeat_calibration(tap)
        for device_id, status in self._manager.statuses().items():
            known = self._manager.known_session(device_id)
            if known is not None and known.reader is not None:
                known.publish_status()
            else:
                self._publisher.put(state_message(device_id, status.state, status.reason))

    def set_clients(self, device_id: str, clients: int) -> None:
        """Take how many clients of a device there are."""
        self._publisher.clients[device_id] = clients

    def search_model(self, device_id: str) -> SearchModel:
        """Return what a running device's peaks are found with; raises DeviceNotRunning."""
        return self._manager.session(device_id).search_model

    def last_sequence(self, device_id: str) -> int:
        """Return the number of a running device's newest frame; raises DeviceNotRunning."""
        return self._manager.session(device_id).last_sequence

    def refresh(self) -> None:
        """Do nothing: figures go before each answer."""

    def acknowledge(self, hold_id: str) -> bool:
        """End the latch of a hold; return whether there is one."""
        return self._manager.holds.acknowledge(hold_id) is not None

    def set_up(self, reference_id: str) -> None:
        """As of ``BeamHolds``."""
        self._manager.holds.set_up(reference_id)

    def _keep_publishing_figures(self) -> None:
        while not self._ended.wait(FIGURES_S):
            try:
                self.publish_figures()
            except Exception:  # noqa: BLE001 - the next ones may work
                _log.exception("the station's figures are not published now")

    def _figures(self) -> StationFigures:
        manager = self._manager
        devices = {
            device_id: DeviceFigures(status, self._publisher.generations.get(device_id, 0))
            if (session := manager.known_session(device_id)) is None
            else DeviceFigures(
                status,
                self._publisher.generations.get(device_id, 0),
                session.description,
                session.running,
                session.connected,
                session.drained,
                session.latency.counts(),
                session.stages.sums(),
                {
                    tool: (dict(counts.frames), counts.newest_ns)
                    for tool, counts in session.pose_counts.counts().items()
                },
                session.peak_settings(),
            )
            for device_id, status in manager.statuses().items()
        }
        return StationFigures(
            devices, manager.busy_s, manager.ready, _resident_bytes(), time.process_time()
        )


def _resident_bytes() -> int:
    """Return the resident memory of this process; 0 where the system does not tell."""
    try:
        pages = Path("/proc/self/statm").read_text(encoding="ascii").split()[1]
    except OSError:
        return 0
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


def _versioned(active: ActiveCalibration, version: int) -> VersionedCalibration:
    members = {one.name: getattr(active, one.name) for one in fields(ActiveCalibration)}
    return VersionedCalibration(**members, version=version)


@contextlib.contextmanager
def _collected() -> Iterator[None]:
    """Collect garbage after what makes it, and never while frames are processed.

    The hot path makes no cycles: reference counts free what it lets go.
    """
    try:
        yield
    finally:
        gc.collect()
        gc.freeze()


class LogForwarder(logging.Handler):
    """Sends log lines to the gateway, which has the only log."""

    def __init__(self, send: Callable[[LogLine], None]) -> None:
        super().__init__()
        self._send = send

    def emit(self, record: logging.LogRecord) -> None:
        """Send a line, with its device and its traceback as text."""
        try:
            if record.exc_info and not record.exc_text:
                record.exc_text = logging.Formatter().formatException(record.exc_info)
            line = dict(vars(record))
            line |= {"msg": record.getMessage(), "args": None, "exc_info": None}
            line["device"] = getattr(record, "device", None) or DEVICE.get()
            self._send(LogLine(line))
        except Exception:  # noqa: BLE001 - as handlers do
            self.handleError(record)


class CallServer:
    """Takes the gateway's calls from a socket, and answers each when it is done.

    Args:
        connection: the socket.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._sending = Lock()

    def send(self, message: Answer | LogLine) -> None:
        """Send a message; one to a gateway that has ended is lost."""
        with self._sending, contextlib.suppress(OSError):
            self._connection.send(message)

    def serve(self, station: Station) -> None:
        """Answer calls until the socket ends."""
        pool = ThreadPoolExecutor(_CALLS, thread_name_prefix="call")
        while True:
            try:
                call = self._connection.recv()
            except (EOFError, OSError):
                break
            if call.number is None:
                # In the order in which they come.
                self._answer(station, call)
            else:
                pool.submit(self._answer, station, call)
        pool.shutdown(wait=False, cancel_futures=True)

    def _answer(self, station: Station, call: Call) -> None:
        error: BaseException | None = None
        result: Any = None
        try:
            result = getattr(station, call.method)(*call.args, **call.members)
        except LumilineError as caught:
            error = caught
        except Exception as caught:  # noqa: BLE001 - the gateway gets it
            _log.exception("the station's %s failed", call.method)
            error = RuntimeError(f"{type(caught).__name__}: {caught}")
        if call.number is not None:
            # Whoever has the answer finds the figures that it has changed.
            station.publish_figures()
            self.send(Answer(call.number, result, error, station.head))


def prefer(priority: int | None, cores: Sequence[int]) -> None:
    """Let this process go before others, or on some cores only; the log says what was refused.

    Args:
        priority: 1 to 99, of real time (first in, first out); None: as all others.
        cores: numbers of those that it may use; empty: all.
    """
    if cores:
        try:
            os.sched_setaffinity(0, cores)
        except (AttributeError, OSError, ValueError) as error:
            _log.warning("station_cores %s: refused (%s); it runs on any", cores, error)
    if priority is not None:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        except (AttributeError, OSError, ValueError) as error:
            _log.warning(
                "station_priority %d: refused (%s); it runs as all others do. The service needs "
                "the right to it: CAP_SYS_NICE, or LimitRTPRIO of its unit",
                priority,
                error,
            )


def run(connection: Connection, ring: RingWriter, doorbell: int) -> None:
    """Be the station until the gateway ends.

    Args:
        connection: the gateway's calls.
        ring: takes the messages.
        doorbell: descriptor by which its reader is woken.
    """
    sys.setswitchinterval(_SWITCH_S)
    calls = CallServer(connection)
    root = logging.getLogger()
    root.handlers[:] = [LogForwarder(calls.send)]
    try:
        start: Start = connection.recv()
    except (EOFError, OSError):
        return
    root.setLevel(start.log_level)
    prefer(start.priority, start.cores)
    station = Station(ring, doorbell, start)
    gc.disable()
    gc.collect()
    gc.freeze()
    calls.serve(station)
    # A driver that hangs must not keep its device from the next station.
    last = threading.Timer(END_WITHIN_S, os._exit, (1,))
    last.daemon = True
    last.start()
    station.close()
