"""`lumiline replay`: replays a recording offline, and compares it with the live results."""

import os
import sys
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from pydantic import ValidationError

from compute.errors import InvalidRecording
from service.cli.json_files import read_active_calibration
from service.cli.options import (
    AsJson,
    CalibrationOption,
    Force,
    TableOption,
    refuse_unused,
)
from service.cli.output import (
    atomic_file,
    check_output,
    fail,
    print_json,
    progress,
    say,
)


def replay(
    context: typer.Context,
    recording: Annotated[Path, typer.Argument(help="HDF5 file of a recording.")],
    calibration: CalibrationOption = None,
    table: TableOption = None,
    output: Annotated[
        Path | None, typer.Option(help="File to write; left out: standard output.")
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Compare with the recorded results, bit by bit.")
    ] = False,
    batch: Annotated[
        int, typer.Option(min=1, max=64, help="Of --check: frames that are processed together.")
    ] = 64,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Replay a recording; print one JSON message a frame, or whether it gives the live results."""
    if check:
        why = "with --check, which compares what was recorded"
        refuse_unused(context, why, "calibration", "table", "output", "force")
        _check(recording, batch, as_json=as_json)
        return
    refuse_unused(context, "without --check", "batch")
    refuse_unused(context, "without --check: what is printed is JSON", "as_json")
    if output is None:
        refuse_unused(context, "without --output", "force")
    check_output(output, force=force)
    try:
        _replay(recording, calibration, table, output)
    except BrokenPipeError:
        # The reader of our output has gone, `| head` for example; nothing is left to say.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ValidationError) as error:
        raise fail(str(error)) from error


def _replay(path: Path, calibration: Path | None, table: Path | None, output: Path | None) -> None:
    from hardware.recording.reader import RecordingReader
    from service.api.recordings.reprocessing import reprocess
    from service.pipeline.frame_processor import FrameProcessor
    from service.protocols.stream.messages import StreamBatch, encode

    with RecordingReader(path) as reader, ExitStack() as stack:
        target = typer.get_text_stream("stdout")
        if output is not None:
            target = stack.enter_context(
                stack.enter_context(atomic_file(output)).open("w", encoding="utf-8")
            )
        active = read_active_calibration(calibration, table)
        if active is None and reader.info.state.active_calibrations == 0:
            raise InvalidRecording(f"{path.name} holds no calibration; give one with --calibration")
        processor = FrameProcessor("replay", reader.info.description, "cpu")
        report = stack.enter_context(progress("replaying", reader.info.frames))
        count = 0
        for batch in reprocess(reader, processor, given=active):
            for message in StreamBatch(batch).messages(frozenset({"points"})):
                target.write(f"{encode(message, 'json')!s}\n")
            count += len(batch.frames)
            report(count)


def _check(path: Path, batch_frames: int, *, as_json: bool) -> None:
    """Process a recording again, and say whether it gives what was recorded live, bit by bit."""
    from hardware.recording.reader import RecordingReader
    from service.api.recordings.reprocessing import compare
    from service.pipeline.frame_processor import FrameProcessor

    with (
        RecordingReader(path) as reader,
        progress("comparing", reader.info.frames, quiet=as_json) as report,
    ):
        processor = FrameProcessor("replay", reader.info.description, "cpu")
        result = compare(reader, processor, batch_frames, report)
    if as_json:
        print_json(asdict(result) | {"same": result.same})
    else:
        say(
            f"{result.frames} frames, {result.peaks} peaks, {result.points} points: "
            + ("the same in every bit" if result.same else "not the same")
        )
        for line in result.settings_differ:
            say(f"how peaks are found: {line}")
        if not result.same:
            say(
                f"frames with other peaks: {result.peaks_differ}, with other points: "
                f"{result.points_differ}; the first is {result.first_difference}"
            )
    if not result.same:
        raise typer.Exit(1)
