"""`lumiline map`: a correction table from a calibration and mapping measurements, no server."""

from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, cast

import numpy as np
import typer
from rich.markup import escape
from rich.table import Table

from compute.mapping.build import build_table
from compute.mapping.measurements import MappingMeasurements
from compute.mapping.result import MappingMethod, MappingResult, MappingSettings
from service.cli.json_files import read_calibration
from service.cli.observations_csv import read_observations
from service.cli.options import AsJson, Force, PositionSigma
from service.cli.output import (
    atomic_file,
    check_output,
    console,
    make_table,
    print_json,
    progress,
    say,
    say_written,
    spec,
)


def map_volume(
    measurements: Annotated[Path, typer.Argument(help="CSV: X_mm,Y_mm,Z_mm,NAME_px,...")],
    calibration: Annotated[
        Path, typer.Option(help="Calibration as JSON, from `calibrate` or the service.")
    ],
    output: Annotated[Path, typer.Option(help="HDF5 file of the table to write.")],
    method: Annotated[
        str, typer.Option(help="b-spline for points anywhere; trilinear, tricubic for a grid.")
    ] = "b-spline",
    cell: Annotated[
        float | None, typer.Option(help=r"Edge of a cell \[mm]; left out: from the points.")
    ] = None,
    penalty_weight: Annotated[
        float | None, typer.Option(help="Weight of the penalty; left out: by cross-validation.")
    ] = None,
    position_sigma: PositionSigma = 0.0,
    calibration_points: Annotated[
        bool,
        typer.Option("--calibration-points", help="They are the calibration's own control points."),
    ] = False,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Map a volume: build the correction table, print what is known of it, write it as HDF5."""
    check_output(output, force=force)
    cell_mm = None if cell is None else (cell,) * 3
    settings = MappingSettings(cast("MappingMethod", method), cell_mm, penalty_weight)
    parent = read_calibration(calibration)
    models = parent.calibration.models
    table = read_observations(measurements).in_order_of(models)
    measured = MappingMeasurements(
        table.points_mm, table.readings_px, table.sigma_px, position_sigma
    )
    covariance = None if calibration_points else np.array(parent.calibration.covariance)
    with progress("mapping", 1.0, quiet=as_json) as report:
        result = build_table(
            models, parent.content_hash, measured, covariance, settings,
            lambda share, _stage: report(share),
        )  # fmt: skip
    _write(result, parent.device, output)
    if as_json:
        grid = {"cells": result.table.grid.cells, "pitch_mm": list(result.table.grid.pitch_mm)}
        settings_and_grid = {"settings": asdict(result.settings), "grid": grid}
        print_json(settings_and_grid | {"validation": asdict(result.validation)})
        return
    console.print(_summary(result, str(measurements)))
    for sensor in result.validation.sensors:
        say(f"sensor {sensor.sensor}: {sensor.coverage}")
        for suspect in sensor.suspects:
            say(
                f"[yellow]point {escape(table.labels[suspect.point])}:[/yellow] "
                f"sensor {sensor.sensor} is off by {suspect.left_out_px:.3g} px, "
                f"{suspect.normalised_error:.1f} standard deviations"
            )
    say_written(output)


def _write(result: MappingResult, device: str, output: Path) -> None:
    from service.api.correction_tables.hdf5_file import write_table
    from service.api.correction_tables.table_content import TableContent, check_table

    check_table(result.table)
    content = TableContent(
        result.table, device, datetime.now(UTC), asdict(result.settings), asdict(result.validation)
    )
    with atomic_file(output) as temporary:
        temporary.write_bytes(write_table(content))


def _summary(result: MappingResult, name: str) -> Table:
    """Return the figures by sensor; those of left-out blocks tell what the table is worth."""
    grid = result.table.grid
    cells = " x ".join(str(count) for count in grid.cells)
    pitch = " x ".join(f"{value:.4g}" for value in grid.pitch_mm)
    headings = ("sensor", "points", "before, px", "after, px", "left out, px", "valid")
    rows = (
        (sensor.sensor, sensor.points, f"{sensor.before_rms_px:.4g}", f"{sensor.after_rms_px:.4g}",
         spec(sensor.left_out_rms_px, ".4g"), f"{100.0 * sensor.valid_share:.0f} %")
        for sensor in result.validation.sensors
    )  # fmt: skip
    return make_table(headings, rows, f"{name}: {cells} cells of {pitch} mm")
