"""`lumiline drift`: checks a calibration by stationary markers, without a server."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from compute.calibration.drift.calibration_update import update_calibration
from compute.calibration.drift.drift_detection import check_drift
from compute.calibration.drift.stability_check import StationaryMarkers
from compute.calibration.result import Calibration
from compute.errors import InvalidParameter
from service.api.drift_checks.messages import in_words, verdict_of
from service.cli.calibrate import write_calibration
from service.cli.json_files import read_calibration
from service.cli.observations_csv import ObservationTable, read_observations
from service.cli.options import AsJson, Force, PositionSigma, refuse_unused
from service.cli.output import check_output, console, make_table, print_json, progress, say

EXIT_DRIFTED = 1
"""Exit code where the calibration does not hold, and no update was asked for."""


def drift(
    context: typer.Context,
    markers: Annotated[
        Path, typer.Argument(help="CSV of still markers, read now: X_mm,Y_mm,Z_mm,NAME_px,...")
    ],
    calibration: Annotated[
        Path, typer.Option(help="Calibration as JSON, from `calibrate` or the service.")
    ],
    earlier: Annotated[
        Path | None,
        typer.Option(help="CSV of the same markers as they read when it was made: finer."),
    ] = None,
    position_sigma: PositionSigma = 0.0,
    output: Annotated[
        Path | None, typer.Option(help="Write the calibration, brought up to date, as JSON.")
    ] = None,
    update_sensors: Annotated[
        str | None, typer.Option(help="Sensors that may have changed, as 'A,B'; left out: all.")
    ] = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Check a calibration by still markers; write it brought up to date where that is asked."""
    check_output(output, force=force)
    if output is None:
        refuse_unused(context, "without --output", "update_sensors", "force")
    if earlier is not None:
        refuse_unused(context, "with --earlier, which tells readings apart", "position_sigma")
    checked = read_calibration(calibration).calibration
    still = _stationary_markers(markers, earlier, checked, position_sigma)
    updated = None
    with progress("comparing", quiet=as_json):
        check = check_drift(checked, still)
        if output is not None:
            names = None if update_sensors is None else update_sensors.replace(",", " ").split()
            updated = update_calibration(checked, still, sensors=names)
    if as_json:
        print_json({"status": verdict_of(check), "in_words": in_words(check), **asdict(check)})
    else:
        rows = (
            (one.sensor, one.readings, f"{one.rms_px:.3g}", f"{one.p_value:.2g}",
             "yes" if one.moved else "no")
            for one in check.sensors
        )  # fmt: skip
        headings = ("sensor", "readings", "off, px RMS", "p", "moved")
        console.print(make_table(headings, rows, f"{markers}: {len(still.readings_px)} markers"))
        for sentence in in_words(check):
            say(sentence)
    if output is not None and updated is not None:
        write_calibration(output, updated, quiet=as_json)
    elif not check.good:
        raise typer.Exit(EXIT_DRIFTED)


def _stationary_markers(
    path: Path, earlier: Path | None, calibration: Calibration, position_sigma_mm: float
) -> StationaryMarkers:
    """Return the markers of one file, or of two; raises InvalidParameter."""
    now = read_observations(path).in_order_of(calibration.models)
    sigma = _sigma_px(now, calibration)
    if earlier is None:
        return StationaryMarkers(now.readings_px, sigma, now.points_mm, position_sigma_mm)
    before = read_observations(earlier).in_order_of(calibration.models)
    if not np.array_equal(before.points_mm, now.points_mm):
        raise InvalidParameter(
            f"{path} has {len(now.points_mm)} markers and {earlier} {len(before.points_mm)}, or "
            "at other positions; both must have the same markers in the same rows"
        )
    return StationaryMarkers(
        now.readings_px, sigma, earlier_px=before.readings_px,
        earlier_sigma_px=_sigma_px(before, calibration),
    )  # fmt: skip


def _sigma_px(table: ObservationTable, calibration: Calibration) -> np.ndarray:
    """Return the readings' standard deviations, (N, S) [px]; the calibration's where not given."""
    fitted = np.array([fit.sigma_px for fit in calibration.sensors])
    if table.sigma_px is None:
        return np.broadcast_to(fitted, table.readings_px.shape)
    return np.where(np.isfinite(table.sigma_px), table.sigma_px, fitted)
