"""Recorded peaks as they were when they were found, and the stages behind detection over them."""

from collections.abc import Iterator
from typing import Final

import numpy as np

from compute.errors import InvalidRecording
from compute.signal.peaks import PeakBatch, number_within_scan
from hardware.driver import DeviceDescription
from hardware.line_frame import FrameFlag, LineFrame
from hardware.recording.frame_block import FrameBlock
from hardware.recording.layout import NO_MARKER
from hardware.recording.reader import RecordingReader
from service.api.recordings.reprocessing import calibration_intervals
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.frame_batch import FrameBatch
from service.pipeline.frame_processor import MAX_FRAMES, FrameProcessor

_OF_PEAKS: Final = (
    "position_px",
    "sigma_px",
    "amplitude",
    "width_px",
    "flags",
    "reduced_chi2",
    "covariance_px2",
)


def reprocess_peaks(
    reader: RecordingReader, processor: FrameProcessor, given: ActiveCalibration | None
) -> Iterator[FrameBatch]:
    """Yield a recording's frames as ``reprocess`` does, from its peaks; the arguments are its."""
    for first, end, found in calibration_intervals(reader, given):
        processor.set_calibration(found)
        for start in range(first, end, MAX_FRAMES):
            block = reader.block(start, min(start + MAX_FRAMES, end))
            yield process_block(block, processor, reader.info.description)


def process_block(
    block: FrameBlock,
    processor: FrameProcessor,
    description: DeviceDescription,
    *,
    from_scans: bool = False,
) -> FrameBatch:
    """Run the stages behind detection over the recorded peaks of up to MAX_FRAMES frames.

    Args:
        block: the frames.
        processor: of their device.
        description: of the device.
        from_scans: find the peaks now, in the scans.

    Raises:
        InvalidRecording: the peaks are of sensors that there are not, or there are no scans.
    """
    # Their lines are not needed any more.
    none = np.empty((0, 0), np.uint16)
    frames = [
        LineFrame(
            description.name,
            sequence,
            device_ns,
            host_ns,
            None if marker == NO_MARKER else marker,
            none,
            FrameFlag(flags),
        )
        for sequence, device_ns, host_ns, marker, flags, *_ in block.rows.tolist()
    ]
    if not from_scans:
        return processor.process_peaks(frames, peak_batch(block, len(description.sensors)))
    if block.lines is None:
        raise InvalidRecording("the recording has neither peaks nor scans to find them in")
    peaks = processor.detection.find(np.concatenate(block.lines))
    return processor.process_peaks(frames, peaks)


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
    found = PeakBatch.empty(lines, max(1, int(count.max(initial=0))))
    found.count[:] = count
    number = number_within_scan(line)
    for name in _OF_PEAKS:
        getattr(found, name)[line, number] = rows[name]
    return found
