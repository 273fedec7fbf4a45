"""Records line scans of a device to a file without a server."""

import signal
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import TypeAdapter, ValidationError

from compute.errors import LumilineError
from service.cli.output import console, fail, progress

if TYPE_CHECKING:
    from hardware.simulated.driver import RenderedDriver


def run_record(output: Path, seconds: float, settings: Path | None, device: str | None) -> None:
    """Record the line scans of the simulated bar, or of a profile's device, to a file."""
    from hardware.recording.writer import RecordingWriter

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
    from compute.optics.profiles.profile_loader import load_profile
    from hardware.simulated.profile_driver import ProfileDriver
    from hardware.simulated.profile_settings import ProfileSettings

    profile = load_profile(device)
    chosen = TypeAdapter(ProfileSettings).validate_json(given or b"{}")
    return ProfileDriver(profile.name, profile, replace(chosen, realtime=False, duration_s=seconds))
