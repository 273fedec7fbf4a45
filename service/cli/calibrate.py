"""`lumiline calibrate`: cameras from a CSV file of control points, without a server."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import numpy as np
import typer
from rich.markup import escape
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
from compute.errors import InvalidParameter
from service.cli.json_files import DOCUMENT
from service.cli.observations_csv import ObservationTable, read_observations
from service.cli.options import AsJson, Force, PositionSigma, refuse_unused
from service.cli.output import (
    atomic_file,
    check_folder,
    check_output,
    console,
    error_table,
    make_table,
    print_json,
    progress,
    say,
    say_written,
    write_file,
)
from service.cli.sensor_geometry import PixelsOption, SensorsOption, with_geometry

if TYPE_CHECKING:
    from compute.camera.field_distortion import Term

MAX_LISTED = 10
"""Largest number of points that are listed."""


def calibrate(
    context: typer.Context,
    observations: Annotated[Path, typer.Argument(help="CSV: X_mm,Y_mm,Z_mm,NAME_px,...")],
    sensors: SensorsOption = None,
    pixels: PixelsOption = None,
    pitch_um: Annotated[
        float | None,
        typer.Option(min=0.01, help=r"With --pixels: pixel pitch \[um]; helps wide-field lenses."),
    ] = None,
    distortion: Annotated[
        str,
        typer.Option(
            help="none, auto (its scale estimated), a set's name, or terms u^i v^j as '3,0 1,2'."
        ),
    ] = "auto",
    position_sigma: PositionSigma = 0.0,
    loss: Annotated[str, typer.Option(help="linear or robust.")] = "linear",
    labels: Annotated[
        str, typer.Option(help="Wrong and exchanged labels: off, report, exclude or repair.")
    ] = "report",
    output: Annotated[Path | None, typer.Option(help="Write the calibration as JSON.")] = None,
    report: Annotated[Path | None, typer.Option(help="Write a report: an HTML file.")] = None,
    report_figures: Annotated[
        Path | None, typer.Option(help="Folder for the report's figures as PNG.")
    ] = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Calibrate from a CSV file; print the fit, write the calibration as JSON, and a report."""
    check_output(output, force=force)
    check_output(report, force=force)
    if sensors is not None:
        refuse_unused(context, "with --sensors, which says them of each", "pixels", "pitch_um")
    if report is None:
        refuse_unused(context, "without --report", "report_figures")
    if output is None and report is None:
        refuse_unused(context, "without --output or --report", "force")
    check_folder(report_figures)
    settings = CalibrationSettings(
        parse_distortion(distortion),
        position_sigma or None,
        cast("Loss", loss),
        cast("LabelPolicy", labels),
    )
    table, geometry = with_geometry(read_observations(observations), sensors, pixels, pitch_um)
    with progress("calibrating", 1.0, quiet=as_json) as report_progress:
        result = calibrate_and_assess(
            table.points_mm, table.readings_px, geometry, table.sigma_px, settings,
            lambda share, _stage: report_progress(share),
        )  # fmt: skip
    errors = _error_rows(result, table)
    if as_json:
        print_json(_figures(result, table, errors))
    else:
        _print(result, table, errors, str(observations), settings.labels)
    if output is not None:
        write_calibration(output, result, quiet=as_json)
    if report is not None:
        with progress("drawing the report", quiet=as_json):
            _report(observations, table, result, report, report_figures)
        if not as_json:
            say_written(report)


def _figures(result: Calibration, table: ObservationTable, errors: "_ErrorRows") -> dict[str, Any]:
    """Return what is printed, for machines; points by their labels."""
    findings = [
        asdict(one) | {"message": label_message(one, table.labels)} for one in result.labels
    ]
    return {
        "calibration": DOCUMENT.dump_python(result, mode="json"),
        "labels": findings,
        "errors": [
            {"label": label, "readings": count, **asdict(one)} for label, one, count in errors.rows
        ],
        "points_without_errors": [table.labels[index] for index in errors.missing_points],
        "not_shown": errors.remarks,
    }


def _print(
    result: Calibration,
    table: ObservationTable,
    errors: "_ErrorRows",
    source: str,
    labels: LabelPolicy,
) -> None:
    console.print(fit_table(result, f"{source}: {len(table.points_mm)} points"))
    if result.distortion is not None:
        say(f"distortion: {result.distortion.chosen} ({result.distortion.reason})")
    for finding in result.labels:
        kind = "outlier" if finding.kind == "outlier" else "label"
        say(f"[yellow]{kind}:[/yellow] {escape(label_message(finding, table.labels))}")
    if result.labels and labels == "report":
        console.print("look at them; --labels exclude or --labels repair takes them as they are")
    for remark in errors.remarks:
        say(remark)
    if errors.rows:
        title = "control points, absolute errors in mm"
        counts = [count for _, _, count in errors.rows]
        console.print(
            error_table(title, [(label, one, "") for label, one, _ in errors.rows], counts)
        )
        missing = errors.missing_points
        if missing:
            names = ", ".join(escape(table.labels[index]) for index in missing[:MAX_LISTED])
            more = ", ..." if len(missing) > MAX_LISTED else ""
            say(
                f"{len(missing)} of {len(table.labels)} points are in no row, because they "
                f"could not be reconstructed or predicted: {names}{more}"
            )
    else:
        console.print("fewer than three sensors saw each point: no points were reconstructed")
    for remark in result.diagnosis.remarks if result.diagnosis is not None else ():
        say(remark)


@dataclass(frozen=True)
class _ErrorRows:
    """Errors of the control points, fitted and predicted, all over the same readings.

    Args:
        rows: label, errors, and how many of the used readings they are over.
        missing_points: indices of the points that are in no row.
        remarks: why a cross-validation has no row.
    """

    rows: list[tuple[str, AxisErrors, int]]
    missing_points: list[int]
    remarks: list[str]


def _error_rows(result: Calibration, table: ObservationTable) -> _ErrorRows:
    """Return the errors of the control points; there are no rows without any point."""
    readings = table.readings_px
    differences, _ = control_errors(result, table.points_mm, readings, table.sigma_px)
    error_sets = [("fitted", differences)]
    for check in result.cross_validation:
        values = np.array([(np.nan,) * 3 if row is None else row for row in check.differences_mm])
        label = f"{check.groups} blocks left out"
        error_sets.append(("leave one out" if check.scheme == "points" else label, values))
    # A cross-validation that predicts less than half of the points says little of the calibration;
    # it has no row, and takes none of the others' points.
    points = [int(np.isfinite(errors).all(axis=1).sum()) for _, errors in error_sets]
    if not points[0]:
        return _ErrorRows([], [], [])
    remarks = [
        f"{label}: no row, because only {count} of {points[0]} points could be predicted"
        for (label, _), count in zip(error_sets, points, strict=True)
        if 2 * count < points[0]
    ]
    error_sets = [
        one for one, count in zip(error_sets, points, strict=True) if 2 * count >= points[0]
    ]
    finite = np.isfinite(np.hstack([errors for _, errors in error_sets]))
    common = np.asarray(finite.all(axis=1))
    used, _ = effective_readings(result, readings)
    rows = []
    for label, errors in error_sets:
        shared = np.where(common[:, None], errors, np.nan)
        rows.append((label, AxisErrors.of(shared), count_readings(used, shared)))
    return _ErrorRows(rows, np.flatnonzero(~common).tolist(), remarks)


def write_calibration(path: Path, calibration: Calibration, *, quiet: bool = False) -> None:
    """Write a calibration as JSON, or end the command with the reason."""
    write_file(path, DOCUMENT.dump_json(calibration, indent=2) + b"\n", quiet=quiet)


def _report(
    source: Path, table: ObservationTable, result: Calibration, page: Path, figures: Path | None
) -> None:
    from service.api.reports.content import ReportContent
    from service.api.reports.page import write_report

    content = ReportContent(
        f"Calibration of {source.name}", result, list(table.labels), table.points_mm,
        table.readings_px, table.sigma_px, {"file": source.name},
    )  # fmt: skip
    with atomic_file(page) as temporary:
        write_report(content, temporary, figures)


def fit_table(calibration: Calibration, title: str) -> Table:
    """Return the fit by sensor."""
    headings = ("sensor", "points", "rms, px", "max, px", "c, px", "p0, px")
    rows = (
        (fit.model.name, fit.points, f"{fit.rms_px:.4g}", f"{fit.max_px:.4g}",
         f"{fit.model.principal_distance_px:.2f}", f"{fit.model.principal_point_px:.2f}")
        for fit in calibration.sensors
    )  # fmt: skip
    return make_table(headings, rows, title)


def label_message(finding: LabelFinding, labels: Sequence[str]) -> str:
    """Return what a finding says, in a sentence, with the points' labels."""
    where = "all sensors" if finding.sensor is None else f"sensor {finding.sensor}"
    points = [labels[point - 1] for point in finding.points]
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
