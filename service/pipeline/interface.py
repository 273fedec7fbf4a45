"""Pipeline: the live side as REST and the protocols use it, wherever it runs."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from hardware.driver import DeviceDescription, Driver
from service.pipeline.active_calibration import NO_ACTIVE_CALIBRATION, ActiveCalibration
from service.pipeline.beam_hold_registry import Listener
from service.pipeline.detection_stage import Method, SearchModel
from service.pipeline.device_session import StreamPublisher, ToolCounts
from service.pipeline.device_status import DeviceStatus
from service.pipeline.frame_batch import BeamHoldState, LatestPoses
from service.pipeline.stage_latency import Stage
from service.pipeline.taps import Tap
from service.pipeline.tracking_config import TrackingConfig

Accept = Callable[[DeviceDescription], None]
"""Raises a LumilineError when a device is not what it should be; can be pickled."""


def any_device(_: DeviceDescription) -> None:
    """Accept every device."""


StationStanding = Literal["running", "limited", "starting", "lost"]


@dataclass(frozen=True)
class StationState:
    """A process that devices belong to, where it is not this one.

    Args:
        process_id: of the operating system.
        restarts: how often it was lost and started again.
        messages_missed: messages of its bus that were lost before they were read.
        memory_bytes: its resident memory.
        cpu_s: computing time that it has used.
        name: of a station on another machine; None: of this server itself.
        state: running; limited: something of it does not work; starting again; or lost: it does
            not answer.
        reason: why it is not simply running.
        since_ns: since when it is in this state [ns since 1970].
        round_trip_s: a question to it and its answer [s]; None: it is not asked, or lost.
        host: its machine; None: this one, or not known.
        devices: how many of its devices it has told of.
    """

    process_id: int
    restarts: int
    messages_missed: int
    memory_bytes: int
    cpu_s: float
    name: str | None = None
    state: StationStanding = "running"
    reason: str | None = None
    since_ns: int = 0
    round_trip_s: float | None = None
    host: str | None = None
    devices: int = 0


class RunningDevice(Protocol):
    """One device from its start to its stop; all methods may be called from any thread."""

    @property
    def device_id(self) -> str:
        """The device."""
        ...

    @property
    def description(self) -> DeviceDescription:
        """What its driver says of it."""
        ...

    @property
    def connected(self) -> bool:
        """Whether it runs and its device is there."""
        ...

    @property
    def drained(self) -> bool:
        """Whether all frames are processed, and offered to taps, and no more will come."""
        ...

    @property
    def active_calibration(self) -> ActiveCalibration:
        """What its newest batch was processed with."""
        ...

    @property
    def method(self) -> Method | None:
        """How its peaks are found; None: nothing reads its scans."""
        ...

    @property
    def search_model(self) -> SearchModel:
        """What its peaks are found with; may wait for it."""
        ...

    @property
    def last_sequence(self) -> int:
        """Sequence number of the newest frame; -1 before the first; may wait for it."""
        ...

    @property
    def frames_dropped(self) -> int:
        """Frames that taps lack, since nobody took them in time."""
        ...

    def peak_settings(self) -> dict[str, Any]:
        """Return the method of peak detection and its errors as a JSON object."""
        ...

    def status(self) -> DeviceStatus:
        """Return its status."""
        ...

    def attach(self, tap: Tap, *, sampled: bool = False) -> None:
        """Give a tap all batches from now on; ``sampled``: some seconds of a minute are enough."""
        ...

    def detach(self, tap: Tap) -> None:
        """Give a tap no more batches; what it was being given, it has when this returns."""
        ...


class KnownDevices(Protocol):
    """The devices of a pipeline, for a driver whose frames come from others of them."""

    def known_session(self, device_id: str) -> RunningDevice | None:
        """Return the session of a device that was started, running or not; None: it was not."""
        ...


@runtime_checkable
class DeviceUser(Protocol):
    """A driver whose frames come from other devices of its pipeline."""

    def bind(self, devices: KnownDevices) -> None:
        """Take the devices; called before ``open``."""
        ...


class BeamHolds(Protocol):
    """The beam holds of all devices; all methods may be called from any thread."""

    def listen(self, listener: Listener) -> Callable[[], None]:
        """Call with every hold now, and from now on with every change, in order."""
        ...

    def set_up(self, reference_id: str) -> None:
        """Note that a reference is being set in this process."""
        ...

    def acknowledge(self, hold_id: str) -> BeamHoldState | None:
        """End the latch of a hold and return it; None: there is no such hold."""
        ...

    def now(self, hold_id: str) -> BeamHoldState | None:
        """Return the state of a hold; None: there is no such hold."""
        ...

    def of_device(self, device_id: str) -> tuple[BeamHoldState, ...]:
        """Return all holds of a device, by id."""
        ...

    def all(self) -> dict[str, tuple[BeamHoldState, ...]]:
        """Return the holds of every device."""
        ...


class Pipeline(Protocol):
    """Starts and stops devices; all methods may be called from any thread.

    Those that change something wait until it is done, and must not be called in an event loop;
    the others never wait.
    """

    @property
    def streams(self) -> StreamPublisher:
        """Takes the results for the clients."""
        ...

    @property
    def poses(self) -> LatestPoses:
        """The newest poses of all tools."""
        ...

    @property
    def holds(self) -> BeamHolds:
        """Whether beams are held."""
        ...

    @property
    def ready(self) -> bool:
        """Whether frames are processed."""
        ...

    @property
    def busy_s(self) -> float:
        """Time spent so far on the current batch or job [s]."""
        ...

    @property
    def stations(self) -> tuple[StationState, ...]:
        """The processes that devices belong to; those of this one itself are in none."""
        ...

    def start_device(
        self,
        device_id: str,
        driver: Driver,
        active: ActiveCalibration = NO_ACTIVE_CALIBRATION,
        accept: Accept = any_device,
    ) -> DeviceDescription | None:
        """Open the driver and start its reader; raises LumilineError when it cannot be opened."""
        ...

    def stop_device(self, device_id: str) -> None:
        """Stop the device and close its driver; nothing happens when it is not running."""
        ...

    def forget_device(self, device_id: str) -> None:
        """Stop the device, drop its counters and end its streams: it is deleted."""
        ...

    def set_calibration(self, device_id: str, active: ActiveCalibration) -> None:
        """Switch calibration and table between two frames; nothing happens when it is not running.

        Nor when the device runs with other sensors than the calibration's.
        """
        ...

    def set_tracking_config(self, device_id: str, tracked: TrackingConfig) -> None:
        """Set a device's tracking configuration: from the next batch on, or once it is started."""
        ...

    def tracked(self, device_id: str) -> TrackingConfig:
        """Return a device's tracking configuration, now or once it is started."""
        ...

    def refresh(self) -> None:
        """Wait until statuses and counters are those of now, where they may be older."""
        ...

    def status(self, device_id: str) -> DeviceStatus:
        """Return the device's status; "stopped" for one never started."""
        ...

    def statuses(self) -> dict[str, DeviceStatus]:
        """Return the status of every device that was started, or tried to."""
        ...

    def latencies(self) -> dict[str, tuple[tuple[int, ...], float]]:
        """Return the latencies of batches by class, and their sum [s], by device."""
        ...

    def stage_latencies(self) -> dict[str, tuple[int, dict[Stage, float]]]:
        """Return frames that were timed, and their time in each stage [s], by device."""
        ...

    def pose_counts(self) -> dict[str, dict[str, ToolCounts]]:
        """Return pose counts by device and tool, of devices that were started."""
        ...

    def describe(self, device_id: str) -> DeviceDescription | None:
        """Return the driver's description of a device; None: it was never started."""
        ...

    def session(self, device_id: str) -> RunningDevice:
        """Return a running device; raises DeviceNotRunning."""
        ...

    def collect(
        self, device_id: str, frames: int, marker: int | None, timeout_s: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the readings of one marker in the next frames of a running device."""
        ...

    def close(self) -> None:
        """Stop all devices."""
        ...


class RemoteStations(Protocol):
    """Stations on other machines, to which devices belong; all methods may wait."""

    def assign(self, device_id: str, station: str | None) -> None:
        """Note which station a device is of; None: this server itself."""
        ...

    def is_far(self, device_id: str) -> bool:
        """Whether a device is of a station on another machine, as far as is known here."""
        ...

    def reaches(self, station: str | None) -> bool:
        """Whether a station answers now; None: this server itself."""
        ...

    def start_at_station(self, device_id: str) -> None:
        """Have a device's station start it as the database says; raises what that raises."""
        ...

    def sensors_at_station(self, station: str, device_id: str, source: Any) -> list[dict[str, Any]]:
        """Return the sensors that a source, as plain values, has at a station's machine."""
        ...
