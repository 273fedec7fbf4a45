"""Frames of a recording to look at: points, recorded or worked out now; scans with their peaks."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter, InvalidRecording
from compute.flags import flag_names
from compute.reconstruction.point_batch import PointBatch, PointFlag
from compute.signal.centroid_reference import find_peaks_reference
from compute.signal.centroid_settings import MAX_PIXELS, MIN_PIXELS
from compute.signal.fit.fit_reference import fit_scans
from compute.signal.peaks import PeakBatch, PeakFlag
from service.api.line_scans.live_scans import check_sensor, describe_scan
from service.api.line_scans.peak_search import line_peaks
from service.api.line_scans.schema import DeviceScans, LinePeak
from service.api.recordings.schema import RecordedFrame, RecordedFrames, RecordedPoint
from service.pipeline.detection_stage import SearchModel, nominal_search_model, peak_method

if TYPE_CHECKING:
    from hardware.recording.frame_block import FrameBlock
    from hardware.recording.reader import RecordingReader

MAX_FRAMES: Final = 256


@dataclass(frozen=True, eq=False)
class FrameResults:
    """Results of one frame that were worked out now.

    Args:
        points: its points, N of them.
        tracks: tracks as JSON values; None: markers and tools are not tracked.
        tools: poses of tools as JSON values; None: likewise.
    """

    points: PointBatch
    tracks: list[dict[str, Any]] | None = None
    tools: list[dict[str, Any]] | None = None


Recalculate = Callable[["RecordingReader", int, int], Sequence[FrameResults]]
"""Works out the results of the frames from a number on, and before another."""


def recorded_frames(
    path: Path,
    name: str,
    first: int,
    count: int,
    calibration_id: str | None = None,
    recalculate: Recalculate | None = None,
) -> RecordedFrames:
    """Return frames of a recording with their points.

    Args:
        path: the file.
        name: the recording.
        first: number of the first frame, from 0; behind the end there are none.
        count: how many, at most.
        calibration_id: of another calibration that results are worked out with; None: those of
            the recording.
        recalculate: works results out; None: they are those that were found live.

    Raises:
        InvalidRecording: it cannot be read, or is damaged.
        InvalidParameter: as ``recalculate``.
    """
    with _reader(path) as reader:
        total = reader.info.frames
        end = min(first + count, total)
        names = tuple(sensor.name for sensor in reader.info.description.sensors)
        frames: list[RecordedFrame] = []
        if first < end:
            block = reader.block(first, end)
            frame_results = (
                _live_results(block) if recalculate is None else recalculate(reader, first, end)
            )
            for number, (row, results) in enumerate(
                zip(block.rows.tolist(), frame_results, strict=True), first
            ):
                sequence, _, host_ns, marker, *_rest = row
                frames.append(
                    RecordedFrame.model_validate(
                        {
                            "number": number,
                            "sequence": sequence,
                            "exposure_ns": host_ns,
                            "marker": _marker(marker),
                            "points": _points(results.points, _marker(marker), names),
                            "tracks": results.tracks,
                            "tools": results.tools,
                        }
                    )
                )
        return RecordedFrames(
            recording_id=name,
            calibration_id=calibration_id,
            frames_written=total,
            frames=frames,
        )


def recorded_scans(path: Path, name: str, number: int, detail_sensor: str | None) -> DeviceScans:
    """Return the scans of a recorded frame, and their peaks as they were found live.

    Where peaks were not recorded they are found now, by the device's method. Levels and fits are
    those without a radiometric calibration.

    Raises:
        InvalidRecording: it cannot be read, is damaged, or has no scans to search for peaks.
        InvalidParameter: it has no such frame, or no such sensor.
    """
    with _reader(path) as reader:
        info = reader.info
        if not 0 <= number < info.frames:
            raise InvalidParameter(
                f'number is {number}; recording "{name}" has the frames 0 to {info.frames - 1}'
            )
        block = reader.block(number, number + 1)
    if block.lines is None:
        raise InvalidRecording(f'recording "{name}" holds results only, and no scans to be shown')
    description = info.description
    pixels = block.lines.shape[-1]
    if not MIN_PIXELS <= pixels <= MAX_PIXELS:
        raise InvalidRecording(
            f'recording "{name}" has scans of {pixels} pixels; peaks are searched in {MIN_PIXELS} '
            f"to {MAX_PIXELS}"
        )
    names = [sensor.name for sensor in description.sensors]
    check_sensor(detail_sensor, names)
    model = nominal_search_model(description)
    lines = block.lines[0]
    peaks = _recorded_peaks(block, len(names)) if info.results else _peaks(lines, model)
    sequence, _, host_ns, marker, *_ = block.rows[0].tolist()
    return DeviceScans(
        device_id=description.name,
        sequence=sequence,
        exposure_ns=host_ns,
        marker=_marker(marker),
        method=peak_method(description),
        radiometric_id=None,
        scans=[
            describe_scan(
                name,
                sensor,
                lines[sensor],
                peaks[sensor],
                model,
                detail=name == detail_sensor,
            )
            for sensor, name in enumerate(names)
        ],
    )


def _reader(path: Path) -> "RecordingReader":
    # The file library is loaded by who reads a recording.
    from hardware.recording.reader import RecordingReader

    return RecordingReader(path, columns=False)


def _marker(number: int) -> int | None:
    return None if number < 0 else number


def _live_results(block: "FrameBlock") -> list[FrameResults]:
    """Return the points of each frame of a block as they were found live."""
    rows = block.points
    none = np.full(len(rows), np.inf)  # what a point's reliability was is not recorded
    points = PointBatch(
        rows["position_mm"],
        rows["covariance_mm2"],
        rows["chi2"],
        none,
        rows["used"].astype(np.bool_),
        rows["flags"],
    )
    ends = rows["frame"].searchsorted(range(len(block.rows) + 1)).tolist()
    return [FrameResults(points.part(low, high)) for low, high in pairwise(ends)]


def _points(points: PointBatch, marker: int | None, names: tuple[str, ...]) -> list[RecordedPoint]:
    """Return the points of a frame."""
    residuals = points.residual_sigma().tolist()
    return [
        RecordedPoint(
            marker=marker,
            position_mm=one.position_mm,
            covariance_mm2=one.covariance_mm2,
            residual_sigma=residual if isfinite(residual) else None,
            sensors=list(one.sensors),
            flags=flag_names(PointFlag(flags)),
        )
        for one, residual, flags in zip(
            points.estimates(names), residuals, points.flags.tolist(), strict=True
        )
    ]


def _recorded_peaks(block: "FrameBlock", sensors: int) -> list[list[LinePeak]]:
    """Return the recorded peaks of the one frame of a block, by sensor."""
    found: list[list[LinePeak]] = [[] for _ in range(sensors)]
    for row in block.peaks:
        if not 0 <= int(row["sensor"]) < sensors:
            raise InvalidRecording("the recording has peaks of sensors that there are not")
        found[int(row["sensor"])].append(LinePeak(**dict(_members(row))))
    return found


def _members(row: np.void) -> Iterator[tuple[str, Any]]:
    for name in ("position_px", "sigma_px", "amplitude", "width_px", "reduced_chi2"):
        value = float(row[name])
        yield name, value if isfinite(value) else None
    yield "response_sigma", None
    yield "flags", flag_names(PeakFlag(int(row["flags"])))


def _peaks(lines: NDArray[np.uint16], model: SearchModel) -> list[list[LinePeak]]:
    """Return the peaks of a frame's scans, by sensor, found now."""
    batch: PeakBatch
    if model.fit is not None:
        batch = fit_scans(lines, model.fit, model.noise, model.shape)
    elif model.search is not None:
        batch = find_peaks_reference(lines, model.search, model.noise)
    else:
        return [[] for _ in lines]
    return [line_peaks(batch, sensor) for sensor in range(len(lines))]
