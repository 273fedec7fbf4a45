"""`lumiline readings`: the readings of a recording as CSV for calibrate, wand, map and drift."""

import csv
import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import numpy as np
import typer
from numpy.typing import NDArray
from pydantic import TypeAdapter

from compute.errors import InvalidParameter
from service.api.captures.averaging import average
from service.api.captures.schema import Target
from service.cli.json_files import read_json, validate
from service.cli.options import AsJson, Force, refuse_unused
from service.cli.output import check_output, print_json, progress, say, write_file
from service.problems.errors import NoObservation, TargetMoved

if TYPE_CHECKING:
    from hardware.recording.reader import RecordingReader

Array = NDArray[np.float64]

MIN_STILL_CYCLES: Final = 10
"""Fewest strobe cycles of a still period."""
_TARGETS: Final = TypeAdapter(list[Target])
_SEEN_SHARE: Final = 0.8
"""Share of a period in which a sensor must have seen the marker, as in a capture session."""


@dataclass(frozen=True, eq=False)
class StrobeCycles:
    """Readings of a recording by strobe cycle; a cycle is one exposure where nothing is strobed.

    Args:
        sensors: names of the S sensors.
        readings_px: of the M strobed markers, or of the only one, shape (C, M, S) [px]; NaN where
            not seen.
        sigma_px: likewise [px].
        strobed: whether the markers are strobed.
    """

    sensors: tuple[str, ...]
    readings_px: Array
    sigma_px: Array
    strobed: bool


def readings(
    context: typer.Context,
    recording: Annotated[Path, typer.Argument(help="HDF5 file of a recording.")],
    output: Annotated[Path, typer.Option(help="CSV file to write.")],
    targets: Annotated[
        Path | None,
        typer.Option(
            help='Known positions as JSON: [{"name": "P1", "position_mm": [0, 0, 1500], "marker": '
            "0}, ...]. Without markers: the still periods are the targets, in order."
        ),
    ] = None,
    still: Annotated[
        bool, typer.Option("--still", help="Average each period in which the markers rest.")
    ] = False,
    still_px: Annotated[
        float,
        typer.Option(min=0.001, help=r"Largest change of a reading within a still period \[px]."),
    ] = 0.5,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Write control points (with --targets) or poses and markers, for `lumiline wand`, as CSV."""
    check_output(output, force=force)
    target_points = None if targets is None else _read_targets(targets)
    if target_points is not None:
        refuse_unused(context, "with --targets, which are averaged always", "still")
        if any(one.marker is not None for one in target_points):
            refuse_unused(context, "for targets with markers", "still_px")
    elif not still:
        refuse_unused(context, "without --still or --targets", "still_px")
    with progress("finding peaks", 1.0, quiet=as_json) as report:
        cycles = read_cycles(recording, report)
    if target_points is None:
        rows = _poses(cycles, still_px) if still else _every_cycle(cycles)
        heading = ["pose", "marker"]
    else:
        rows = _control_points(cycles, target_points, still_px)
        heading = ["name", "X_mm", "Y_mm", "Z_mm"]
    if not rows:
        raise InvalidParameter(
            f"{recording} has no period of {MIN_STILL_CYCLES} strobe cycles in which all readings "
            f"stay within {still_px:g} px; give a larger --still-px, or leave out --still"
        )
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    ends = ("_px", "_sigma_px")
    writer.writerow([*heading, *(f"{name}{end}" for name in cycles.sensors for end in ends)])
    for identifiers, values, sigma in rows:
        pairs = np.column_stack([values, sigma]).ravel().tolist()
        writer.writerow([*identifiers, *("" if np.isnan(cell) else repr(cell) for cell in pairs)])
    write_file(output, text.getvalue().encode(), quiet=as_json)
    if as_json:
        cycle_count = len(cycles.readings_px)
        print_json({"file": str(output), "rows": len(rows), "strobe_cycles": cycle_count})
        return
    say(f"{len(rows)} rows, {len(cycles.readings_px)} strobe cycles of {recording}")


_Row = tuple[list[object], Array, Array]


def recorded_readings(
    reader: "RecordingReader", report: Callable[[float], None]
) -> Iterator[tuple[int, int | None, Array, Array]]:
    """Yield of each exposure its device time [ns], lit marker, readings and sigmas (S,) [px].

    Args:
        reader: of the recording.
        report: called with the share of the frames processed.

    Raises:
        InvalidRecording: the file is damaged, or holds no scans.
    """
    from service.api.recordings.reprocessing import reprocess
    from service.pipeline.active_calibration import NO_ACTIVE_CALIBRATION
    from service.pipeline.frame_processor import FrameProcessor
    from service.pipeline.taps import clear_readings

    sensors = len(reader.info.description.sensors)
    processor = FrameProcessor("readings", reader.info.description, "cpu")
    count = 0
    for batch in reprocess(reader, processor, given=NO_ACTIVE_CALIBRATION):
        for index, frame in enumerate(batch.frames):
            lines = slice(index * sensors, (index + 1) * sensors)
            read = clear_readings(batch, lines, strobed=frame.marker is not None)
            yield frame.exposure_device_ns, frame.marker, *read
        count += len(batch.frames)
        report(count / max(reader.info.frames, 1))


def read_cycles(path: Path, report: Callable[[float], None]) -> StrobeCycles:
    """Return the readings of a recording by strobe cycle.

    Raises:
        InvalidRecording: the file is damaged, or holds no scans.
    """
    # The file library and the kernels are loaded by who reads a recording.
    from hardware.recording.reader import RecordingReader

    with RecordingReader(path) as reader:
        description = reader.info.description
        names = tuple(sensor.name for sensor in description.sensors)
        shape = (2, max(1, description.markers), len(names))
        cycles: list[Array] = []
        filled: set[int] = set()
        for _, lit, position, sigma in recorded_readings(reader, report):
            if description.markers and lit is None:
                continue  # all are lit: nothing says which peak is whose
            marker = lit or 0
            if not cycles or marker in filled:
                cycles.append(np.full(shape, np.nan))
                filled = set()
            cycles[-1][:, marker] = position, sigma
            filled.add(marker)
    both = np.array(cycles).reshape(-1, *shape)
    return StrobeCycles(names, both[:, 0], both[:, 1], description.markers > 0)


def still_periods(readings_px: Array, limit_px: float) -> list[slice]:
    """Return the periods in which all readings stay within a limit.

    Args:
        readings_px: shape (C, ...) [px]; NaN where not seen.
        limit_px: largest difference of two readings of a period [px].
    """
    flat = readings_px.reshape(len(readings_px), -1)
    periods = []
    start = 0
    low = high = np.full(flat.shape[1], np.nan)
    for index, row in enumerate(flat):
        low, high = np.fmin(low, row), np.fmax(high, row)
        if (high - low > limit_px).any():
            periods.append(slice(start, index))
            start, low, high = index, row, row
    periods.append(slice(start, len(flat)))
    return [one for one in periods if one.stop - one.start >= MIN_STILL_CYCLES]


def _average(cycles: StrobeCycles, period: slice, marker: int, name: str) -> tuple[Array, Array]:
    mean = average(
        cycles.readings_px[period, marker], cycles.sigma_px[period, marker], cycles.sensors,
        _SEEN_SHARE, name,
    )  # fmt: skip
    return mean.mean_px, np.where(np.isfinite(mean.mean_px), mean.sigma_px, np.nan)


def _every_cycle(cycles: StrobeCycles) -> list[_Row]:
    return [
        ([pose, marker], cycles.readings_px[pose - 1, marker - 1], sigma)
        for pose, sigmas in enumerate(cycles.sigma_px, start=1)
        for marker, sigma in enumerate(sigmas, start=1)
    ]


def _poses(cycles: StrobeCycles, limit_px: float) -> list[_Row]:
    """Return the mean readings of each marker in each still period; numbers from 1."""
    rows: list[_Row] = []
    pose = 0
    for period in _rests(cycles, limit_px):
        pose_rows: list[_Row] = []
        for marker in range(cycles.readings_px.shape[1]):
            try:
                mean = _average(cycles, period, marker, f"marker {marker + 1}")
            except NoObservation:
                continue
            pose_rows.append(([pose + 1, marker + 1], *mean))
        rows += pose_rows
        pose += bool(pose_rows)
    return rows


def _rests(cycles: StrobeCycles, limit_px: float) -> list[slice]:
    """Return the still periods without those in which a marker creeps."""
    return [one for one in still_periods(cycles.readings_px, limit_px) if _at_rest(cycles, one)]


def _at_rest(cycles: StrobeCycles, period: slice) -> bool:
    columns = 0
    for marker in range(cycles.readings_px.shape[1]):
        try:
            _average(cycles, period, marker, "")
        except TargetMoved:
            return False
        except NoObservation:
            continue
        columns += 1
    return columns > 0


def _control_points(cycles: StrobeCycles, targets: Sequence[Target], limit_px: float) -> list[_Row]:
    """Return the mean readings of each target; raises InvalidParameter."""
    strobed = [one for one in targets if one.marker is not None]
    markers = cycles.readings_px.shape[1] if cycles.strobed else 0
    periods: Sequence[slice] = [slice(0, len(cycles.readings_px))] * len(targets)
    if strobed:
        for one in targets:
            if one.marker is None or one.marker >= markers:
                said = "none" if one.marker is None else str(one.marker)
                raise InvalidParameter(
                    f'target "{one.name}" has the marker {said}; the recording strobes '
                    f"{f'the markers 0 to {markers - 1}' if markers else 'no markers'}: give each "
                    "target one of them, or none to any"
                )
    elif markers > 1:
        raise InvalidParameter(
            f"the recording strobes the markers 0 to {markers - 1}; give each target its `marker`"
        )
    else:
        periods = _rests(cycles, limit_px)
        if len(periods) != len(targets):
            raise InvalidParameter(
                f"the recording has {len(periods)} still periods of {MIN_STILL_CYCLES} exposures "
                f"and more within {limit_px:g} px, and there are {len(targets)} targets; list the "
                "targets in the order of the visits, or change --still-px"
            )
    return [
        ([one.name, *one.position_mm], *_average(cycles, period, one.marker or 0, one.name))
        for one, period in zip(targets, periods, strict=True)
    ]


def _read_targets(path: Path) -> list[Target]:
    content = read_json(path)
    listed = content.get("targets", content) if isinstance(content, dict) else content
    return validate(
        _TARGETS, listed, path, "no targets",
        'a target is {"name": "P1", "position_mm": [0, 0, 1500]}, with its strobed "marker" if it '
        "has one, as a capture session's",
    )  # fmt: skip
