"""`lumiline record`: records line scans of a simulated device to a file without a server."""

import signal
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.cli.json_files import SimulationOption, read_settings
from service.cli.output import console, fail, file_errors, progress

if TYPE_CHECKING:
    from hardware.simulated.driver import RenderedDriver


def record(
    output: Annotated[Path, typer.Argument(help="HDF5 file to write.")],
    seconds: Annotated[float, typer.Option(min=0.001, help="Duration.")] = 5.0,
    settings: SimulationOption = None,
    device: Annotated[
        str | None, typer.Option(help="A device profile: optotrak, ..., or a TOML file.")
    ] = None,
) -> None:
    """Record line scans of the simulated bar, or of a profile's device, to a file."""
    from hardware.recording.writer import RecordingWriter

    if output.exists():
        raise fail(f"{output} exists; choose another name, a recording is never overwritten")
    with file_errors(output, ""):
        if device is None:
            driver, doing = _simulated(settings, seconds), "recording"
        else:
            driver, doing = _profile(device, settings, seconds), "tracing the optics, recording"
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
    console.print(f"written: {output}")


def _simulated(settings: Path | None, seconds: float) -> "RenderedDriver":
    from hardware.simulated.driver import SimulatedDriver
    from hardware.simulated.settings import SimulationSettings

    chosen = read_settings(SimulationSettings, settings)
    return SimulatedDriver("sim", replace(chosen, realtime=False, duration_s=seconds))


def _profile(device: str, settings: Path | None, seconds: float) -> "RenderedDriver":
    from compute.optics.profiles.profile_loader import load_profile
    from hardware.simulated.profile_driver import ProfileDriver
    from hardware.simulated.profile_settings import ProfileSettings

    profile = load_profile(device)
    chosen = read_settings(ProfileSettings, settings)
    return ProfileDriver(profile.name, profile, replace(chosen, realtime=False, duration_s=seconds))
