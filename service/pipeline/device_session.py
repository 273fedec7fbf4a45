"""DeviceSession: one running device; hands its batches to holds, poses, taps and streams."""

import logging
import time
from bisect import bisect_left
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from threading import Lock
from typing import Final

from compute.pose.rigid_body import PoseStatus, ToolPose
from hardware.driver import DeviceDescription
from hardware.line_frame import LineFrame
from hardware.link import LinkState
from service.pipeline.active_calibration import NO_ACTIVE_CALIBRATION
from service.pipeline.beam_hold_registry import BeamHoldRegistry
from service.pipeline.device_status import DeviceState, DeviceStatus
from service.pipeline.frame_batch import FrameBatch, TrackingResult
from service.pipeline.frame_processor import MAX_FRAMES, FrameProcessor
from service.pipeline.latest_poses import LatestPoses, PoseEntry
from service.pipeline.load_shedding import LoadShedding
from service.pipeline.reader_thread import FrameRing, ReaderThread
from service.pipeline.stream_publisher import StreamPublisher
from service.pipeline.taps import Tap
from service.pipeline.tracking_config import TrackingConfig

_log = logging.getLogger(__name__)

BOARD_SECONDS = 0.001
"""Least time between two entries of the board: of faster devices not every frame is put up."""

BATCH_SECONDS = 0.02
"""How long the frames of one device may keep those of the others waiting."""


class DeviceSession:
    """One device from start to stop."""

    def __init__(
        self,
        device_id: str,
        description: DeviceDescription,
        processor: FrameProcessor,
        ring: FrameRing,
        streams: StreamPublisher,
        poses: LatestPoses | None = None,
        holds: BeamHoldRegistry | None = None,
    ) -> None:
        self.device_id = device_id
        self.description = description
        self.processor = processor
        self.ring = ring
        self.streams = streams
        self.poses = LatestPoses() if poses is None else poses
        """Where the newest poses are published."""
        self.holds = holds
        """The beam holds of all devices; None: there are none."""
        self.pose_counts = PoseCounters()
        self._board_s = -BOARD_SECONDS
        self.frames_not_tracked_count = 0
        self.load_shedding = LoadShedding(description.frame_rate_hz)
        self.reader: ReaderThread | None = None
        self._taps_lock = Lock()
        self.taps: tuple[Tap, ...] = ()
        """Who takes batches beside the streams; replaced as a whole, so that it may be read."""
        self.active_calibration = NO_ACTIVE_CALIBRATION
        """What batches are processed with; changed in the compute thread, as they are."""
        self.processed = 0
        self.latency = LatencyHistogram()
        """From the exposure of a batch's oldest frame until its streams have it."""
        self.failure: str | None = None
        self.stopped = False
        self._batch = MAX_FRAMES
        self._watches_holds = False

    def work(self) -> bool:
        """Process and publish what waits; runs in the compute thread."""
        if self.failure is not None:
            return False
        begin = time.monotonic()
        try:
            frames, track = self._take_frames()
            if not frames:
                return False
            batch = self.processor.process(frames, track=track)
            if self.holds is not None and self._watches_holds:
                # Before all others: whoever holds a beam waits for nothing else.
                batch = replace(batch, holds=self.holds.take(batch))
            if batch.motion is not None and batch.motion.poses:
                # Before the streams: who steers by a pose waits for nothing else.
                self._publish_poses(batch, batch.motion)
            self._offer(batch)
            self.streams.publish_batch(batch)
            self.latency.count((time.time_ns() - frames[0].exposure_host_ns) * 1e-9)
        except Exception as error:  # noqa: BLE001 - becomes the status
            self._fail(error)
            return False
        self.processed += len(frames)
        # Other devices wait meanwhile: a device whose frames take long gets short batches. But
        # where only some frames are tracked, that time is bounded, whatever the batch's length.
        whole = time.monotonic() - begin
        if track is not None:
            tracking = self.processor.tracking_s
            self.load_shedding.count(sum(track), tracking, whole - tracking)
            if self.load_shedding.sheds:
                whole -= tracking
        self._batch = max(1, min(MAX_FRAMES, int(BATCH_SECONDS / max(whole / len(frames), 1e-6))))
        return True

    def _take_frames(self) -> tuple[list[LineFrame], tuple[bool, ...] | None]:
        """Take the next frames, and in which of them markers and tools are tracked; None: in all.

        A source that waits for the pipeline is never behind.
        """
        if not self.processor.is_tracking or self.reader is None or self.reader.lossless:
            return self.ring.take(self._batch), None
        frames, track = self.ring.take_chosen(
            self._batch,
            lambda frames, waiting: self.load_shedding.choose(
                [frame.marker for frame in frames], waiting
            ),
        )
        self.frames_not_tracked_count += track.count(False)
        return frames, tuple(track)

    def set_tracking_config(self, tracked: TrackingConfig) -> None:
        """Track other things from the next batch on; runs in the compute thread."""
        self._watches_holds = bool(tracked.holds)
        self.processor.set_tracking_config(tracked)
        self.pose_counts.keep(tool.name for tool in tracked.tools)
        if not tracked.tools:
            self.poses.remove(self.device_id)

    def _publish_poses(self, batch: FrameBatch, motion: TrackingResult) -> None:
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

    def attach(self, tap: Tap) -> None:
        """Give a tap all batches from now on."""
        with self._taps_lock:
            self.taps = (*self.taps, tap)

    def detach(self, tap: Tap) -> None:
        """Give a tap no more batches."""
        with self._taps_lock:
            self.taps = tuple(one for one in self.taps if one is not tap)

    def _offer(self, batch: FrameBatch) -> None:
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
        self.streams.publish_status(self.device_id, "failed", self.failure)

    @property
    def running(self) -> bool:
        """Whether frames still come, or will when the device is connected again."""
        return self.failure is None and self.reader is not None and self.reader.state == "running"

    @property
    def drained(self) -> bool:
        """Whether all frames are processed and no more will come."""
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

    def publish_status(self) -> None:
        """Tell the clients its state."""
        state, reason, link = self._standing()
        description = self.description if state == "running" else None
        self.streams.publish_status(
            self.device_id, state, reason, link.state if link else None, description
        )

    def publish_change(self) -> None:
        """Tell the clients its state behind its last frames; hold its beams when it is lost."""
        while self.work():
            pass
        if not self.connected:
            self.poses.remove(self.device_id)
            if self.holds is not None and not self.stopped:
                status = self.status()
                why = "" if status.reason is None else f": {status.reason}"
                self.holds.fail(self.device_id, f"the device is {status.state}{why}")
        if not self.stopped:
            self.publish_status()

    def status(self) -> DeviceStatus:
        """Return the device's status."""
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
            self.streams.subscribers(self.device_id),
            link,
            self.frames_not_tracked_count,
        )


BOUNDS_S: Final = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
"""Upper bounds of the classes [s]; one more, without a bound, follows."""


@dataclass(frozen=True)
class LatencyCounts:
    """Numbers of batches by class of latency.

    Args:
        counts: batches in each class of BOUNDS_S, and in the one behind it.
        sum_s: of all latencies [s].
    """

    counts: tuple[int, ...] = (0,) * (len(BOUNDS_S) + 1)
    sum_s: float = 0.0


class LatencyHistogram:
    """Latencies of batches by class; counted by one thread, read by any, without a lock."""

    def __init__(self) -> None:
        self._counts = [0] * (len(BOUNDS_S) + 1)
        self._sum_s = 0.0

    def count(self, latency_s: float) -> None:
        """Count a batch; a clock that was set back makes no negative latency."""
        latency_s = max(latency_s, 0.0)
        self._counts[bisect_left(BOUNDS_S, latency_s)] += 1
        self._sum_s += latency_s

    def counts(self) -> LatencyCounts:
        """Return the counts so far."""
        return LatencyCounts(tuple(self._counts), self._sum_s)


@dataclass(frozen=True)
class ToolCounts:
    """Counts of one tool.

    Args:
        frames: frames by the status of its pose.
        newest_ns: exposure of the newest frame with a pose of it that is OK, on the host's clock
            [ns]; None: there was none.
    """

    frames: dict[PoseStatus, int] = field(default_factory=dict)
    newest_ns: int | None = None


class PoseCounters:
    """Frames by tool and pose status; counted by the compute thread, read by any."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._frames: dict[str, dict[PoseStatus, int]] = {}
        self._newest_ns: dict[str, int] = {}

    def count(self, poses: Iterable[ToolPose]) -> None:
        """Count the poses of a batch."""
        with self._lock:
            for pose in poses:
                frames = self._frames.setdefault(pose.tool, {})
                frames[pose.status] = frames.get(pose.status, 0) + 1
                if pose.valid:
                    self._newest_ns[pose.tool] = pose.exposure_ns

    def keep(self, tools: Iterable[str]) -> None:
        """Forget all tools but these."""
        with self._lock:
            kept = set(tools)
            self._frames = {name: one for name, one in self._frames.items() if name in kept}
            self._newest_ns = {name: at for name, at in self._newest_ns.items() if name in kept}

    def counts(self) -> dict[str, ToolCounts]:
        """Return the counts so far, by tool."""
        with self._lock:
            return {
                name: ToolCounts(dict(frames), self._newest_ns.get(name))
                for name, frames in self._frames.items()
            }
