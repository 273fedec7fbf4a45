"""`lumiline export`: points, tracks and tool poses as a file of another program's format."""

from dataclasses import dataclass
from pathlib import Path

from compute.errors import InvalidParameter, LumilineError
from service.api.exports.formats import suffix_of, write_export
from service.api.exports.from_stream import SUFFIXES, table_from_stream
from service.api.exports.motion_table import MotionTable
from service.api.exports.tool_file import read_device, read_tools
from service.cli.active_calibration_files import read_active_calibration
from service.cli.output import console, fail, progress


@dataclass(frozen=True)
class ExportOptions:
    """What was asked for.

    Args:
        tools: JSON file of the tools whose poses are wanted.
        calibration: JSON file; None: what was active.
        table: correction table of that calibration.
        predicted: keep positions of tracks where nothing was seen.
        points: strobed markers' points in the tracks' place.
        device: JSON file of the device, whose tracking is taken; None: by default.
    """

    tools: Path | None = None
    calibration: Path | None = None
    table: Path | None = None
    predicted: bool = False
    points: bool = False
    device: Path | None = None


def run(source: Path, output: Path, options: ExportOptions) -> None:
    """Export a recording, or a captured stream; what cannot be done ends the command."""
    try:
        # Before minutes of work.
        suffix_of(output)
        if output.exists():
            raise InvalidParameter(f"{output} exists; choose another name")
        captured = source.suffix.lower() in SUFFIXES
        table = _captured(source, options) if captured else _recorded(source, options)
        write_export(table, output, predicted=options.predicted, points=options.points)
    except LumilineError as error:
        raise fail(error.detail) from error
    except OSError as error:
        raise fail(f"{error.filename or output}: {error.strerror or error}") from error
    tracks = len(set(table.tracks.identity.tolist()))
    console.print(
        f"written: {output} ({len(table)} frames, {len(table.points.frame)} points, "
        f"{tracks} tracks, {len(table.tools)} tools)",
        highlight=False,
        soft_wrap=True,
    )


def _captured(source: Path, options: ExportOptions) -> MotionTable:
    for name in ("tools", "device", "calibration", "table"):
        if getattr(options, name) is not None:
            raise InvalidParameter(
                f"--{name} is for recordings; a captured stream has what was found when it was live"
            )
    return table_from_stream(source)


def _recorded(source: Path, options: ExportOptions) -> MotionTable:
    from hardware.recording.reader import RecordingReader
    from service.api.exports.from_recording import table_from_recording

    device = None if options.device is None else read_device(options.device)
    of, tracking = (None, None) if device is None else (device.id, device.tracking)
    tools = () if options.tools is None else read_tools(options.tools, of)
    given = read_active_calibration(options.calibration, options.table)
    with RecordingReader(source) as reader, progress("exporting", reader.info.frames) as done:
        return table_from_recording(reader, tools, given, done, tracking)
