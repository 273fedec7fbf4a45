"""`lumiline wand`: calibrates from a wand of known length at unknown positions, offline."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from compute.calibration.self_calibration.self_calibrate import self_calibrate
from compute.calibration.self_calibration.targets import Recording, Wand
from compute.errors import InvalidParameter
from service.cli.calibrate import fit_table, write_calibration
from service.cli.json_files import read_calibration
from service.cli.observations_csv import read_wand
from service.cli.output import console, make_table, progress, say

MAX_LISTED = 20
"""Largest number of rejected readings that are listed."""


def wand(
    readings: Annotated[Path, typer.Argument(help="CSV: pose,marker,NAME_px,...")],
    start: Annotated[
        Path, typer.Option(help="Nearly right cameras: a calibration as JSON, a design's or old.")
    ],
    positions: Annotated[
        str, typer.Option(help=r"Where the markers are along the wand \[mm], as '0 300'.")
    ],
    sigma: Annotated[
        float,
        typer.Option(min=0.0, help=r"Standard deviation of these positions \[mm]; 0: exact."),
    ] = 0.0,
    output: Annotated[Path | None, typer.Option(help="Write the calibration as JSON.")] = None,
) -> None:
    """Calibrate from a wand; print the fit and what was left out, write it as JSON."""
    target = Wand(_positions(positions), sigma)
    initial = read_calibration(start).calibration.models
    table = read_wand(readings, len(target)).in_order_of(initial, str(start))
    recording = Recording(target, table.readings_px, table.sigma_px)
    with progress("calibrating", 1.0) as done:
        result = self_calibrate(initial, [recording], progress=lambda share, _stage: done(share))
    fit = result.targets[0]
    console.print(fit_table(result.calibration, f"{readings}: {fit.used} of {fit.poses} poses"))
    if fit.length_error_mm is not None:
        span = float(np.ptp(np.array(target.position_mm)))
        say(f"the wand of {span:g} mm, marker by marker: {fit.length_error_mm:.3g} mm RMS off")
    say(
        f"the device is {result.device_scale:.4g} times as large as in {start}; "
        f"chi2 {result.chi2_per_dof:.3g} a degree of freedom"
    )
    if result.rejected:
        rows = (
            (one.pose, one.marker, one.sensor, f"{one.normalised_residual:.1f}")
            for one in result.rejected[:MAX_LISTED]
        )
        headings = ("pose", "marker", "sensor", "residual / sigma")
        title = f"{len(result.rejected)} readings left out"
        console.print(make_table(headings, rows, title, texts=None))
    if output is not None:
        write_calibration(output, result.calibration)


def _positions(text: str) -> tuple[float, ...]:
    """Return the markers' positions; raises InvalidParameter."""
    try:
        return tuple(float(part) for part in text.replace(",", " ").split())
    except ValueError:
        raise InvalidParameter(
            f'positions is "{text}"; it must be the markers\' positions along the wand in mm, '
            'for example "0 300"'
        ) from None
