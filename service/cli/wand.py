"""`lumiline wand`: calibrates from a wand of known length at unknown positions, offline."""

from pathlib import Path

import numpy as np
from rich.table import Table

from compute.calibration.self_calibration.result import SelfCalibration
from compute.calibration.self_calibration.self_calibrate import self_calibrate
from compute.calibration.self_calibration.targets import Recording, Wand
from compute.errors import InvalidParameter, LumilineError
from service.cli.calibrate import fit_table, write_calibration
from service.cli.calibration_file import read_calibration
from service.cli.observations_csv import read_wand
from service.cli.output import console, fail, progress

MAX_LISTED = 20
"""Most readings left out that are listed."""


def run(path: Path, start: Path, positions: str, sigma_mm: float, output: Path | None) -> None:
    """Calibrate from a wand; print the fit and what was left out, write it as JSON."""
    try:
        target = Wand(_positions(positions), sigma_mm)
        near = read_calibration(start).calibration.models
        table = read_wand(path, len(target))
        names = tuple(model.name for model in near)
        if set(table.sensors) != set(names):
            raise InvalidParameter(
                f"{path} has readings of {', '.join(table.sensors)}; {start} is of "
                f"{', '.join(names)}"
            )
        order = [table.sensors.index(name) for name in names]
        recording = Recording(
            target,
            table.readings_px[..., order],
            None if table.sigma_px is None else table.sigma_px[..., order],
        )
        with progress("calibrating", 1.0) as done:
            found = self_calibrate(near, [recording], progress=lambda share, _stage: done(share))
    except LumilineError as error:
        raise fail(error.detail) from error
    fit = found.targets[0]
    console.print(fit_table(found.calibration, f"{path}: {fit.used} of {fit.poses} poses"))
    if fit.length_error_mm is not None:
        span = float(np.ptp(np.array(target.position_mm)))
        console.print(
            f"the wand of {span:g} mm, marker by marker: {fit.length_error_mm:.3g} mm RMS off",
            highlight=False,
        )
    console.print(
        f"the device is {found.device_scale:.4g} times as large as in {start}; "
        f"chi2 {found.chi2_per_dof:.3g} a degree of freedom",
        highlight=False,
    )
    if found.rejected:
        console.print(_rejected(found))
    if output is not None:
        write_calibration(output, found.calibration)


def _rejected(found: SelfCalibration) -> Table:
    table = Table(title=f"{len(found.rejected)} readings left out", title_justify="left")
    for heading in ("pose", "marker", "sensor", "deviations off"):
        table.add_column(heading)
    for one in found.rejected[:MAX_LISTED]:
        table.add_row(str(one.pose), str(one.marker), one.sensor, f"{one.normalised_residual:.1f}")
    return table


def _positions(text: str) -> tuple[float, ...]:
    """Return the markers' positions.

    Raises:
        InvalidParameter: something that is not a number.
    """
    try:
        return tuple(float(part) for part in text.replace(",", " ").split())
    except ValueError:
        raise InvalidParameter(
            f'places is "{text}"; it must be the markers\' places along the wand in mm, '
            'for example "0 300"'
        ) from None
