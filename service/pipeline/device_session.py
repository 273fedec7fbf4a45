"""DeviceSession: one device from start to stop, what it does and what it has lost."""

import logging
import time
from dataclasses import dataclass, replace
from threading import Lock
from typing import TYPE_CHECKING, Any, Literal

from hardware.driver import DeviceDescription
from hardware.line_frame import LineFrame
from hardware.link import LinkState
from service.pipeline.active_calibration import NO_ACTIVE_CALIBRATION
from service.pipeline.beam_hold_registry import BeamHoldRegistry
from service.pipeline.frame_processor import MAX_FRAMES, FrameProcessor
from service.pipeline.frame_ring import FrameRing
from service.pipeline.latency_histogram import LatencyHistogram
from service.pipeline.latest_poses import LatestPoses, PoseEntry
from service.pipeline.load_shedding import LoadShedding
from service.pipeline.pose_counters import PoseCounters
from service.pipeline.tracking_config import TrackingConfig
from service.protocols.stream.encoding import describe_message, status_message
from service.protocols.stream.hub import Hub

if TYPE_CHECKING:
    from service.pipeline.frame_batch import FrameBatch
    from service.pipeline.reader_thread import ReaderThread
    from service.pipeline.taps import Tap
    from service.pipeline.tracking_result import TrackingResult

_log = logging.getLogger(__name__)

DeviceState = Literal["stopped", "starting", "running", "disconnected", "ended", "failed"]

BOARD_SECONDS = 0.001
"""Least time between two entries of the board: of faster devices not every frame is put up."""

BATCH_SECONDS = 0.02
"""How long the frames of one device may keep those of the others waiting."""


@dataclass(frozen=True)
class DeviceStatus:
    """What a device is doing, and what was lost where since it was started.

    Args:
        state: starting (its driver is being opened), running, disconnected (its device is not
            there, and is tried again until it is), stopped by request, ended by itself (a
            recording), or failed.
        reason: why it failed, ended or is disconnected, or what is wrong with its link.
        calibration_id: the calibration that points are reconstructed with; None: peaks only.
        table_id: the correction table that readings are corrected by; None: they are not.
        frames: frames received from the driver.
        frames_lost_device: exposures missing in the device's sequence numbers.
        frames_dropped_ring: frames dropped because the compute thread did not keep up.
        frames_processed: frames that were published.
        subscribers: connected streams.
        link: of a device that can be unplugged, how its link stands; None of others.
        frames_not_tracked: frames whose points were made, but in which markers and tools were not
            followed, because the compute thread did not keep up.
    """

    state: DeviceState
    reason: str | None = None
    calibration_id: str | None = None
    table_id: str | None = None
    frames: int = 0
    frames_lost_device: int = 0
    frames_dropped_ring: int = 0
    frames_processed: int = 0
    subscribers: int = 0
    link: LinkState | None = None
    frames_not_tracked: int = 0


class DeviceSession:
    """One device from start to stop."""

    def __init__(
        self,
        device_id: str,
        description: DeviceDescription,
        processor: FrameProcessor,
        ring: FrameRing,
        hub: Hub,
        poses: LatestPoses | None = None,
        holds: BeamHoldRegistry | None = None,
    ) -> None:
        self.device_id = device_id
        self.description = description
        self.processor = processor
        self.ring = ring
        self.hub = hub
        self.poses = LatestPoses() if poses is None else poses
        """Where the newest poses are put up."""
        self.holds = holds
        """What says whether beams are held; None: nothing does."""
        self.pose_counts = PoseCounters()
        self._board_s = -BOARD_SECONDS
        self.frames_not_tracked_count = 0
        self.load_shedding = LoadShedding(description.frame_rate_hz)
        self.reader: ReaderThread | None = None
        self._taps_lock = Lock()
        self.taps: tuple[Tap, ...] = ()
        """Who takes batches beside the streams; replaced as a whole, so that it may be read."""
        self.in_force = NO_ACTIVE_CALIBRATION
        """What batches are processed with; changed in the compute thread, as they are."""
        self.processed = 0
        self.latency = LatencyHistogram()
        """From the exposure of a batch's oldest frame until its streams have it."""
        self.failure: str | None = None
        self.stopped = False
        self._batch = MAX_FRAMES

    def work(self) -> bool:
        """Process and publish what waits; runs in the compute thread."""
        if self.failure is not None:
            return False
        frames = self.ring.take(self._batch)
        if not frames:
            return False
        begin = time.monotonic()
        try:
            track = self._select_tracked_frames(frames)
            frames = frames[: len(track)]
            batch = self.processor.process(frames, track=track)
            if self.holds is not None:
                # Before all others: whoever holds a beam waits for nothing else.
                batch = replace(batch, holds=self.holds.take(batch))
            if batch.motion is not None and batch.motion.poses:
                # Before the streams: who steers by a pose waits for nothing else.
                self._publish_poses(batch, batch.motion)
            self._offer(batch)
            self.hub.publish_batch(batch)
            self.latency.count((time.time_ns() - frames[0].exposure_host_ns) * 1e-9)
        except Exception as error:  # noqa: BLE001 - becomes the status
            self._fail(error)
            return False
        self.processed += len(frames)
        # Other devices wait meanwhile: a device whose frames take long gets short batches. But
        # where only some frames are followed, that time is bounded, whatever the batch's length.
        whole = time.monotonic() - begin
        following = self.processor.tracking_s
        self.load_shedding.count(sum(track), following, whole - following)
        per_frame = (whole - following if self.load_shedding.sheds else whole) / len(frames)
        self._batch = max(1, min(MAX_FRAMES, int(BATCH_SECONDS / max(per_frame, 1e-6))))
        return True

    def _select_tracked_frames(self, frames: list[LineFrame]) -> tuple[bool, ...]:
        """Return in which of the frames that were taken markers and tools are followed.

        Those without an answer wait for the next batch. A source that waits is never behind.
        """
        if not self.processor.is_tracking or self.reader is None or self.reader.waits:
            return (True,) * len(frames)
        track = self.load_shedding.choose([frame.marker for frame in frames], len(self.ring))
        if len(track) < len(frames):
            self.ring.put_back(frames[len(track) :])
        self.frames_not_tracked_count += track.count(False)
        return track

    def set_tracking_config(self, tracked: TrackingConfig) -> None:
        """Follow other things from the next batch on; runs in the compute thread."""
        self.processor.set_tracking_config(tracked)
        self.pose_counts.keep(tool.name for tool in tracked.tools)
        if not tracked.tools:
            self.poses.remove(self.device_id)

    def _publish_poses(self, batch: "FrameBatch", motion: "TrackingResult") -> None:
        """Count the poses of a batch, and put those of its newest frame up."""
        self.pose_counts.count(motion.poses)
        now = time.monotonic()
        if self.stopped or now - self._board_s < BOARD_SECONDS:
            return
        self._board_s = now
        newest = batch.frames[-1]
        entry = PoseEntry(
            self.device_id,
            newest.sequence,
            newest.exposure_host_ns,
            {pose.tool: pose for pose in motion.poses_of(len(batch.frames) - 1)},
            batch.calibration_id,
            self.description.frame_rate_hz,
            batch.table_id,
        )
        self.poses.put(entry)

    def attach(self, tap: "Tap") -> None:
        """Let a tap have the batches from now on."""
        with self._taps_lock:
            self.taps = (*self.taps, tap)

    def detach(self, tap: "Tap") -> None:
        """Let it have no more."""
        with self._taps_lock:
            self.taps = tuple(one for one in self.taps if one is not tap)

    def _offer(self, batch: "FrameBatch") -> None:
        """Offer a batch to all taps; one that fails has no more, and the device goes on."""
        for tap in self.taps:
            try:
                tap.offer(batch)
            except Exception as error:  # noqa: BLE001 - of the tap, not of the device
                self.detach(tap)
                _log.error(
                    "device %s: %s failed and has no more of its frames",
                    self.device_id,
                    type(tap).__name__,
                    exc_info=error,
                    extra={"device": self.device_id},
                )

    def _fail(self, error: Exception) -> None:
        """Give the device up: its driver is closed, clients are told, the log has the cause."""
        device = {"device": self.device_id}
        _log.error("device %s: processing failed", self.device_id, exc_info=error, extra=device)
        self.failure = f"processing failed: {type(error).__name__}: {error}"
        if self.reader is not None:
            self.reader.close_driver()
        self.poses.remove(self.device_id)
        if self.holds is not None:
            self.holds.fail(self.device_id, f"the device failed: {self.failure}")
        self.hub.publish(self.device_id, status_message(self.device_id, "failed", self.failure))

    @property
    def running(self) -> bool:
        """Whether frames still come, or will when the device is connected again."""
        return self.failure is None and self.reader is not None and self.reader.state == "running"

    @property
    def drained(self) -> bool:
        """Whether taps have had all that they will ever have."""
        if self.stopped or self.failure is not None:
            return True
        taken = self.processed + self.ring.dropped
        return not self.running and taken >= self.ring.received

    @property
    def connected(self) -> bool:
        """Whether it runs and its device is there."""
        return self.running and self._standing()[0] == "running"

    def _standing(self) -> tuple[DeviceState, str | None, LinkState | None]:
        """Return the state, its reason, and the link's."""
        assert self.reader is not None
        link = self.reader.link()
        if self.failure:
            return "failed", self.failure, link
        state, reason = self.reader.state, self.reader.reason
        if state != "running" or link is None:
            return state, reason, link
        return "disconnected" if link.state == "disconnected" else "running", link.reason, link

    def status_message(self) -> dict[str, Any]:
        """Return the message that tells how things stand."""
        state, reason, link = self._standing()
        message = status_message(self.device_id, state, reason, link.state if link else None)
        return message | describe_message(self.description) if state == "running" else message

    def status(self) -> DeviceStatus:
        """Return how things stand."""
        state, reason, link = self._standing()
        return DeviceStatus(
            state,
            reason,
            self.processor.calibration_id,
            self.processor.table_id,
            self.ring.received,
            self.ring.lost,
            self.ring.dropped,
            self.processed,
            self.hub.subscribers(self.device_id),
            link,
            self.frames_not_tracked_count,
        )
