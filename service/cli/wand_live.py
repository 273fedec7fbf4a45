"""Live display of a waved wand's coverage: what is covered, what is missing, and when to end."""

import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Final

from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from compute.calibration.self_calibration.targets import Recording, Wand
from compute.calibration.self_calibration.uncalibrated_start import uncalibrated_start
from compute.calibration.self_calibration.wave_coverage import (
    FIRST_CAMERAS_POSES,
    GROWTH,
    MIN_CELL_READINGS,
    WaveCoverage,
    wave_coverage,
)
from compute.camera.model import SensorModel
from compute.errors import LumilineError
from service.cli.observations_csv import ReadingTable
from service.cli.output import console, make_table, progress_console
from service.cli.wand_sources import LiveWand

EVERY_S: Final = 0.5
MAX_LINES: Final = 8


def wave_live(
    source: LiveWand,
    target: Wand,
    cameras: Sequence[SensorModel] | None,
    seconds: float,
    every_s: float = EVERY_S,
    *,
    quiet: bool = False,
) -> ReadingTable:
    """Collect poses, show their coverage as it grows, and return them when they are enough.

    Ctrl-C and the end of the time return what there is.

    Args:
        source: the device.
        target: the wand.
        cameras: approximate cameras; None: computed from the readings as soon as these suffice.
        seconds: how long at most.
        every_s: time between two looks [s].
        quiet: show it on standard error, as standard output is for machines.
    """
    start_s = time.monotonic()
    estimate = _EstimatedCameras(source) if cameras is None else None
    screen = progress_console if quiet else console
    with Live(Text("Wave the wand."), console=screen, auto_refresh=False) as live:
        try:
            for table in source.collect(seconds, every_s):
                if cameras is not None:
                    table = table.in_order_of(cameras)
                recording = Recording(target, table.readings_px, table.sigma_px)
                current_cameras = cameras if estimate is None else estimate.of(recording)
                coverage = wave_coverage(
                    source.sensors if current_cameras is None else current_cameras,
                    recording,
                    current_cameras,
                )
                remaining_s = max(0.0, seconds - (time.monotonic() - start_s))
                live.update(_display(coverage, remaining_s), refresh=True)
                if coverage.enough:
                    break
        except KeyboardInterrupt:
            pass
    return source.table()


class _EstimatedCameras:
    """Cameras from the readings so far, computed again now and then."""

    def __init__(self, source: LiveWand) -> None:
        self._sensors = source.sensors
        self._due = FIRST_CAMERAS_POSES
        self._models: tuple[SensorModel, ...] | None = None

    def of(self, recording: Recording) -> tuple[SensorModel, ...] | None:
        if len(recording.readings_px) >= self._due:
            self._due = int(GROWTH * len(recording.readings_px))
            # Where they are not enough yet, the next time tells.
            with suppress(LumilineError):
                self._models = uncalibrated_start(self._sensors, [recording]).models
        return self._models


def show_coverage(coverage: WaveCoverage) -> None:
    """Print what a wave has covered, and what is missing.

    Args:
        coverage: of the wave.
    """
    console.print(_table(coverage))
    for sentence in coverage.missing:
        console.print(f"missing: {sentence}", style="yellow", markup=False, highlight=False)


def _display(coverage: WaveCoverage, remaining_s: float) -> Group:
    lines = list(coverage.missing[:MAX_LINES])
    if len(coverage.missing) > MAX_LINES:
        lines.append(f"and {len(coverage.missing) - MAX_LINES} more")
    if not lines:
        lines = ["Enough."]
    text = "\n".join(lines) + f"\n{remaining_s:.0f} s left; Ctrl-C ends."
    return Group(_table(coverage), Text(text))


def _table(coverage: WaveCoverage) -> Table:
    rows = [
        (
            one.sensor,
            "".join("#" if n >= MIN_CELL_READINGS else "." for n in one.cells),
            one.readings,
        )
        for one in coverage.sensors
    ]
    title = f"{coverage.poses} of {coverage.wanted_poses} poses"
    if coverage.directions is not None and coverage.extent_mm is not None:
        along = " ".join(f"{value:.2f}" for value in coverage.directions)
        size = " x ".join(f"{value:.0f}" for value in coverage.extent_mm)
        title += f"; directions x y z {along} (all round: 0.58); volume {size} mm"
    return make_table(("sensor", "pixels, first to last", "readings"), rows, title, texts=2)
