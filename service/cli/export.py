"""`lumiline export`: points, tracks and tool poses as a file of another program's format."""

from pathlib import Path
from typing import Annotated

import typer

from compute.errors import InvalidParameter
from service.api.exports.formats import suffix_of, write_export
from service.api.exports.from_stream import SUFFIXES, table_from_stream
from service.api.exports.motion_table import MotionTable
from service.cli.json_files import CalibrationOption, TableOption, read_active_calibration
from service.cli.output import Force, atomic_file, check_output, console, file_errors, progress
from service.cli.tracking_files import read_device, read_tools


def export(
    source: Annotated[
        Path, typer.Argument(help="A recording (HDF5), or a stream's JSON messages (.jsonl).")
    ],
    to: Annotated[Path, typer.Option("--to", help="File: .c3d, .trc, .csv, .parquet or .igs.mha.")],
    tools: Annotated[
        Path | None, typer.Option(help="Tools as JSON, as GET /api/v1/tools sends them.")
    ] = None,
    device: Annotated[
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
    force: Force = False,
) -> None:
    """Export a recording, or a captured stream; what cannot be done ends the command."""
    with file_errors(to, ""):
        # Before minutes of work.
        suffix_of(to)
        check_output(to, force=force)
        if source.suffix.lower() in SUFFIXES:
            for name, file in (
                ("tools", tools), ("device", device), ("calibration", calibration), ("table", table)
            ):  # fmt: skip
                if file is not None:
                    raise InvalidParameter(
                        f"--{name} is for recordings; a captured stream has what was found when "
                        "it was live"
                    )
            motion = table_from_stream(source)
        else:
            motion = _from_recording(source, tools, device, calibration, table)
        with atomic_file(to) as temporary:
            write_export(motion, temporary, predicted=predicted, points=points)
    tracks = len(set(motion.tracks.identity.tolist()))
    console.print(
        f"written: {to} ({len(motion)} frames, {len(motion.points.frame)} points, "
        f"{tracks} tracks, {len(motion.tools)} tools)",
        highlight=False,
        soft_wrap=True,
    )


def _from_recording(
    source: Path,
    tools: Path | None,
    device: Path | None,
    calibration: Path | None,
    table: Path | None,
) -> MotionTable:
    from hardware.recording.reader import RecordingReader
    from service.api.exports.from_recording import table_from_recording

    device_id, tracking = None, None
    if device is not None:
        settings = read_device(device)
        device_id, tracking = settings.id, settings.tracking
    bodies = () if tools is None else read_tools(tools, device_id)
    active = read_active_calibration(calibration, table)
    with RecordingReader(source) as reader, progress("exporting", reader.info.frames) as report:
        return table_from_recording(reader, bodies, active, report, tracking)
