"""Reprocesses a recording through the pipeline; compares the results bit by bit."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np

from compute.errors import InvalidRecording
from hardware.recording.frame_block import FrameBlock
from hardware.recording.reader import RecordingReader
from service.api.recordings.active_calibration_file import (
    load_active_calibration,
    load_pixels,
)
from service.api.recordings.result_rows import peak_rows, point_rows
from service.pipeline.active_calibration import NO_ACTIVE_CALIBRATION, ActiveCalibration
from service.pipeline.frame_batch import FrameBatch
from service.pipeline.frame_processor import MAX_FRAMES, FrameProcessor


@dataclass(frozen=True)
class Comparison:
    """Recorded results and those of reprocessing.

    Args:
        frames: frames compared.
        peaks: recorded peaks.
        points: recorded points.
        peaks_differ: frames whose peaks are not the same in every bit.
        points_differ: frames whose points are not.
        first_difference: which frame is the first, and in what; None: there is none.
        settings_differ: what of the peak finding is another now than it was; empty: nothing.
    """

    frames: int
    peaks: int
    points: int
    peaks_differ: int
    points_differ: int
    first_difference: str | None
    settings_differ: tuple[str, ...]

    @property
    def same(self) -> bool:
        """Whether everything is the same."""
        return not (self.peaks_differ or self.points_differ)


def recorded_calibration(reader: RecordingReader, row: int) -> ActiveCalibration:
    """Return the active calibration of a row in the recording; -1: none.

    Raises:
        InvalidRecording, InvalidTableFile: what is there is none, or was changed.
    """
    if row < 0:
        return NO_ACTIVE_CALIBRATION
    document, table = reader.active_calibration(row)
    return load_active_calibration(document, table, "the recording")


def calibration_of_row(
    reader: RecordingReader, row: int, given: ActiveCalibration | None
) -> ActiveCalibration:
    """Return what frames of a row are processed with.

    Args:
        reader: the recording.
        row: of the active calibration; -1: none.
        given: what takes its place, as of ``calibration_intervals``.

    Raises:
        InvalidRecording, InvalidTableFile: what is there is none, or was changed.
    """
    if given is None:
        return recorded_calibration(reader, row)
    document = b"" if row < 0 else reader.active_calibration(row)[0]
    radiometric, bad_pixels = load_pixels(document, "the recording")
    return replace(given, radiometric=radiometric or given.radiometric, bad_pixels=bad_pixels)


def reprocess(
    reader: RecordingReader,
    processor: FrameProcessor,
    batch_frames: int = MAX_FRAMES,
    given: ActiveCalibration | None = None,
) -> Iterator[FrameBatch]:
    """Yield a recording's frames as the live path makes them, in batches.

    Args:
        reader: the recording.
        processor: of its device.
        batch_frames: most frames of a batch.
        given: what to reconstruct with; None: the calibration that was active, frame by frame.

    Raises:
        InvalidRecording: there are no lines, or something is damaged.
        InvalidParameter: the calibration is of other sensors.
    """
    if not reader.info.lines:
        raise InvalidRecording("the recording holds results only; it has no lines to process")
    waiting = reader.frames()
    for first, end, found in calibration_intervals(reader, given):
        processor.set_calibration(found)
        for start in range(first, end, batch_frames):
            yield processor.process(list(islice(waiting, min(batch_frames, end - start))))


def calibration_intervals(
    reader: RecordingReader, given: ActiveCalibration | None = None
) -> Iterator[tuple[int, int, ActiveCalibration]]:
    """Yield intervals of frames with one active calibration: first, end, row.

    Args:
        reader: the recording.
        given: what takes its place; None: nothing does. The radiometric calibration and the bad
            pixels of the recording stay: peaks are found as they were live.

    Raises:
        InvalidRecording, InvalidTableFile: what is there is none, or was changed.
    """
    frames = reader.info.frames
    if given is not None and reader.info.state.active_calibrations == 0:
        if frames:
            yield 0, frames, given
        return
    rows = reader.column("active_calibration")
    changes = np.flatnonzero(np.diff(rows, prepend=rows[:1] - 1)).tolist()
    for first, end in zip(changes, [*changes[1:], frames], strict=True):
        yield first, end, calibration_of_row(reader, int(rows[first]), given)


def compare(
    reader: RecordingReader,
    processor: FrameProcessor,
    batch_frames: int = MAX_FRAMES,
    done: Callable[[int], None] = lambda _: None,
) -> Comparison:
    """Process a recording's lines again, and compare with the results in it bit by bit.

    Args:
        reader: the recording, of lines and results.
        processor: of its device.
        batch_frames: most frames of a batch; the results do not depend on it.
        done: called with the number of frames compared so far.

    Raises:
        InvalidRecording: it lacks lines or results, or something is damaged.
    """
    if not reader.info.results:
        raise InvalidRecording("the recording holds no results to compare with; record them, too")
    frames = peaks = points = peaks_differ = points_differ = 0
    first_difference = None
    for batch in reprocess(reader, processor, batch_frames):
        block = reader.block(frames, frames + len(batch.frames))
        of_peaks, of_points = _differences(block, batch)
        wrong = of_peaks | of_points
        if first_difference is None and wrong.any():
            number = int(wrong.argmax())
            what = "peaks" if of_peaks[number] else "points"
            first_difference = f"frame {frames + number}, in its {what}"
        peaks_differ += int(of_peaks.sum())
        points_differ += int(of_points.sum())
        frames += len(batch.frames)
        peaks += len(block.peaks)
        points += len(block.points)
        done(frames)
    then: dict[str, Any] = reader.info.provenance.get("peaks") or {}
    now = processor.detection.settings()
    changed = tuple(f"{name} was {then.get(name)}, is {now[name]}"
                    for name in now if name in then and then[name] != now[name])  # fmt: skip
    return Comparison(frames, peaks, points, peaks_differ, points_differ, first_difference, changed)


def _differences(
    block: FrameBlock, batch: FrameBatch
) -> tuple[np.ndarray[Any, np.dtype[np.bool_]], np.ndarray[Any, np.dtype[np.bool_]]]:
    """Return which frames differ in their peaks, and which in their points, shape (F,)."""
    made_peaks, peak_count = peak_rows(batch.peaks, len(batch.sensor_names))
    made_points, point_count = point_rows(batch)
    found = []
    for kept, kept_count, made, made_count in (
        (block.peaks, block.rows["peaks"], made_peaks, peak_count),
        (block.points, block.rows["points"], made_points, point_count),
    ):
        kept_ends, made_ends = np.cumsum(kept_count), np.cumsum(made_count)
        wrong = kept_count != made_count
        for number in np.flatnonzero(~wrong):
            of_kept = kept[kept_ends[number] - kept_count[number] : kept_ends[number]]
            of_made = made[made_ends[number] - made_count[number] : made_ends[number]]
            wrong[number] = of_kept.tobytes() != of_made.tobytes()
        found.append(wrong)
    return found[0], found[1]
