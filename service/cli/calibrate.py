"""`lumiline calibrate`: cameras from a CSV file of control points, without a server."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import numpy as np
import typer
from rich.table import Table

from compute.calibration.assessment.assess import calibrate_and_assess, control_errors
from compute.calibration.mislabels.repair import LabelFinding
from compute.calibration.result import (
    AxisErrors,
    Calibration,
    count_readings,
    effective_readings,
)
from compute.calibration.settings import CalibrationSettings, Distortion, LabelPolicy, Loss
from compute.camera.model import SensorGeometry
from compute.errors import InvalidParameter
from service.cli.json_files import DOCUMENT
from service.cli.observations_csv import ObservationTable, read_observations
from service.cli.output import (
    console,
    error_table,
    file_errors,
    make_table,
    progress,
    say,
    write_file,
)

if TYPE_CHECKING:
    from compute.camera.field_distortion import Term


def calibrate(
    observations: Annotated[Path, typer.Argument(help="CSV: X_mm,Y_mm,Z_mm,NAME_px,...")],
    pixels: Annotated[int, typer.Option(min=8, help="Pixels of each sensor.")],
    pitch: Annotated[
        float | None, typer.Option(min=0.01, help="Pixel pitch \\[um]; helps wide-field lenses.")
    ] = None,
    distortion: Annotated[
        str,
        typer.Option(
            help="none, auto (its scale estimated), a set's name, or terms u^i v^j as '3,0 1,2'."
        ),
    ] = "auto",
    control_sigma: Annotated[
        float | None,
        typer.Option(help=r"Standard deviation of the control points' coordinates \[mm]."),
    ] = None,
    loss: Annotated[str, typer.Option(help="linear or robust.")] = "linear",
    labels: Annotated[
        str, typer.Option(help="Wrong and exchanged labels: off, report, exclude or repair.")
    ] = "report",
    output: Annotated[Path | None, typer.Option(help="Write the calibration as JSON.")] = None,
    report: Annotated[Path | None, typer.Option(help="Write a report: an HTML file.")] = None,
    report_figures: Annotated[
        Path | None, typer.Option(help="Folder for the report's figures as PNG.")
    ] = None,
) -> None:
    """Calibrate from a CSV file; print the fit, write the calibration as JSON, and a report."""
    settings = CalibrationSettings(
        parse_distortion(distortion), control_sigma, cast("Loss", loss), cast("LabelPolicy", labels)
    )
    table = read_observations(observations)
    sensors = [SensorGeometry(name, pixels, pitch) for name in table.sensors]
    with progress("calibrating", 1.0) as done:
        result = calibrate_and_assess(
            table.points_mm, table.readings_px, sensors, table.sigma_px, settings,
            lambda share, _stage: done(share),
        )  # fmt: skip
    rows = _error_rows(result, table)
    console.print(fit_table(result, f"{observations}: {len(table.points_mm)} points"))
    if result.distortion is not None:
        say(f"distortion: {result.distortion.chosen} ({result.distortion.reason})")
    for finding in result.labels:
        kind = "outlier" if finding.kind == "outlier" else "label"
        say(f"[yellow]{kind}:[/yellow] {label_message(finding)}")
    if result.labels and settings.labels == "report":
        console.print("look at them; --labels exclude or --labels repair takes them as they are")
    if rows:
        title = "control points, absolute errors in mm"
        counts = [count for _, _, count in rows]
        console.print(
            error_table(title, [(label, errors, "") for label, errors, _ in rows], counts)
        )
        if len(set(counts)) > 1:
            console.print("the rows are over different readings: some points were not predicted")
    else:
        console.print("fewer than three sensors saw each point: no points were reconstructed")
    for remark in result.diagnosis.remarks if result.diagnosis is not None else ():
        say(remark)
    if output is not None:
        write_calibration(output, result)
    if report is not None:
        _report(observations, table, result, report, report_figures)


def _error_rows(result: Calibration, table: ObservationTable) -> list[tuple[str, AxisErrors, int]]:
    """Return the errors of the control points, fitted and predicted; none without any point.

    Each row has its label, its errors, and how many of the used readings it is over.
    """
    readings = table.readings_px
    differences, count = control_errors(result, table.points_mm, readings, table.sigma_px)
    fitted = AxisErrors.of(differences)
    if not fitted.points:
        return []
    rows = [("fitted", fitted, count)]
    used, _ = effective_readings(result, readings)
    for check in result.cross_validation:
        if check.errors is not None:
            known = np.array(
                [(np.nan,) * 3 if row is None else row for row in check.differences_mm]
            )
            by_point = check.scheme == "points"
            label = "leave one out" if by_point else f"{check.groups} blocks left out"
            rows.append((label, check.errors, count_readings(used, known)))
    return rows


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration as JSON, or end the command with the reason."""
    write_file(path, DOCUMENT.dump_json(calibration, indent=2) + b"\n")


def _report(
    source: Path, table: ObservationTable, result: Calibration, page: Path, figures: Path | None
) -> None:
    from service.api.reports.content import ReportContent
    from service.api.reports.page import write_report

    names = [str(number) for number in range(1, len(table.points_mm) + 1)]
    content = ReportContent(
        f"Calibration of {source.name}", result, names, table.points_mm, table.readings_px,
        table.sigma_px, {"file": source.name},
    )  # fmt: skip
    with file_errors(page):
        write_report(content, page, figures)
    console.print(f"written: {page}")


def fit_table(calibration: Calibration, title: str) -> Table:
    """Return the fit by sensor."""
    headings = ("sensor", "points", "rms, px", "max, px", "c, px", "p0, px")
    rows = (
        (fit.model.name, fit.points, f"{fit.rms_px:.4g}", f"{fit.max_px:.4g}",
         f"{fit.model.principal_distance_px:.2f}", f"{fit.model.principal_point_px:.2f}")
        for fit in calibration.sensors
    )  # fmt: skip
    return make_table(headings, rows, title)


def label_message(finding: LabelFinding) -> str:
    """Return what a finding says, in a sentence; points counted from 1."""
    where = "all sensors" if finding.sensor is None else f"sensor {finding.sensor}"
    points = [str(point) for point in finding.points]
    sure = f"probability {finding.probability:.3g}"
    if finding.kind == "outlier":
        off, size = finding.residual_px[0], finding.normalised_residual[0]
        by = "" if off is None else f", off by {off:.4g} px"
        by += "" if size is None else f" or {abs(size):.3g} sigma"
        return f"{where}: the reading of point {points[0]} is an outlier{by} ({sure})"
    if finding.kind == "wrong-label":
        return f"{where}: the reading labelled {points[0]} is point {points[1]}'s ({sure})"
    return f"{where}: the readings of points {' and '.join(points)} are exchanged ({sure})"


def parse_distortion(text: str) -> Distortion:
    """Return a named set, or terms written as ``3,0 1,2``; raises InvalidParameter."""
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
