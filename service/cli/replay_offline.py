"""Replays a recording through a calibration, offline, and compares it with the live results."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TextIO

import typer
from pydantic import ValidationError

from compute.errors import InvalidRecording, LumilineError
from service.cli.active_calibration_files import read_active_calibration
from service.cli.output import console, fail, print_json, progress


def run_replay(
    path: Path, calibration: Path | None, table: Path | None, output: Path | None
) -> None:
    """Replay a recording; print one JSON message a frame.

    Args:
        path: the recording.
        calibration: JSON file; None: what was active when it was recorded.
        table: correction table of that calibration.
        output: file; None: standard output.
    """
    from hardware.recording.reader import RecordingReader
    from service.api.recordings.reprocessing import reprocess
    from service.pipeline.frame_processor import FrameProcessor
    from service.protocols.stream.messages import StreamBatch, encode, frame_messages

    try:
        with RecordingReader(path) as reader, _output(output) as target:
            given = read_active_calibration(calibration, table)
            if given is None and reader.info.state.in_force == 0:
                raise InvalidRecording(
                    f"{path.name} holds no calibration; give one with --calibration"
                )
            processor = FrameProcessor("replay", reader.info.description, "cpu")
            count = 0
            with progress("replaying", reader.info.frames) as done:
                for batch in reprocess(reader, processor, given=given):
                    for message in frame_messages(StreamBatch(batch), frozenset({"points"})):
                        target.write(f"{encode(message, 'json')!s}\n")
                    count += len(batch.frames)
                    done(count)
    except BrokenPipeError:
        # The reader of our output has gone, `| head` for example; nothing is left to say.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ValidationError) as error:
        raise fail(str(error)) from error
    except LumilineError as error:
        raise fail(error.detail) from error


def run_check(path: Path, batch_frames: int, *, as_json: bool) -> None:
    """Process a recording again, and say whether it gives what was recorded live, bit by bit."""
    from hardware.recording.reader import RecordingReader
    from service.api.recordings.reprocessing import compare
    from service.pipeline.frame_processor import FrameProcessor

    try:
        with (
            RecordingReader(path) as reader,
            progress("comparing", reader.info.frames, quiet=as_json) as done,
        ):
            processor = FrameProcessor("replay", reader.info.description, "cpu")
            found = compare(reader, processor, batch_frames, done)
    except LumilineError as error:
        raise fail(error.detail) from error
    if as_json:
        print_json(asdict(found) | {"same": found.same})
    else:
        console.print(
            f"{found.frames} frames, {found.peaks} peaks, {found.points} points: "
            + ("the same in every bit" if found.same else "not the same"),
            highlight=False,
        )
        for line in found.settings_differ:
            console.print(f"how peaks are found: {line}", highlight=False)
        if not found.same:
            console.print(
                f"frames with other peaks: {found.peaks_differ}, with other points: "
                f"{found.points_differ}; the first is {found.first_difference}",
                highlight=False,
            )
    if not found.same:
        raise typer.Exit(1)


@contextmanager
def _output(path: Path | None) -> Iterator[TextIO]:
    if path is None:
        yield typer.get_text_stream("stdout")
    else:
        with path.open("w", encoding="utf-8") as file:
            yield file
