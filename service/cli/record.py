"""`lumiline record`: records a simulated device with its calibration, without a server."""

import signal
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from compute.errors import LumilineError
from service.cli.json_files import read_settings
from service.cli.options import AsJson, Force, ProfileOption, SimulationOption
from service.cli.output import (
    atomic_file,
    check_output,
    fail,
    file_errors,
    hint,
    print_json,
    progress,
    say_written,
)

if TYPE_CHECKING:
    from compute.calibration.result import Calibration
    from hardware.simulated.driver import RenderedDriver


def record(
    output: Annotated[Path, typer.Argument(help="HDF5 file to write.")],
    seconds: Annotated[float, typer.Option(min=0.001, help="Duration.")] = 5.0,
    simulation: SimulationOption = None,
    profile: ProfileOption = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Record line scans of the simulated bar, or of a profile's device, to a file.

    The file also holds the simulated device's nominal calibration, so that it can be replayed and
    exported as it is.
    """
    from hardware.recording.layout import NO_CALIBRATION_ROW
    from hardware.recording.writer import RecordingWriter
    from service.api.recordings.active_calibration_file import dump_active_calibration
    from service.pipeline.active_calibration import ActiveCalibration

    check_output(output, force=force)
    if output.exists() and not output.is_file():
        raise fail(f"{output} is a pipe or a device; a recording is written to a file")
    with file_errors(output, ""):
        if profile is None:
            (driver, calibration), doing = _simulated(simulation, seconds), "recording"
        else:
            with progress("tracing the optics", quiet=as_json):
                driver, calibration = _profile(profile, simulation, seconds)
            doing = "tracing the scene, recording"
        driver.open()
        description = driver.description
        total = max(1, int(seconds * description.frame_rate_hz))
        count = 0
        with (
            atomic_file(output) as temporary,
            RecordingWriter(temporary, description) as writer,
            progress(doing, total, quiet=as_json) as report,
        ):
            row = NO_CALIBRATION_ROW
            if calibration is not None:
                active = ActiveCalibration(f"{description.name}-nominal", calibration)
                row = writer.put_active_calibration(*dump_active_calibration(active))
            # Ctrl-C ends the frames, so that the file is closed whole and can be read.
            interrupted = signal.signal(signal.SIGINT, lambda *_: driver.close())
            try:
                for frame in driver.frames():
                    writer.append(frame, row)
                    count += 1
                    report(count)
            finally:
                signal.signal(signal.SIGINT, interrupted)
    if as_json:
        print_json({
            "file": str(output),
            "device": description.name,
            "frames": count,
            "calibration": calibration is not None,
        })  # fmt: skip
    else:
        say_written(output)


def _simulated(
    simulation: Path | None, seconds: float
) -> "tuple[RenderedDriver, Calibration | None]":
    from hardware.simulated.driver import SimulatedDriver
    from hardware.simulated.settings import SimulationSettings
    from service.application.initial_content import nominal_calibration

    chosen = read_settings(SimulationSettings, simulation)
    driver = SimulatedDriver("sim", replace(chosen, realtime=False, duration_s=seconds))
    return driver, nominal_calibration()


def _profile(
    name: str, simulation: Path | None, seconds: float
) -> "tuple[RenderedDriver, Calibration | None]":
    from compute.optics.profiles.profile_loader import load_profile
    from hardware.simulated.profile_driver import ProfileDriver
    from hardware.simulated.profile_settings import ProfileSettings
    from service.api.devices.nominal_calibration import nominal_calibration

    profile = load_profile(name)
    chosen = replace(read_settings(ProfileSettings, simulation), realtime=False, duration_s=seconds)
    driver = ProfileDriver(profile.name, profile, chosen)
    calibration = None
    if driver.description.readout != "gray-tracks":
        try:
            calibration = nominal_calibration(profile)
        except LumilineError as error:
            hint(f"recorded without a calibration: {error.detail}")
    return driver, calibration
