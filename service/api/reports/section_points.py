"""Of a report: readings and labels that do not fit, and points that were left out."""

from service.api.reports.content import SUSPICIOUS_SIGMA, ReportContent
from service.api.reports.formatting import plain
from service.api.reports.html import Draw, figure, table


def outliers(content: ReportContent, _draw: Draw) -> str:
    """Return wrong labels and large residuals."""
    parts = []
    findings = content.calibration.labels
    if findings:
        rows = [
            (
                one.kind,
                one.sensor or "all",
                ", ".join(_point(content, place) for place in one.points),
                one.probability,
                ", ".join(plain(value) for value in one.residual_px),
                ", ".join(plain(value) for value in one.normalised_residual),
            )
            for one in findings
        ]
        headings = ("label", "sensor", "points", "probability", "off, px", "off, deviations")
        parts.append("<p>Labels that do not fit:</p>" + table(headings, rows))
    if content.suspicious:
        parts.append(
            f"<p>Residuals beyond {SUSPICIOUS_SIGMA} deviations:</p>"
            + table(("point", "sensor", "residual, px", "deviations"), content.suspicious[:50])
        )
        if len(content.suspicious) > 50:
            parts.append(f"<p>and {len(content.suspicious) - 50} more.</p>")
    if not parts and len(content.points_mm):
        looked = content.calibration.settings is not None and (
            content.calibration.settings.labels != "off"
        )
        labels = "No label looks wrong. " if looked else "Labels were not looked at. "
        parts.append(f"<p>{labels}No residual exceeds {SUSPICIOUS_SIGMA} deviations.</p>")
    return "".join(parts)


def cross_validation(content: ReportContent, draw: Draw) -> str:
    """Return the errors of points that were left out."""
    rows = []
    for check in content.calibration.cross_validation:
        if check.errors is None:
            continue
        scheme = "one by one" if check.scheme == "points" else "in blocks of space"
        rows.append(
            (f"{scheme} ({check.groups})", check.errors.points, *check.errors.mean_absolute_mm,
             *check.errors.max_absolute_mm, *check.errors.mean_mm)
        )  # fmt: skip
    headings = ["left out", "points"] + [
        f"{kind} {axis}, mm" for kind in ("mean |e|", "max |e|", "mean") for axis in "XYZ"
    ]
    return figure("point-errors", draw) + (table(headings, rows) if rows else "")


def _point(content: ReportContent, place: int) -> str:
    """Return the name of a point counted from 1."""
    return content.names[place - 1] if 0 < place <= len(content.names) else str(place)
