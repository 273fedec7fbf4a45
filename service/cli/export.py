"""`lumiline export`: points, tracks and tool poses as a file of another program's format."""

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from service.api.exports.formats import TRAJECTORY_SUFFIXES, suffix_of, write_export
from service.api.exports.from_stream import SUFFIXES, table_from_stream
from service.api.exports.motion_table import MotionTable
from service.cli.json_files import read_active_calibration
from service.cli.options import AsJson, CalibrationOption, Force, TableOption, refuse_unused
from service.cli.output import (
    atomic_file,
    check_output,
    file_errors,
    print_json,
    progress,
    say,
)
from service.cli.tracking_files import read_device, read_tools


def export(
    context: typer.Context,
    source: Annotated[
        Path, typer.Argument(help="A recording (HDF5), or a stream's JSON messages (.jsonl).")
    ],
    output: Annotated[
        Path, typer.Option(help="File to write: .c3d, .trc, .csv, .parquet or .igs.mha.")
    ],
    tools: Annotated[
        Path | None, typer.Option(help="Tools as JSON, as GET /api/v1/tools sends them.")
    ] = None,
    device_file: Annotated[
        Path | None,
        typer.Option(
            help="The device as JSON, as GET /api/v1/devices/{id} sends it: its `tracking`, and "
            "only its tools; left out: defaults, and all tools."
        ),
    ] = None,
    calibration: CalibrationOption = None,
    table: TableOption = None,
    predicted: Annotated[
        bool, typer.Option("--predicted", help="C3D, TRC: no gaps where tracks are predicted.")
    ] = False,
    points: Annotated[
        bool, typer.Option("--points", help="C3D, TRC: strobed markers' points, not tracks.")
    ] = False,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Export a recording, or a captured stream; what cannot be done ends the command."""
    with file_errors(output, ""):
        # Before minutes of work.
        suffix = suffix_of(output)
        check_output(output, force=force)
        if suffix not in TRAJECTORY_SUFFIXES:
            formats = " and ".join(TRAJECTORY_SUFFIXES)
            refuse_unused(context, f"on a {suffix} file, only on {formats}", "predicted", "points")
        if points:
            refuse_unused(context, "with --points, which writes no tracks", "predicted")
        if source.suffix.lower() in SUFFIXES:
            refuse_unused(
                context,
                "on a captured stream, which has what was found when it was live",
                *("tools", "device_file", "calibration", "table"),
            )
            with progress("reading the messages", quiet=as_json):
                motion = table_from_stream(source)
        else:
            motion = _from_recording(source, tools, device_file, calibration, table, quiet=as_json)
        with atomic_file(output) as temporary:
            write_export(motion, temporary, predicted=predicted, points=points)
    counts = {
        "frames": len(motion),
        "points": len(motion.points.frame),
        "tracks": len(set(motion.tracks.identity.tolist())),
        "tools": len(motion.tools),
    }
    if as_json:
        print_json({"file": str(output), **counts})
        return
    contents = ", ".join(f"{count} {name}" for name, count in counts.items())
    say(f"written: {escape(str(output))} ({contents})")


def _from_recording(
    source: Path,
    tools: Path | None,
    device_file: Path | None,
    calibration: Path | None,
    table: Path | None,
    *,
    quiet: bool,
) -> MotionTable:
    from hardware.recording.reader import RecordingReader
    from service.api.exports.from_recording import table_from_recording

    device_id, tracking = None, None
    if device_file is not None:
        settings = read_device(device_file)
        device_id, tracking = settings.id, settings.tracking
    bodies = () if tools is None else read_tools(tools, device_id)
    active = read_active_calibration(calibration, table)
    with (
        RecordingReader(source) as reader,
        progress("exporting", reader.info.frames, quiet=quiet) as report,
    ):
        return table_from_recording(reader, bodies, active, report, tracking)
