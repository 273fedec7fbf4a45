"""Line scans without a server: recorded to a file, and replayed through a calibration."""

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

import typer
from pydantic import TypeAdapter, ValidationError

from compute.errors import InvalidParameter, LumilineError
from service.cli.calibration_file import read_calibration
from service.cli.output import console, fail, progress

if TYPE_CHECKING:
    from hardware.simulated.driver import RenderedDriver


def run_record(output: Path, seconds: float, settings: Path | None, device: str | None) -> None:
    """Record the line scans of the simulated bar, or of a profile's device, to a file."""
    from hardware.recording import RecordingWriter

    if output.exists():
        raise fail(f"{output} exists; choose another name, a recording is never overwritten")
    try:
        given = None if settings is None else settings.read_bytes()
        if device is None:
            driver, doing = _simulated(given, seconds), "recording"
        else:
            driver, doing = _profile(device, given, seconds), "tracing the optics, recording"
        driver.open()
        total = max(1, int(seconds * driver.description.frame_rate_hz))
        with (
            RecordingWriter(output, driver.description) as writer,
            progress(doing, total) as done,
        ):
            # Ctrl-C ends the frames, so that the file is closed whole and can be read.
            interrupted = signal.signal(signal.SIGINT, lambda *_: driver.close())
            try:
                for count, frame in enumerate(driver.frames(), start=1):
                    writer.append(frame)
                    done(count)
            finally:
                signal.signal(signal.SIGINT, interrupted)
    except OSError as error:
        raise fail(f"{error.filename or output}: {error.strerror or error}") from error
    except ValidationError as error:
        wrong = (f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors())
        raise fail(f"{settings}: {'; '.join(wrong)}") from error
    except LumilineError as error:
        raise fail(error.detail) from error
    console.print(f"written: {output}")


def _simulated(given: bytes | None, seconds: float) -> "RenderedDriver":
    from hardware.simulated.driver import SimulatedDriver
    from hardware.simulated.settings import SimulationSettings

    chosen = TypeAdapter(SimulationSettings).validate_json(given or b"{}")
    return SimulatedDriver("sim", replace(chosen, realtime=False, duration_s=seconds))


def _profile(device: str, given: bytes | None, seconds: float) -> "RenderedDriver":
    from compute.optics.profiles.loader import load_profile
    from hardware.simulated.profile_driver import ProfileDriver
    from hardware.simulated.profile_settings import ProfileSettings

    profile = load_profile(device)
    chosen = TypeAdapter(ProfileSettings).validate_json(given or b"{}")
    return ProfileDriver(profile.name, profile, replace(chosen, realtime=False, duration_s=seconds))


def run_replay(path: Path, calibration: Path, table: Path | None, output: Path | None) -> None:
    """Replay a recording through a calibration; print one JSON message a frame."""
    from hardware.replay import ReplayDriver
    from service.correction_tables.hdf5 import read_table
    from service.live.messages import encode, frame_messages
    from service.live.processor import MAX_FRAMES, DeviceProcessor

    try:
        known = read_calibration(calibration)
        corrections = None if table is None else read_table(table.read_bytes()).table
        if corrections is not None and corrections.calibration_hash != known.content_hash:
            raise InvalidParameter(
                f"the table {table} was made for the calibration with the hash "
                f"{corrections.calibration_hash}; {calibration} has {known.content_hash}"
            )
        driver = ReplayDriver("replay", path, speed=None)
        driver.open()
        processor = DeviceProcessor("replay", driver.description, "cpu")
        processor.set_calibration(
            str(calibration), known.calibration, None if table is None else str(table), corrections
        )
        with _output(output) as target, progress("replaying") as done:
            frames, count = driver.frames(), 0
            while batch := list(islice(frames, MAX_FRAMES)):
                for message in frame_messages(processor.process(batch), frozenset({"points"})):
                    target.write(f"{encode(message, 'json')!s}\n")
                count += len(batch)
                done(count)
        driver.close()
    except BrokenPipeError:
        # The reader of our output has gone, `| head` for example; nothing is left to say.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ValidationError) as error:
        raise fail(str(error)) from error
    except LumilineError as error:
        raise fail(error.detail) from error


@contextmanager
def _output(path: Path | None) -> Iterator[TextIO]:
    if path is None:
        yield typer.get_text_stream("stdout")
    else:
        with path.open("w", encoding="utf-8") as file:
            yield file
