"""`lumiline drift`: checks a calibration by stationary markers, without a server."""

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import typer
from rich.table import Table

from compute.calibration.drift.calibration_update import update_calibration
from compute.calibration.drift.drift_detection import DriftCheck, check_drift
from compute.calibration.drift.stability_check import StationaryMarkers
from compute.calibration.result import Calibration
from compute.errors import InvalidParameter, LumilineError
from service.api.drift_checks.messages import in_words, verdict_of
from service.cli.calibrate import write_calibration
from service.cli.calibration_file import read_calibration
from service.cli.observations_csv import ObservationTable, read_observations
from service.cli.output import console, fail, print_json

EXIT_DRIFTED = 1
"""Exit code where the calibration does not hold, and no update was asked for."""


@dataclass(frozen=True)
class DriftOptions:
    """What the command is asked for beside its files.

    Args:
        position_sigma_mm: deviation of the markers' coordinates.
        sensors: names of those that an update may change, separated by commas; None: all.
        as_json: print for machines.
    """

    position_sigma_mm: float
    sensors: str | None
    as_json: bool


def run(
    path: Path,
    calibration: Path,
    earlier: Path | None,
    options: DriftOptions,
    output: Path | None,
) -> None:
    """Check a calibration by still markers; write it brought up to date where that is asked."""
    try:
        found = read_calibration(calibration).calibration
        still = _still_set(path, earlier, found, options.position_sigma_mm)
        check = check_drift(found, still)
        updated = None
        if output is not None:
            names = None if options.sensors is None else options.sensors.replace(",", " ").split()
            updated = update_calibration(found, still, sensors=names)
    except LumilineError as error:
        raise fail(error.detail) from error
    if options.as_json:
        print_json({"verdict": verdict_of(check), "in_words": in_words(check), **asdict(check)})
    else:
        console.print(_sensor_table(check, f"{path}: {len(still.readings_px)} markers"))
        for sentence in in_words(check):
            console.print(sentence, highlight=False)
    if output is not None and updated is not None:
        write_calibration(output, updated)
    elif not check.good:
        raise typer.Exit(EXIT_DRIFTED)


def _still_set(
    path: Path, earlier: Path | None, calibration: Calibration, position_sigma_mm: float
) -> StationaryMarkers:
    """Return the markers of one file, or of two.

    Raises:
        InvalidParameter: other sensors than the calibration's, or two files of other markers.
    """
    now = read_observations(path)
    readings, sigma = _in_order(path, now, calibration)
    if earlier is None:
        return StationaryMarkers(readings, sigma, now.points_mm, position_sigma_mm)
    before = read_observations(earlier)
    if not np.array_equal(before.points_mm, now.points_mm):
        raise InvalidParameter(
            f"{path} has {len(now.points_mm)} markers and {earlier} {len(before.points_mm)}, or "
            "at other places; both must have the same markers in the same rows"
        )
    then, then_sigma = _in_order(earlier, before, calibration)
    return StationaryMarkers(readings, sigma, earlier_px=then, earlier_sigma_px=then_sigma)


def _in_order(
    path: Path, table: ObservationTable, calibration: Calibration
) -> tuple[np.ndarray, np.ndarray]:
    """Return readings and sigma in the order of the calibration's sensors, (N, S) [px].

    Readings without a deviation take the calibration's.
    """
    names = tuple(model.name for model in calibration.models)
    if set(table.sensors) != set(names):
        raise InvalidParameter(
            f"{path} has readings of {', '.join(table.sensors)}; the calibration is of "
            f"{', '.join(names)}"
        )
    order = [table.sensors.index(name) for name in names]
    readings = table.readings_px[:, order]
    own = np.array([fit.sigma_px for fit in calibration.sensors])
    if table.sigma_px is None:
        return readings, np.broadcast_to(own, readings.shape)
    sigma = table.sigma_px[:, order]
    return readings, np.where(np.isfinite(sigma), sigma, own)


def _sensor_table(check: DriftCheck, title: str) -> Table:
    table = Table(title=title, title_justify="left")
    for heading in ("sensor", "readings", "off, px RMS", "p", "moved"):
        table.add_column(heading, justify="left" if heading == "sensor" else "right")
    for one in check.sensors:
        moved = "yes" if one.moved else "no"
        table.add_row(
            one.sensor, str(one.readings), f"{one.rms_px:.3g}", f"{one.p_value:.2g}", moved
        )
    return table
