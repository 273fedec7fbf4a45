"""RecordingPipeline: points, tracks and tool poses of a recording's frames, in their order."""

from collections import deque
from collections.abc import Hashable, Iterator
from typing import TYPE_CHECKING, Final

from compute.errors import InvalidRecording
from service.api.recordings.playback import FrameResults
from service.api.recordings.recorded_peaks import process_block
from service.api.recordings.reprocessing import calibration_of_row
from service.pipeline.active_calibration import NO_ACTIVE_CALIBRATION, ActiveCalibration
from service.pipeline.detection_stage import ExpectedScans, FindProfile, expected_scans
from service.pipeline.frame_batch import FrameBatch, pose_members, track_members
from service.pipeline.frame_processor import MAX_FRAMES, FrameProcessor
from service.pipeline.tracking_config import TrackingConfig

if TYPE_CHECKING:
    from hardware.recording.reader import RecordingReader

LEAD_FRAMES: Final = 512
"""Frames before those of a request, in which tracks begin and tools are acquired."""
ACQUISITION_FRAMES: Final = LEAD_FRAMES // 2
"""Frames of the lead whose results are incomplete; those of the others are as good as any."""
MAX_KEPT_FRAMES: Final = 256
"""Frames whose results are kept, and up to a batch more: a player asks for some of them again."""


class RecordingPipeline:
    """Runs the stages of the live pipeline over a recording as a player goes through it.

    Frames that follow those of before continue their tracks and tools; others begin anew,
    LEAD_FRAMES before.

    Args:
        reader: the recording.
        calibration: takes the place of the recording's; None: those of the recording, frame by
            frame.
        tracking: the markers and tools to track.
        model: expected scans of the recorded device.
    """

    def __init__(
        self,
        reader: "RecordingReader",
        calibration: ActiveCalibration | None,
        tracking: TrackingConfig,
        model: ExpectedScans,
    ) -> None:
        self.calibration = calibration
        """What takes the place of the recording's calibrations."""
        self.model = model
        """Expected scans of the recorded device."""
        self._lead = 0 if tracking.nothing else LEAD_FRAMES
        description = reader.info.description
        self._processor = FrameProcessor("recording", description, "cpu", model)
        self._processor.set_tracking_config(tracking)
        self._batches: deque[tuple[int, FrameBatch]] = deque()
        self._first = self._end = 0
        self._row: int | None = None
        self._track_offset = self._max_track = 0

    @property
    def max_track(self) -> int:
        """Highest number of its tracks; 0: there were none."""
        return self._max_track + self._track_offset

    def distance(self, first: int) -> int | None:
        """Return how far a frame is from where the pipeline is; None: that needs a restart."""
        return abs(first - self._end) if self._first <= first <= self._end + self._lead else None

    def results(
        self, reader: "RecordingReader", first: int, end: int, min_track: int = 0
    ) -> list[FrameResults]:
        """Return the results of frames, in order.

        Args:
            reader: the recording, which may have grown.
            first: number of the first frame.
            end: number behind the last one; the recording has as many frames.
            min_track: tracks that begin after a restart have at least this number.

        Raises:
            InvalidRecording: it is damaged, or has neither peaks nor scans.
            InvalidParameter: the calibration is of other sensors.
        """
        if self.distance(first) is None or not self._batches:
            self._track_offset = max(self._track_offset, min_track - 1 - self._max_track)
            self._restart(max(0, first - self._lead))
            if self._end:
                self._first = min(first, self._end + ACQUISITION_FRAMES)
        while self._end < first:
            stop = min(self._end + MAX_FRAMES, first)
            try:
                self._advance(reader, stop)
                self._forget(self._end - MAX_KEPT_FRAMES)
            except InvalidRecording:
                # Frames behind the damage are sound, and no one asks for those in it.
                self._restart(stop)
        while self._end < end:
            self._advance(reader, min(self._end + MAX_FRAMES, end))
        self._forget(min(first, self._end - MAX_KEPT_FRAMES))
        return [
            self._results(batch, number - start)
            for start, batch in self._batches
            for number in range(max(first, start), min(end, start + len(batch.frames)))
        ]

    def _restart(self, begin: int) -> None:
        """Forget all frames; go on at another one."""
        self._batches.clear()
        self._first = self._end = begin
        # Trackers go on where calibrations differ in their bad pixels only.
        self._processor.set_calibration(NO_ACTIVE_CALIBRATION)
        self._row = None

    def _advance(self, reader: "RecordingReader", end: int) -> None:
        """Process frames up to the next change of the calibration, ``end`` at most."""
        block = reader.block(self._end, end)
        rows = block.rows["active_calibration"]
        block = block.select((rows == rows[0]).cumprod(dtype="bool"))
        row = int(rows[0])
        if row != self._row:
            self._processor.set_calibration(calibration_of_row(reader, row, self.calibration))
            self._row = row
        info = reader.info
        batch = process_block(block, self._processor, info.description, from_scans=not info.results)
        self._batches.append((self._end, batch))
        self._end += len(batch.frames)
        if batch.motion is not None and len(batch.motion.tracks):
            self._max_track = max(self._max_track, int(batch.motion.tracks.identity.max()))

    def _forget(self, before: int) -> None:
        """Forget the results of batches that lie before a frame."""
        while self._batches and self._batches[0][0] + len(self._batches[0][1].frames) <= before:
            start, batch = self._batches.popleft()
            self._first = max(self._first, start + len(batch.frames))

    def _results(self, batch: FrameBatch, frame: int) -> FrameResults:
        """Return the results of one frame of a batch."""
        motion = batch.motion
        if motion is None:
            return FrameResults(batch.points_of(frame))
        low, high = motion.track_owner.searchsorted((frame, frame + 1)).tolist()
        tracks = track_members(motion.tracks, slice(low, high))
        return FrameResults(
            batch.points_of(frame),
            [track | {"id": track["id"] + self._track_offset} for track in tracks],
            [pose_members(pose) for pose in motion.poses_of(frame)],
        )


class RecordingPipelines:
    """Pipelines at several positions of several recordings, for players that do not wait.

    Args:
        max_pipelines: how many there are at most.
    """

    def __init__(self, max_pipelines: int) -> None:
        self._max_pipelines = max_pipelines
        self._pipelines: list[tuple[Hashable, RecordingPipeline]] = []  # the last used at the end

    def __iter__(self) -> Iterator[RecordingPipeline]:
        """Yield the pipelines, the last used at the end."""
        return (pipeline for _, pipeline in self._pipelines)

    def results(
        self,
        key: Hashable,
        reader: "RecordingReader",
        first: int,
        end: int,
        calibration: ActiveCalibration | None,
        tracking: TrackingConfig,
        find_profile: FindProfile,
    ) -> list[FrameResults]:
        """Return the results of frames by the pipeline that is nearest to them.

        Where none can continue at the first frame a further one begins there, or the least
        recently used one makes room.

        Args:
            key: what the results depend on: the recording, the calibration and the tracking.
            reader: the recording.
            first: number of the first frame.
            end: number behind the last one; the recording has as many frames.
            calibration: as of RecordingPipeline.
            tracking: likewise.
            find_profile: returns the device profiles that descriptions name.

        Raises:
            InvalidRecording, InvalidParameter: as of RecordingPipeline.
        """
        same = [pipeline for other, pipeline in self._pipelines if other == key]
        distances = [(distance, pipeline) for pipeline in same
                     if (distance := pipeline.distance(first)) is not None]  # fmt: skip
        min_track = max((pipeline.max_track for pipeline in same), default=0) + 1
        if distances:
            pipeline = min(distances, key=lambda one: one[0])[1]
        elif len(self._pipelines) == self._max_pipelines and self._pipelines[0][0] == key:
            pipeline = self._pipelines[0][1]
        else:
            description = reader.info.description
            model = same[0].model if same else expected_scans(description, find_profile)
            pipeline = RecordingPipeline(reader, calibration, tracking, model)
        # One that fails is not kept: what it tracked is not complete.
        self._pipelines = [one for one in self._pipelines if one[1] is not pipeline]
        results = pipeline.results(reader, first, end, min_track)
        self._pipelines.append((key, pipeline))
        del self._pipelines[: -self._max_pipelines]
        return results
