"""`lumiline calibrate`: cameras from a CSV file of control points, without a server."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from rich.table import Table

from compute.calibration.assessment.assess import calibrate_and_assess, control_errors
from compute.calibration.distortion_selection import refusals
from compute.calibration.mislabels.repair import LabelFinding
from compute.calibration.result import (
    AxisErrors,
    Calibration,
    CrossValidation,
    count_readings,
    effective_readings,
)
from compute.calibration.settings import CalibrationSettings, Distortion, LabelPolicy, Loss
from compute.camera.model import SensorGeometry
from compute.errors import InvalidParameter, LumilineError
from service.cli.calibration_file import DOCUMENT
from service.cli.observations_csv import ObservationTable, read_observations
from service.cli.output import console, error_table, fail, progress

if TYPE_CHECKING:
    from compute.camera.field_distortion import Term


@dataclass(frozen=True)
class CalibrateOptions:
    """What the command is asked for beside the file; see ``CalibrationSettings``."""

    pixels: int
    pitch_um: float | None
    distortion: str
    control_sigma_mm: float | None
    loss: str
    labels: str

    def settings(self) -> CalibrationSettings:
        """Return them for the computation.

        Raises:
            InvalidParameter: one means nothing, or contradicts another.
        """
        return CalibrationSettings(
            _distortion(self.distortion),
            self.control_sigma_mm,
            cast("Loss", self.loss),
            cast("LabelPolicy", self.labels),
        )


def run(
    path: Path,
    options: CalibrateOptions,
    output: Path | None,
    report: Path | None,
    figures: Path | None,
) -> None:
    """Calibrate from a CSV file; print the fit, write the calibration as JSON, and a report."""
    try:
        settings = options.settings()
        table = read_observations(path)
        sensors = [SensorGeometry(name, options.pixels, options.pitch_um) for name in table.sensors]
        given = table.points_mm, table.readings_px
        with progress("calibrating", 1.0) as done:
            found = calibrate_and_assess(
                *given, sensors, table.sigma_px, settings, lambda share, _stage: done(share)
            )
        rows = _error_rows(found, table)
    except LumilineError as error:
        raise fail(error.detail) from error
    console.print(fit_table(found, f"{path}: {len(table.points_mm)} points"))
    if found.distortion is not None:
        console.print(
            f"distortion: {found.distortion.chosen} ({found.distortion.reason})", highlight=False
        )
        for reason, names in refusals(found.distortion.candidates).items():
            console.print(f"not judged: {', '.join(names)}: {reason}", highlight=False)
    for finding in found.labels:
        console.print(f"[yellow]label:[/yellow] {label_message(finding)}", highlight=False)
    if found.labels and settings.labels == "report":
        console.print("look at them; --labels exclude or --labels repair takes them as they are")
    if rows:
        title = "control points, absolute errors in mm"
        counts = [row.readings for row in rows]
        console.print(error_table(title, [(row.label, row.errors, "") for row in rows], counts))
        if len(set(counts)) > 1:
            console.print("the rows are over different readings: some points were not predicted")
    else:
        console.print("fewer than three sensors saw each point: no points were reconstructed")
    for remark in found.diagnosis.remarks if found.diagnosis is not None else ():
        console.print(remark, highlight=False)
    if output is not None:
        write_calibration(output, found)
    if report is not None:
        _report(path, table, found, report, figures)


@dataclass(frozen=True)
class _ErrorRow:
    """A row of the table of errors, over the readings that the calibration used."""

    label: str
    errors: AxisErrors
    readings: int


def _error_rows(found: Calibration, table: ObservationTable) -> list[_ErrorRow]:
    """Return the errors of the control points: fitted, and predicted; none without any point."""
    readings = table.readings_px
    differences, over = control_errors(found, table.points_mm, readings, table.sigma_px)
    fitted = AxisErrors.of(differences)
    if not fitted.points:
        return []
    rows = [_ErrorRow("fitted", fitted, over)]
    used, _ = effective_readings(found, readings)
    for check in found.cross_validation:
        if check.errors is not None:
            known = np.array(
                [(np.nan,) * 3 if row is None else row for row in check.differences_mm]
            )
            rows.append(_ErrorRow(_scheme(check), check.errors, count_readings(used, known)))
    return rows


def _scheme(check: CrossValidation) -> str:
    return "leave one out" if check.scheme == "points" else f"{check.groups} blocks left out"


def write_calibration(path: Path, found: Calibration) -> None:
    """Write a calibration as JSON, or end the command with the reason."""
    try:
        path.write_bytes(DOCUMENT.dump_json(found, indent=2) + b"\n")
    except OSError as error:
        raise fail(f"{path} cannot be written: {error.strerror}") from error
    console.print(f"written: {path}")


def _report(
    source: Path, table: ObservationTable, found: Calibration, page: Path, figures: Path | None
) -> None:
    from service.api.reports.content import ReportContent
    from service.api.reports.page import write_report

    names = [str(number) for number in range(1, len(table.points_mm) + 1)]
    content = ReportContent(
        f"Calibration of {source.name}", found, names, table.points_mm, table.readings_px,
        table.sigma_px, {"file": source.name},
    )  # fmt: skip
    try:
        write_report(content, page, figures)
    except OSError as error:
        raise fail(f"{error.filename or page} cannot be written: {error.strerror}") from error
    console.print(f"written: {page}")


def fit_table(found: Calibration, title: str) -> Table:
    """Return the fit by sensor."""
    fits = Table(title=title, title_justify="left")
    for heading in ("sensor", "points", "rms, px", "max, px", "c, px", "p0, px"):
        fits.add_column(heading, justify="left" if heading == "sensor" else "right")
    for fit in found.sensors:
        model = fit.model
        fits.add_row(
            model.name,
            str(fit.points),
            f"{fit.rms_px:.4g}",
            f"{fit.max_px:.4g}",
            f"{model.principal_distance_px:.2f}",
            f"{model.principal_point_px:.2f}",
        )
    return fits


def label_message(finding: LabelFinding) -> str:
    """Return what a finding says, in a sentence; points counted from 1."""
    where = "all sensors" if finding.sensor is None else f"sensor {finding.sensor}"
    points = [str(point) for point in finding.points]
    sure = f"probability {finding.probability:.3g}"
    if finding.kind == "wrong":
        off = finding.residual_px[0] if finding.residual_px else None
        by = "" if off is None else f", off by {off:.4g} px"
        return f"{where}: the reading of point {points[0]} is wrong{by} ({sure})"
    if finding.kind == "missing":
        return f"{where}: the reading of point {points[0]} is point {points[1]}'s ({sure})"
    return f"{where}: the readings of points {' and '.join(points)} are exchanged ({sure})"


def _distortion(text: str) -> Distortion:
    """Return a named set, or terms written as ``3,0 1,2``.

    Raises:
        InvalidParameter: pairs that are not two whole numbers.
    """
    if not text[:1].isdigit():
        return cast("Distortion", text)
    terms: list[Term] = []
    for pair in text.split():
        powers = pair.split(",")
        if len(powers) != 2 or not all(power.isdigit() for power in powers):
            raise InvalidParameter(
                f'distortion has the term "{pair}"; it must be the two powers of u^i v^j as "i,j", '
                'for example "3,0 1,2"',
                distortion=text,
            )
        terms.append((int(powers[0]), int(powers[1])))
    return tuple(terms)
