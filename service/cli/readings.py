"""`lumiline readings`: the readings of a recording as CSV for calibrate, wand, map and drift."""

import csv
import io
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import typer
from numpy.typing import NDArray
from pydantic import TypeAdapter

from compute.errors import InvalidParameter
from service.api.captures.averaging import AveragedReading
from service.api.captures.schema import CaptureSettings, Target
from service.api.recordings.recorded_readings import (
    MIN_STILL_CYCLES,
    StrobeCycles,
    average_period,
    read_cycles,
    rests,
    target_readings,
)
from service.cli.json_files import read_json, validate
from service.cli.options import AsJson, Force, refuse_unused
from service.cli.output import check_output, print_json, progress, say, write_file
from service.problems.errors import NoObservation

Array = NDArray[np.float64]

_TARGETS: Final = TypeAdapter(list[Target])
SEEN_SHARE: Final = CaptureSettings().seen_share
"""Share of a period in which a sensor must have seen the marker, as in a capture session."""


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
        found = target_readings(cycles, target_points, still_px, SEEN_SHARE)
        rows = [
            ([one.name, *one.position_mm], *_columns(mean))
            for one, mean in zip(target_points, found, strict=True)
        ]
        heading = ["name", "X_mm", "Y_mm", "Z_mm"]
    if not rows:
        raise InvalidParameter(
            f"{recording} has no period of {MIN_STILL_CYCLES} strobe cycles in which all readings "
            f"stay within {still_px:g} px; give a larger --still-px, or leave out --still"
        )
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    ends = ("_px", "_sigma_px")
    writer.writerow([*heading, *(f"{name}{end}" for name in cycles.names for end in ends)])
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


def _columns(mean: AveragedReading) -> tuple[Array, Array]:
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
    for period in rests(cycles, limit_px, SEEN_SHARE):
        pose_rows: list[_Row] = []
        for marker in range(cycles.readings_px.shape[1]):
            try:
                mean = average_period(cycles, period, marker, f"marker {marker + 1}", SEEN_SHARE)
            except NoObservation:
                continue
            pose_rows.append(([pose + 1, marker + 1], *_columns(mean)))
        rows += pose_rows
        pose += bool(pose_rows)
    return rows


def _read_targets(path: Path) -> list[Target]:
    content = read_json(path)
    listed = content.get("targets", content) if isinstance(content, dict) else content
    return validate(
        _TARGETS, listed, path, "no targets",
        'a target is {"name": "P1", "position_mm": [0, 0, 1500]}, with its strobed "marker" if it '
        "has one, as a capture session's",
    )  # fmt: skip
