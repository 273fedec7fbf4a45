"""DeviceSession: one running device; hands its batches to holds, poses, taps and streams.

A computer that is too slow for all frames tracks in as many as it can, evenly, instead of in all
for a while and then in none: tracks lose some of their readings, and no pose is late.
"""

import logging
import math
import time
from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from statistics import median
from threading import Lock, RLock
from typing import Any, Final, Protocol

from compute.pose.rigid_body import PoseStatus, ToolPose
from hardware.driver import DeviceDescription
from hardware.line_frame import LineFrame
from hardware.link import LinkState
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.bad_pixel_watch import BadPixelWatch
from service.pipeline.beam_hold_registry import BeamHoldRegistry
from service.pipeline.detection_stage import Method, SearchModel
from service.pipeline.device_status import DeviceState, DeviceStatus
from service.pipeline.frame_batch import (
    BeamHoldState,
    FrameBatch,
    LatestPoses,
    newest_poses,
)
from service.pipeline.frame_processor import MAX_FRAMES, FrameProcessor
from service.pipeline.stage_latency import StageLatency
from service.pipeline.taps import Tap, log_failed_tap
from service.pipeline.threads import (
    MIN_RUN_TO_COMPLETION_HZ,
    ComputeThread,
    FrameRing,
    ReaderThread,
)
from service.pipeline.tracking_config import TrackingConfig, WatchedTool

SLICE_S: Final = 0.004
"""Time for a batch when tracking skips frames: poses are late by twice that at most, and the
devices that share the thread wait for as long."""
BEGIN_S: Final = 0.02
"""When frames of more time wait, tracking begins to skip frames."""
END_S: Final = 0.25
"""When there was time for all frames for this long, all are tracked again."""
BEHIND_S: Final = 0.1
"""When frames of more time wait, none is tracked: its pose would be as old."""
CAUGHT_UP_S: Final = 0.02
"""When no more than that waits, some are again."""

IDLE_AFTER_S: Final = 60.0
"""Without a client, tap, tool or hold for this long, nothing is computed; until then a client that
comes back finds the messages that it missed."""
SAMPLE_INTERVAL_S: Final = 60.0
SAMPLE_S: Final = 2.0
"""Of each such interval an idle device computes this much, for taps that samples are enough for."""

ENTER_SHARE: Final = 0.5
LEAVE_SHARE: Final = 0.65
"""Of the time between two frames: while one takes less, the thread that reads it processes it."""
MAX_CYCLE: Final = 1.05
"""Of the device's period: how far frames may be apart on the mean."""
_MEAN_FRAMES: Final = 32

_COSTS: Final = 9
"""Batches of which the median cost counts: a search now and then, or a hiccup, does not."""


class LoadShedding:
    """Selects the frames that are tracked, by the length of the queue and the cost of a frame.

    It has no clock: times are given. All frames are tracked until frames of BEGIN_S wait. Then a
    batch has SLICE_S, however many frames it holds, or the time of one: batches grow until that is
    enough, and the devices of a thread get the same time each. Tracked are the frames whose strobe
    slot was left out for the longest time, so that no marker is neglected, and of equals the
    newest. Every n-th frame would never show some markers of a strobe whose number has a divisor
    in common with n; whole strobe cycles with gaps between would leave longer gaps.

    Args:
        rate_hz: of the device's frames; 0: not known, then all are tracked.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_s = 1.0 / rate_hz if rate_hz > 0.0 else 0.0
        self.sheds = False
        """Whether tracking may skip frames."""
        self.behind = False
        """Whether tracking skips all frames until it has caught up."""
        self._tracking_s: deque[float] = deque(maxlen=_COSTS)  # of a frame
        self._rest_s: deque[float] = deque(maxlen=_COSTS)  # of a batch
        self._enough = 0  # frames in a row for which there was time
        self._count = 0
        self._last: dict[int | None, int] = {}  # newest tracked frame of each slot

    def choose(self, slots: Sequence[int | None], waiting: int) -> tuple[bool, ...]:
        """Return in which of the next frames markers and tools are tracked.

        Frames behind the last tracked one are left for the next batch, so that the newest frame
        of a batch has poses: there may be fewer answers than frames, but at least one.

        Args:
            slots: strobe slot of each frame, oldest first; None: all markers are lit.
            waiting: frames that wait behind them.
        """
        later_s = (len(slots) + waiting - 1) * self._period_s
        self.behind = later_s > (CAUGHT_UP_S if self.behind else BEHIND_S)
        self.sheds = self.sheds or later_s > BEGIN_S
        if self.behind:
            self._enough = 0
            chosen = [False] * len(slots)
        elif self.sheds:
            chosen = self._choose(slots, self._affordable(len(slots)))
        else:
            chosen = [True] * len(slots)
        if True in chosen:
            while not chosen[-1]:
                chosen.pop()
        for index, tracked in enumerate(chosen):
            if tracked:
                self._last[slots[index]] = self._count + index
        self._count += len(chosen)
        return tuple(chosen)

    def count(self, tracked: int, tracking_s: float, rest_s: float) -> None:
        """Learn what a batch cost.

        Args:
            tracked: in how many of its frames markers and tools were tracked.
            tracking_s: how long that took [s].
            rest_s: how long all else took [s].
        """
        self._rest_s.append(rest_s)
        if tracked:
            self._tracking_s.append(tracking_s / tracked)

    def _affordable(self, frames: int) -> int:
        """Return in how many of the frames there is time to track: in one at least."""
        rest_s = median(self._rest_s) if self._rest_s else 0.0
        frame_s = max(median(self._tracking_s) if self._tracking_s else 0.0, 1e-6)
        count = min(max(1, int((SLICE_S - rest_s) / frame_s)), frames)
        self._enough = self._enough + frames if count == frames else 0
        if self._enough * self._period_s > END_S:
            self.sheds, self._enough = False, 0
        return count

    def _choose(self, slots: Sequence[int | None], count: int) -> list[bool]:
        """Choose the frame farthest from all tracked ones of its strobe slot, and so on."""
        if count == len(slots):
            return [True] * len(slots)
        far = [
            self._count + index - self._last.get(slot, -math.inf)
            for index, slot in enumerate(slots)
        ]
        chosen = [False] * len(slots)
        for _ in range(count):
            best = max(range(len(slots)), key=lambda index: (far[index], index))
            chosen[best] = True
            for index, slot in enumerate(slots):
                if slot == slots[best]:
                    far[index] = min(far[index], abs(index - best))
        return chosen


class RunToCompletion:
    """Decides whether the thread that reads a frame also processes it.

    That saves the time until another thread wakes and has the interpreter. But a frame that comes
    meanwhile waits, and several are not taken at once: it is for frames that take a small part of
    the time between them, and only while they come as often as they should. It has no clock, and
    learns from frames that were processed alone, as those in a batch cost less each.

    Args:
        rate_hz: of the device's frames; 0: not known, then the compute thread has all, as it has
            those of slow devices.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_s = 1.0 / rate_hz if rate_hz >= MIN_RUN_TO_COMPLETION_HZ else 0.0
        self._mean_s = self._mean_cycle_s = self._period_s
        self._begin_s: float | None = None
        self.is_due = False
        """Whether a frame that was just read is processed at once."""

    def count(self, begin_s: float, frame_s: float) -> None:
        """Learn from a frame that was processed alone.

        Args:
            begin_s: when that began [s].
            frame_s: how long it took [s].
        """
        period_s, before_s = self._period_s, self._begin_s
        self._begin_s = begin_s
        if before_s is not None:
            # A pause is none of the machine's.
            cycle_s = min(begin_s - before_s, 4.0 * period_s)
            self._mean_cycle_s += (cycle_s - self._mean_cycle_s) / _MEAN_FRAMES
        self._mean_s += (frame_s - self._mean_s) / _MEAN_FRAMES
        if frame_s > period_s:
            # Others wait now: the compute thread takes them together.
            self._mean_s = max(self._mean_s, period_s)
        # Faster ones than the device says: a replay, an external trigger, several in one read.
        shortest_s = min(period_s, self._mean_cycle_s)
        limit = LEAVE_SHARE if self.is_due else ENTER_SHARE
        # Slower ones: reading and processing together take longer than they may.
        self.is_due = (
            self._mean_s < limit * shortest_s and self._mean_cycle_s < MAX_CYCLE * period_s
        )


class StreamPublisher(Protocol):
    """Takes batches and changes of state; all methods may be called from any thread.

    None of them waits for a client. ``service.protocols.stream.hub.Hub`` is the one of the service.
    """

    closed: str | None
    """Why all streams have ended; None: they have not."""

    @property
    def congested(self) -> bool:
        """Whether sources that can wait have to, for what takes the results is far behind."""
        ...

    def publish_batch(self, batch: FrameBatch) -> None:
        """Send a batch of frames to the clients of its device."""
        ...

    def publish_status(
        self,
        device_id: str,
        state: str,
        reason: str | None = None,
        link: str | None = None,
        description: DeviceDescription | None = None,
    ) -> None:
        """Tell the clients of a device its state, with the description of one that runs."""
        ...

    def publish_hold(self, device_id: str, now: BeamHoldState) -> None:
        """Tell the clients of a device, who asked for beam holds, of a change of one."""
        ...

    def subscribers(self, device_id: str) -> int:
        """Return the number of clients of a device."""
        ...

    def end(self, device_id: str) -> None:
        """Tell the clients of a device that it was deleted, and end their streams."""
        ...


_log = logging.getLogger(__name__)

MIN_POSE_INTERVAL_S = 0.0005
"""Least time between two entries of the newest poses: of faster devices frames are left out."""
MAX_BATCH_BYTES: Final = 1 << 24
"""Most pixels of a batch [bytes]."""
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
        self.holds = BeamHoldRegistry(streams.publish_hold) if holds is None else holds
        """The beam holds of all devices."""
        self.pose_counts = PoseCounters()
        self.bad_pixel_watch = (
            BadPixelWatch(device_id, description)
            if processor.detection.method in ("fit", "centroid")
            else None
        )
        """Looks for bad pixels; None: scans of these sensors are no lines of light."""
        self._published_s = -MIN_POSE_INTERVAL_S
        self.frames_not_tracked_count = 0
        self.load_shedding = LoadShedding(description.frame_rate_hz)
        self._run_to_completion = RunToCompletion(description.frame_rate_hz)
        self.reader: ReaderThread | None = None
        self._taps_lock = RLock()
        """Held while a batch is offered: a detached tap has all that it was being given."""
        self.taps: tuple[Tap, ...] = ()
        self._sampled_taps: tuple[Tap, ...] = ()
        """Who takes batches beside the streams; replaced as a whole, so that it may be read."""
        self.processed = 0
        self.latency = LatencyHistogram()
        """From the exposure of a batch's oldest frame until its streams have it."""
        self.stages = StageLatency(ring)
        """Of one frame a second, from its exposure to the streams."""
        self.failure: str | None = None
        self.stopped = False
        sensors, pixels = len(description.sensors), description.sensors[0].pixels
        self._max_frames = max(1, min(MAX_FRAMES, MAX_BATCH_BYTES // (2 * sensors * pixels)))
        self._batch = self._max_frames
        self._has_scans = description.readout != "bar-peaks"
        self._watches_holds = self._watches_tools_alone = False
        self._hold_states: tuple[tuple[BeamHoldState, ...], ...] | None = None
        """States of the holds after each frame of the batch in hand, once they are known."""
        self._has_tools = False
        self._last_request_s = time.monotonic()
        self._skipped = 0

    @property
    def runs_to_completion(self) -> bool:
        """Whether the thread that has just read a frame is to process it: no other waits."""
        return (
            len(self.ring) == 1
            and self.reader is not None
            and not self.reader.lossless
            and not self.processor.uses_gpu
            and self._run_to_completion.is_due
        )

    def process_frame(self, compute: ComputeThread) -> None:
        """Let a frame that was put into the ring be processed: here, or in the compute thread."""
        if self.runs_to_completion:
            compute.work_now(self.device_id)
        if len(self.ring):
            compute.wake()

    def work(self) -> bool | None:
        """Process and publish what waits; a worker of the ``ComputeThread``.

        Returns:
            Whether there was any; None: it has to wait, since the streams are far behind.
        """
        if self.failure is not None:
            return False
        if self.reader is not None and self.reader.lossless and self.streams.congested:
            return None if len(self.ring) else False
        begin = time.monotonic()
        try:
            if self._idle(begin):
                return self._skip_frames()
            frames, track = self._take_frames()
            if not frames:
                return False
            if self._has_scans and any(frame.lines.size == 0 for frame in frames):
                # Exposed while nobody looked; the next ones have pixels.
                rendered = [index for index, frame in enumerate(frames) if frame.lines.size]
                self._skipped += len(frames) - len(rendered)
                if not rendered:
                    return True
                frames = [frames[index] for index in rendered]
                track = None if track is None else tuple(track[index] for index in rendered)
            timed = begin >= self.stages.due_s and self.stages.sampled(frames, begin)
            taken_ns = time.time_ns() if timed else 0
            self._hold_states = None
            batch = self.processor.process(frames, track=track, take_poses=self._take_poses)
            computed_ns = time.time_ns() if timed else 0
            if self._watches_holds:
                # Before all others: whoever holds a beam waits for nothing else.
                states = self._hold_states
                batch = replace(batch, holds=self.holds.take(batch) if states is None else states)
            self._offer(batch)
            self.streams.publish_batch(batch)
            self.latency.count((time.time_ns() - frames[0].exposure_host_ns) * 1e-9)
            if timed:
                self.stages.count(frames, taken_ns, computed_ns)
            self._watch_pixels(frames)
        except Exception as error:  # noqa: BLE001 - becomes the status
            self._fail(error)
            return False
        self.processed += len(frames)
        # Other devices wait meanwhile: a device whose frames take long gets short batches. But
        # where only some frames are tracked, that time is bounded, whatever the batch's length.
        elapsed_s = time.monotonic() - begin
        if len(frames) == 1:
            self._run_to_completion.count(begin, elapsed_s)
        if track is not None:
            tracking = self.processor.tracking_s
            self.load_shedding.count(sum(track), tracking, elapsed_s - tracking)
            if self.load_shedding.sheds:
                elapsed_s -= tracking
        self._batch = max(
            1, min(self._max_frames, int(BATCH_SECONDS / max(elapsed_s / len(frames), 1e-6)))
        )
        return True

    def _watch_pixels(self, frames: Sequence[LineFrame]) -> None:
        """Mask pixels that are found to be bad, from the next batch on.

        Not of a source that waits for the pipeline: which frames are looked at depends on the time
        that they take, and its results must not.
        """
        watch = self.bad_pixel_watch
        if watch is None or self.reader is None or self.reader.lossless:
            return
        if time.monotonic() >= watch.due_s and watch.take(frames):
            self.set_calibration(self.processor.active_calibration)

    def with_bad_pixels(self, active: ActiveCalibration) -> ActiveCalibration:
        """Return a calibration with the pixels that were found to be bad since the start."""
        watch = self.bad_pixel_watch
        return active if watch is None else replace(active, bad_pixels=watch.found)

    def set_calibration(self, active: ActiveCalibration) -> None:
        """Switch calibration and table, between two batches; in a turn of the ComputeThread."""
        active = self.with_bad_pixels(active)
        with self._taps_lock:
            # Recordings name what each frame was processed with: a replay gives the same bits.
            for tap in self.taps:
                tap.prepare(active)
            self.processor.set_calibration(active)

    def _idle(self, now_s: float) -> bool:
        """Whether nobody has wanted results for a while; tells the driver when that changes."""
        requested = (
            self._has_tools
            or len(self.taps) > len(self._sampled_taps)
            or self.reader is None
            or self.reader.lossless
            or self.streams.subscribers(self.device_id) > 0
        )
        if requested:
            self._last_request_s = now_s
        sampled = bool(self._sampled_taps) and now_s % SAMPLE_INTERVAL_S < SAMPLE_S
        idle = not sampled and now_s - self._last_request_s > IDLE_AFTER_S
        if self.reader is not None:
            self.reader.set_idle(idle=idle)
        return idle

    def _skip_frames(self) -> bool:
        """Drop what waits, which nobody wants."""
        count = len(self.ring.take(MAX_FRAMES))
        self._skipped += count
        return count > 0

    def _take_frames(self) -> tuple[list[LineFrame], tuple[bool, ...] | None]:
        """Take the next frames, and in which of them markers and tools are tracked; None: in all.

        A source that waits for the pipeline is never behind.
        """
        if not self.processor.is_tracking or self.reader is None or self.reader.lossless:
            return self.ring.take(self._batch), None
        frames, track = self.ring.take_chosen(
            self._batch,
            lambda candidates, waiting: self.load_shedding.choose(
                [one.marker for one in candidates], waiting
            ),
        )
        self.frames_not_tracked_count += track.count(False)
        return frames, tuple(track)

    def set_tracking_config(self, tracked: TrackingConfig) -> None:
        """Track other things from the next batch on; in a turn of the ComputeThread."""
        self._watches_holds = bool(tracked.holds)
        self._watches_tools_alone = all(
            isinstance(hold.spec, WatchedTool) for hold in tracked.holds
        )
        self._has_tools = bool(tracked.tools or tracked.holds)
        self.processor.set_tracking_config(tracked)
        self.pose_counts.keep(tool.name for tool in tracked.tools)
        if not tracked.tools:
            self.poses.remove(self.device_id)

    def _take_poses(self, batch: FrameBatch) -> None:
        """Step the holds that watch tools, count the poses, and publish those of the newest frame.

        Before points, tracks, taps and streams: who steers by a pose waits for nothing else.
        """
        assert batch.motion is not None
        if self._watches_holds and self._watches_tools_alone:
            self._hold_states = self.holds.take(batch)
        self.pose_counts.count(batch.motion.poses)
        now = time.monotonic()
        if self.stopped or now - self._published_s < MIN_POSE_INTERVAL_S:
            return
        self._published_s = now
        self.poses.put(newest_poses(batch, batch.motion, self.description.frame_rate_hz))

    def attach(self, tap: Tap, *, sampled: bool = False) -> None:
        """Give a tap all batches from now on; ``sampled``: some seconds of a minute are enough."""
        with self._taps_lock:
            tap.prepare(self.processor.active_calibration)
            self.taps = (*self.taps, tap)
            if sampled:
                self._sampled_taps = (*self._sampled_taps, tap)

    def repeat_calibration(self, tap: Tap) -> None:
        """Tell a tap again what its next batches are processed with, if it is attached."""
        with self._taps_lock:
            if any(one is tap for one in self.taps):
                tap.prepare(self.processor.active_calibration)

    def detach(self, tap: Tap) -> None:
        """Give a tap no more batches; what it was being given, it has when this returns."""
        with self._taps_lock:
            self.taps = tuple(one for one in self.taps if one is not tap)
            self._sampled_taps = tuple(one for one in self._sampled_taps if one is not tap)

    def _offer(self, batch: FrameBatch) -> None:
        """Offer a batch to all taps; one that fails has no more, and the device goes on."""
        with self._taps_lock:
            for tap in self.taps:
                try:
                    tap.offer(batch)
                except Exception as error:  # noqa: BLE001 - of the tap, not of the device
                    self.detach(tap)
                    log_failed_tap(self.device_id, tap, error)

    def _fail(self, error: Exception) -> None:
        """Give the device up: its driver is closed, clients are told, the log has the cause."""
        device = {"device": self.device_id}
        _log.error("device %s: processing failed", self.device_id, exc_info=error, extra=device)
        self.failure = f"processing failed: {type(error).__name__}: {error}"
        if self.reader is not None:
            self.reader.close_driver()
        self.poses.remove(self.device_id)
        self.holds.fail(self.device_id, f"the device failed: {self.failure}")
        self.streams.publish_status(self.device_id, "failed", self.failure)

    @property
    def active_calibration(self) -> ActiveCalibration:
        """What its newest batch was processed with."""
        return self.processor.active_calibration

    @property
    def method(self) -> Method | None:
        """How its peaks are found; None: nothing reads its scans."""
        return self.processor.detection.method

    @property
    def search_model(self) -> SearchModel:
        """What its peaks are found with."""
        return self.processor.detection.search_model

    @property
    def last_sequence(self) -> int:
        """Sequence number of the newest frame; -1 before the first."""
        return self.ring.last_sequence

    @property
    def frames_dropped(self) -> int:
        """Frames that taps lack, since nobody took them in time."""
        return self.ring.dropped

    def peak_settings(self) -> dict[str, Any]:
        """Return the method of peak detection and its errors as a JSON object."""
        return self.processor.detection.settings()

    @property
    def running(self) -> bool:
        """Whether frames still come, or will when the device is connected again."""
        return self.failure is None and self.reader is not None and self.reader.state == "running"

    @property
    def drained(self) -> bool:
        """Whether all frames are processed and no more will come."""
        if self.stopped or self.failure is not None:
            return True
        return not self.running and self._accounted >= self.ring.received

    @property
    def _accounted(self) -> int:
        """Frames of which no more comes."""
        return self.processed + self._skipped + self.ring.dropped

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
        if state != "running":
            return state, reason, link
        if link is None:
            remark = self.processor.remark or self.active_calibration.nominal_remark
            return state, reason or self.reader.preparation or remark, link
        if link.state == "disconnected":
            return "disconnected", link.reason, link
        return state, link.reason or self.processor.remark, link

    def publish_status(self) -> None:
        """Tell the clients its state."""
        state, reason, link = self._standing()
        description = self.description if state == "running" else None
        self.streams.publish_status(
            self.device_id, state, reason, link.state if link else None, description
        )

    def publish_change(self) -> None:
        """Tell the clients its state behind its last frames; hold its beams when it is lost."""
        # Not those that come meanwhile: other devices wait.
        received = self.ring.received
        while self._accounted < received and self.work():
            pass
        if not self.connected:
            self.poses.remove(self.device_id)
            if not self.stopped:
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
            *self.processor.calibration_ids,
            self.ring.received,
            self.ring.lost,
            self.ring.dropped,
            self.processed,
            self.streams.subscribers(self.device_id),
            link,
            self.frames_not_tracked_count,
            self.processor.radiometric_id,
            self.processor.active_calibration.bad_pixels,
        )


BOUNDS_S: Final = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
"""Upper bounds of the classes [s]; one more, without a bound, follows."""


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

    def counts(self) -> tuple[tuple[int, ...], float]:
        """Return the batches in each class of BOUNDS_S and behind it, and the sum [s]."""
        return tuple(self._counts), self._sum_s


@dataclass
class ToolCounts:
    """Counts of one tool.

    Args:
        frames: frames by the status of its pose.
        newest_ns: exposure of the newest frame with a pose of it that is OK, on the host's clock
            [ns]; None: there was none.
    """

    frames: Counter[PoseStatus] = field(default_factory=Counter)
    newest_ns: int | None = None


class PoseCounters:
    """Frames by tool and pose status; counted where frames are processed, read by any thread."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._tools: dict[str, ToolCounts] = {}

    def count(self, poses: Iterable[ToolPose]) -> None:
        """Count the poses of a batch."""
        with self._lock:
            for pose in poses:
                tool = self._tools.setdefault(pose.tool, ToolCounts())
                tool.frames[pose.status] += 1
                if pose.valid:
                    tool.newest_ns = pose.exposure_ns

    def keep(self, tools: Iterable[str]) -> None:
        """Forget all tools but these."""
        with self._lock:
            self._tools = {name: self._tools[name] for name in tools if name in self._tools}

    def counts(self) -> dict[str, ToolCounts]:
        """Return the counts so far, by tool."""
        with self._lock:
            return {
                name: replace(one, frames=one.frames.copy()) for name, one in self._tools.items()
            }
