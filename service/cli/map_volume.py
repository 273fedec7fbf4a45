"""`lumiline map`: a correction table from a calibration and mapping measurements, no server."""

from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from rich.table import Table

from compute.errors import InvalidParameter, LumilineError
from compute.mapping.build import build_table
from compute.mapping.measurements import MappingMeasurements
from compute.mapping.result import MappingMethod, MappingResult, MappingSettings
from service.cli.calibration_file import read_calibration
from service.cli.observations_csv import read_observations
from service.cli.output import console, fail, progress

if TYPE_CHECKING:
    from compute.camera.model import Vector3


@dataclass(frozen=True)
class MapOptions:
    """What the command is asked for beside its files; see ``MappingSettings``."""

    method: str
    pitch_mm: float | None
    penalty_weight: float | None
    point_sigma_mm: float
    calibration_points: bool

    def settings(self) -> MappingSettings:
        """Return them for the computation.

        Raises:
            InvalidParameter: one means nothing.
        """
        pitch: Vector3 | None = None if self.pitch_mm is None else (self.pitch_mm,) * 3
        return MappingSettings(cast("MappingMethod", self.method), pitch, self.penalty_weight)


def run(path: Path, calibration: Path, options: MapOptions, output: Path) -> None:
    """Map a volume: build the correction table, print what is known of it, write it as HDF5."""
    if output.exists():
        raise fail(f"{output} exists; choose another name, a table is never overwritten")
    try:
        settings = options.settings()
        parent = read_calibration(calibration)
        table = read_observations(path)
        names = tuple(model.name for model in parent.calibration.models)
        if set(table.sensors) != set(names):
            raise InvalidParameter(
                f"{path} has readings of {', '.join(table.sensors)}; the calibration is of "
                f"{', '.join(names)}"
            )
        order = [table.sensors.index(name) for name in names]
        measured = MappingMeasurements(
            table.points_mm,
            table.readings_px[:, order],
            None if table.sigma_px is None else table.sigma_px[:, order],
            options.point_sigma_mm,
        )
        covariance = None if options.calibration_points else np.array(parent.calibration.covariance)
        with progress("mapping", 1.0) as done:
            found = build_table(
                parent.calibration.models,
                parent.content_hash,
                measured,
                covariance,
                settings,
                lambda share, _stage: done(share),
            )
        _write(found, parent.device, output)
    except LumilineError as error:
        raise fail(error.detail) from error
    except OSError as error:
        raise fail(f"{output} cannot be written: {error.strerror}") from error
    console.print(_summary(found, str(path)))
    for sensor in found.validation.sensors:
        for suspect in sensor.suspects:
            console.print(
                f"[yellow]point {suspect.point + 1}:[/yellow] sensor {sensor.sensor} is off by "
                f"{suspect.left_out_px:.3g} px, {suspect.normalised_error:.1f} deviations",
                highlight=False,
            )
    console.print(f"written: {output}")


def _write(found: MappingResult, device: str, output: Path) -> None:
    from service.api.correction_tables.hdf5_file import write_table
    from service.api.correction_tables.table_content import TableContent, check_table

    check_table(found.table)
    content = TableContent(
        found.table, device, datetime.now(UTC), asdict(found.settings), asdict(found.validation)
    )
    with output.open("xb") as file:
        file.write(write_table(content))


def _summary(found: MappingResult, name: str) -> Table:
    """Return the figures by sensor; those of left-out blocks tell what the table is worth."""
    grid = found.table.grid
    cells = " x ".join(str(count) for count in grid.cells)
    pitch = " x ".join(f"{value:.4g}" for value in grid.pitch_mm)
    table = Table(title=f"{name}: {cells} cells of {pitch} mm", title_justify="left")
    headings = ("sensor", "points", "before, px", "after, px", "left out, px", "valid")
    for heading in headings:
        table.add_column(heading, justify="left" if heading == "sensor" else "right")
    for sensor in found.validation.sensors:
        left_out = sensor.left_out_rms_px
        table.add_row(
            sensor.sensor,
            str(sensor.points),
            f"{sensor.before_rms_px:.4g}",
            f"{sensor.after_rms_px:.4g}",
            "-" if left_out is None else f"{left_out:.4g}",
            f"{100.0 * sensor.valid_share:.0f} %",
        )
    return table
