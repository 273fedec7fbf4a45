"""Motion table of a recording: points, tracks and poses as the live pipeline makes them."""

from collections.abc import Callable, Sequence

from compute.errors import InvalidRecording
from compute.pose.rigid_body import RigidBody
from hardware.recording.reader import RecordingReader
from service.api.devices.tracking_settings import Tracking
from service.api.exports.motion_table import MotionTable
from service.api.exports.table_builder import TableBuilder
from service.api.recordings.recorded_peaks import reprocess_peaks
from service.api.recordings.recorded_tracking import recorded_tracking
from service.api.recordings.reprocessing import reprocess
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.detection_stage import FindProfile, built_in_profile, expected_scans
from service.pipeline.frame_processor import FrameProcessor


def table_from_recording(
    reader: RecordingReader,
    tools: Sequence[RigidBody] = (),
    given: ActiveCalibration | None = None,
    done: Callable[[int], None] = lambda _: None,
    tracking: Tracking | None = None,
    find_profile: FindProfile = built_in_profile,
) -> MotionTable:
    """Return the results of a recording's frames, stored or computed now.

    From the peaks that were found live, where they were recorded, else from the lines: both give
    the same bits.

    Args:
        reader: the recording.
        tools: whose poses are wanted.
        given: what to reconstruct with; None: the calibration that was active, frame by frame.
        done: called with the number of frames that are done.
        tracking: how markers and tools are followed; None: by default.
        find_profile: returns the device profile that the recording names.

    Raises:
        InvalidRecording: it holds no calibration and none is given, or something is damaged.
        InvalidParameter: the calibration is of other sensors.
    """
    info = reader.info
    if given is None and info.state.active_calibrations == 0:
        raise InvalidRecording(
            "the recording holds no calibration; give one: `calibration_id`, or --calibration"
        )
    description = info.description
    model = expected_scans(description, find_profile)
    processor = FrameProcessor("export", description, "cpu", model)
    how = Tracking() if tracking is None else tracking
    processor.set_tracking_config(recorded_tracking(how, tools))
    builder = TableBuilder(
        description.name, description.frame_rate_hz, [tool.name for tool in tools]
    )
    used: list[str] = []
    batches = (
        reprocess_peaks(reader, processor, given)
        if info.results
        else reprocess(reader, processor, given=given)
    )
    for batch in batches:
        builder.add(batch)
        if batch.calibration_id and batch.calibration_id not in used:
            used.append(batch.calibration_id)
        done(len(builder))
    return builder.build({"calibration": " ".join(used)})
