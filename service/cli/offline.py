"""Jobs without a server: calibrate from a CSV file, record and replay line scans."""

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Final, TextIO, get_args

import typer
from pydantic import TypeAdapter, ValidationError
from rich.table import Table

from compute.calibration.crossvalidation import fitted_errors, leave_one_out
from compute.calibration.result import AxisErrors, Calibration
from compute.calibration.run import calibrate
from compute.calibration.settings import CalibrationSettings, Method
from compute.camera.model import SensorGeometry
from compute.errors import LumilineError
from service.calibrations.schema import LEAVE_ONE_OUT_POINTS
from service.cli.observations_csv import read_observations
from service.cli.output import console, error_table, fail, progress, progress_console

if TYPE_CHECKING:
    from hardware.simulated.driver import RenderedDriver

DOCUMENT = TypeAdapter(Calibration)
METHODS: Final[tuple[Method, ...]] = get_args(Method)


def run_calibrate(path: Path, pixels: int, method: str, output: Path | None) -> None:
    """Calibrate from a CSV file; print the fit, and write the calibration as JSON."""
    chosen: Method | None = next((known for known in METHODS if known == method), None)
    if chosen is None:
        raise fail(f'the method is "{method}"; it must be {" or ".join(METHODS)}')
    try:
        table = read_observations(path)
        sensors = [SensorGeometry(name, pixels) for name in table.sensors]
        arrays = table.points_mm, table.readings_px
        found = calibrate(*arrays, sensors, table.sigma_px, CalibrationSettings(chosen))
        rows = [("fitted", AxisErrors.of(fitted_errors(found, *arrays, table.sigma_px)), "")]
        if len(table.points_mm) <= LEAVE_ONE_OUT_POINTS:
            with progress_console.status("leaving out one point after another"):
                left_out = leave_one_out(
                    *arrays, sensors, table.sigma_px, CalibrationSettings(chosen)
                )
            rows.append(("leave one out", AxisErrors.of(left_out), ""))
    except LumilineError as error:
        raise fail(error.detail) from error
    fits = Table(title=f"{path}: {len(table.points_mm)} points, {method}", title_justify="left")
    for heading in ("sensor", "points", "rms, px", "max, px", "c, px", "p0, px"):
        fits.add_column(heading, justify="left" if heading == "sensor" else "right")
    for fit in found.sensors:
        model = fit.model
        fits.add_row(
            model.name,
            str(fit.points),
            f"{fit.rms_px:.4g}",
            f"{fit.max_px:.4g}",
            f"{model.principal_distance_px:.2f}",
            f"{model.principal_point_px:.2f}",
        )
    console.print(fits)
    if all(errors.points for _, errors, _ in rows):
        console.print(error_table("control points, absolute errors in mm", rows))
    else:
        console.print("fewer than three sensors saw each point: no points were reconstructed")
    if output is not None:
        try:
            output.write_bytes(DOCUMENT.dump_json(found, indent=2) + b"\n")
        except OSError as error:
            raise fail(f"{output} cannot be written: {error.strerror}") from error
        console.print(f"written: {output}")


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


def run_replay(path: Path, calibration: Path, output: Path | None) -> None:
    """Replay a recording through a calibration; print one JSON message a frame."""
    from hardware.replay import ReplayDriver
    from service.live.messages import encode, frame_messages
    from service.live.processor import MAX_FRAMES, DeviceProcessor

    try:
        known = DOCUMENT.validate_json(calibration.read_bytes())
        driver = ReplayDriver("replay", path, speed=None)
        driver.open()
        processor = DeviceProcessor("replay", driver.description, "cpu")
        processor.set_calibration(str(calibration), known)
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
