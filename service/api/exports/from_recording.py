"""Motion table of a recording: points, tracks and poses as the live pipeline makes them."""

from collections.abc import Callable, Iterator, Sequence
from typing import Final

import numpy as np

from compute.errors import InvalidRecording
from compute.pose.rigid_body import RigidBody
from compute.signal.peaks import PeakBatch
from hardware.line_frame import FrameFlag, LineFrame
from hardware.recording.frame_block import FrameBlock
from hardware.recording.layout import NO_MARKER
from hardware.recording.reader import RecordingReader
from service.api.devices.tracking_settings import Tracking
from service.api.exports.motion_table import MotionTable
from service.api.exports.table_builder import TableBuilder
from service.api.recordings.reprocessing import calibration_intervals, reprocess
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.frame_batch import FrameBatch
from service.pipeline.frame_processor import MAX_FRAMES, FrameProcessor
from service.pipeline.tracking_config import TrackingConfig

_OF_PEAKS: Final = (
    "position_px",
    "sigma_px",
    "amplitude",
    "width_px",
    "flags",
    "reduced_chi2",
    "covariance_px2",
)


def table_from_recording(
    reader: RecordingReader,
    tools: Sequence[RigidBody] = (),
    given: ActiveCalibration | None = None,
    done: Callable[[int], None] = lambda _: None,
    tracking: Tracking | None = None,
) -> MotionTable:
    """Return what was found, or is found now, in a recording's frames.

    From the peaks that were found live, where they were recorded, else from the lines: both give
    the same bits.

    Args:
        reader: the recording.
        tools: whose poses are wanted.
        given: what to reconstruct with; None: the calibration that was active, frame by frame.
        done: called with the number of frames that are done.
        tracking: how markers and tools are followed; None: by default.

    Raises:
        InvalidRecording: it holds no calibration and none is given, or something is damaged.
        InvalidParameter: the calibration is of other sensors.
    """
    info = reader.info
    if given is None and info.state.in_force == 0:
        raise InvalidRecording(
            "the recording holds no calibration; give one: `calibration_id`, or --calibration"
        )
    description = info.description
    processor = FrameProcessor("export", description, "cpu")
    how = Tracking() if tracking is None else tracking
    # Tracks always, whether there were any live: they change neither points nor poses.
    codes = None if how.blinking is None else how.blinking.codes()
    processor.set_tracking_config(
        TrackingConfig(True, tuple(tools), how.tracker(), how.tool_tracker(), codes)
    )
    builder = TableBuilder(
        description.name, description.frame_rate_hz, [tool.name for tool in tools]
    )
    used: list[str] = []
    batches = (
        _from_peaks(reader, processor, given)
        if info.results
        else reprocess(reader, processor, given=given)
    )
    for batch in batches:
        builder.add(batch)
        if batch.calibration_id and batch.calibration_id not in used:
            used.append(batch.calibration_id)
        done(len(builder))
    return builder.build({"calibration": " ".join(used)})


def _from_peaks(
    reader: RecordingReader, processor: FrameProcessor, given: ActiveCalibration | None
) -> Iterator[FrameBatch]:
    for first, end, found in calibration_intervals(reader, given):
        processor.set_calibration(found)
        for start in range(first, end, MAX_FRAMES):
            block = reader.block(start, min(start + MAX_FRAMES, end))
            frames = _frames(block, reader.info.description.name)
            yield processor.process_peaks(
                frames, peak_batch(block, len(reader.info.description.sensors))
            )


def _frames(block: FrameBlock, device: str) -> list[LineFrame]:
    """Return frames whose lines are not needed any more."""
    none = np.empty((0, 0), np.uint16)
    return [
        LineFrame(
            device,
            sequence,
            device_ns,
            host_ns,
            None if marker == NO_MARKER else marker,
            none,
            FrameFlag(flags),
        )
        for sequence, device_ns, host_ns, marker, flags, *_ in block.rows.tolist()
    ]


def peak_batch(block: FrameBlock, sensors: int) -> PeakBatch:
    """Return the recorded peaks of F frames as they were when they were found."""
    rows = block.peaks
    lines = len(block.rows) * sensors
    line = rows["frame"] * sensors + rows["sensor"]
    if len(line) and (
        (np.diff(line) < 0).any()
        or int(rows["sensor"].min()) < 0
        or int(rows["sensor"].max()) >= sensors
    ):
        raise InvalidRecording("the recording has peaks in an order, or of sensors, that cannot be")
    count = np.bincount(line, minlength=lines)
    number = np.arange(len(line)) - np.repeat(np.cumsum(count) - count, count)
    found = PeakBatch.empty(lines, max(1, int(count.max(initial=0))))
    found.count[:] = count
    for name in _OF_PEAKS:
        getattr(found, name)[line, number] = rows[name]
    return found
