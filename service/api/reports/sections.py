"""Sections of a calibration report."""

from html import escape
from typing import Final

import numpy as np

from service.api.reports.content import SUSPICIOUS_SIGMA, Relation, ReportContent
from service.api.reports.html import Cell, Draw, figure, number, plain, settings_rows, table


def summary(content: ReportContent, _draw: Draw) -> str:
    """Return the figures in short."""
    calibration = content.calibration
    facts = [
        ("method", calibration.method),
        ("control points", str(len(content.points_mm))),
        ("sensors", str(len(calibration.sensors))),
    ]
    residuals = content.residuals_px[np.isfinite(content.residuals_px)]
    if len(residuals):
        facts.append(("residuals, RMS", f"{number(float(np.sqrt((residuals**2).mean())))} px"))
    errors = [("fitted points", content.fitted_errors_mm)]
    for check in calibration.cross_validation:
        what = "points left out" if check.scheme == "points" else "blocks left out"
        errors.append((what, content.left_out_mm(check)))
    for what, differences in errors:
        rms = _rms(differences)
        if rms is not None:
            over = content.count_readings(differences)
            facts.append((f"{what}, RMS over {over} readings", f"{number(rms)} mm"))
    lengths = content.lengths_left_out
    if lengths is not None:
        what = f"{lengths.lengths} lengths at poses held out, RMS"
        facts.append((what, f"{number(lengths.rms_mm)} mm"))
    deviation = np.linalg.norm(content.volume_uncertainty_mm, axis=1)
    if np.isfinite(deviation).any():
        facts.append(("expected deviation", f"{number(float(np.nanmedian(deviation)))} mm"))
    items = "".join(f"<li>{escape(name)}<b>{escape(value)}</b></li>" for name, value in facts)
    return f'<ul class="facts">{items}</ul>'


def warnings(content: ReportContent, _draw: Draw) -> str:
    """Return what to look at; nothing where nothing stands out."""
    calibration = content.calibration
    said = [
        f"Sensor {fit.model.name}: chi square per degree of freedom is "
        f"{number(fit.chi2_per_dof)}, so the residuals exceed the stated deviations."
        for fit in calibration.sensors
        if fit.chi2_per_dof is not None and fit.chi2_per_dof > 2.0
    ]
    if calibration.labels:
        outliers = sum(one.kind == "outlier" for one in calibration.labels)
        said.append(
            f"Labels that look wrong: {len(calibration.labels) - outliers}; outliers: {outliers}. "
            "See below."
        )
    if content.suspicious:
        said.append(
            f"{len(content.suspicious)} residuals exceed {SUSPICIOUS_SIGMA} deviations: see below."
        )
    if calibration.diagnosis is not None:
        said += calibration.diagnosis.remarks
    if not said:
        return ""
    return "".join(f'<p class="warn">{escape(text)}</p>' for text in said)


def sensors(content: ReportContent, _draw: Draw) -> str:
    """Return the fit by sensor."""
    headings = ("sensor", "points", "RMS, px", "largest, px", "deviation, px", "taken from",
                "chi²/dof", "c, px", "p0, px")  # fmt: skip
    rows = [
        (fit.model.name, fit.points, fit.rms_px, fit.max_px, fit.sigma_px, fit.sigma_source,
         fit.chi2_per_dof, fit.model.principal_distance_px, fit.model.principal_point_px)
        for fit in content.calibration.sensors
    ]  # fmt: skip
    return table(headings, rows)


def _rms(errors_mm: np.ndarray) -> float | None:
    known = errors_mm[np.isfinite(errors_mm).all(axis=1)]
    return float(np.sqrt((known**2).sum(axis=1).mean())) if len(known) else None


def outliers(content: ReportContent, _draw: Draw) -> str:
    """Return wrong labels and large residuals."""
    parts = []
    findings = content.calibration.labels
    if findings:
        rows = [
            (one.kind, one.sensor or "all",
             ", ".join(_point(content, number) for number in one.points), one.probability,
             ", ".join(map(plain, one.residual_px)), ", ".join(map(plain, one.normalised_residual)))
            for one in findings
        ]  # fmt: skip
        headings = ("finding", "sensor", "points", "probability", "off, px", "off, deviations")
        parts.append("<p>Labels and readings that do not fit:</p>" + table(headings, rows))
    if content.suspicious:
        parts.append(
            f"<p>Residuals beyond {SUSPICIOUS_SIGMA} deviations:</p>"
            + table(("point", "sensor", "residual, px", "deviations"), content.suspicious[:50])
        )
        if len(content.suspicious) > 50:
            parts.append(f"<p>and {len(content.suspicious) - 50} more.</p>")
    if not parts and len(content.points_mm):
        settings = content.calibration.settings
        looked = settings is not None and settings.labels != "off"
        labels = (
            "No label looks wrong, no reading is an outlier. "
            if looked
            else "Labels were not looked at. "
        )
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


def lengths_left_out(content: ReportContent, _draw: Draw) -> str:
    """Return the errors of a waved target's lengths at poses that the cameras never saw."""
    found = content.lengths_left_out
    if found is None:
        return ""
    headings = ("poses held out", "lengths", "RMS, mm", "mean, mm", "largest, mm")
    row = found.poses, found.lengths, found.rms_mm, found.mean_mm, found.max_mm
    return "<p>The mean is an error of scale.</p>" + table(headings, [row])


def _point(content: ReportContent, place: int) -> str:
    """Return the name of a point counted from 1."""
    return content.names[place - 1] if 0 < place <= len(content.names) else str(place)


def coverage(content: ReportContent, draw: Draw) -> str:
    """Return how much of each sensor and of its field the points reach."""
    parts = [figure("coverage", draw)]
    diagnosis = content.calibration.diagnosis
    if diagnosis is not None and diagnosis.sensors:
        rows = [
            (one.sensor, f"{one.pixel_share:.0%}", one.condition, *one.depth_mm,
             one.weakest_description)
            for one in diagnosis.sensors
        ]  # fmt: skip
        headings = ("sensor", "pixels used", "condition", "nearest, mm", "farthest, mm",
                    "known worst")  # fmt: skip
        parts.append(table(headings, rows))
    return "".join(parts)


def uncertainty(content: ReportContent, draw: Draw) -> str:
    """Return sigma over the volume, and which further points would lower it."""
    parts = [figure("uncertainty", draw)]
    known = content.volume_uncertainty_mm
    known = known[np.isfinite(known).all(axis=1)]
    if len(known):
        rows: list[tuple[Cell, ...]] = [
            (axis, *(float(value) for value in np.quantile(known[:, place], (0.5, 0.95, 1.0))))
            for place, axis in enumerate("XYZ")
        ]
        parts.append(table(("deviation", "median, mm", "95 %, mm", "largest, mm"), rows))
    diagnosis = content.calibration.diagnosis
    if diagnosis is not None and diagnosis.suggestions:
        rows_of: list[tuple[Cell, ...]] = [
            (", ".join(number(value) for value in one.position_mm), one.mean_sigma_mm,
             one.max_sigma_mm)
            for one in diagnosis.suggestions
        ]  # fmt: skip
        parts.append(
            "<p>Further control points that would help most, each as if it were the only one; of "
            f"the calibration alone the deviation is {escape(plain(diagnosis.mean_sigma_mm))} mm "
            f"(RMS) and {escape(plain(diagnosis.max_sigma_mm))} mm (largest) now:</p>"
            + table(("at X, Y, Z, mm", "RMS with it, mm", "largest with it, mm"), rows_of)
        )
    return "".join(parts)


def distortion(content: ReportContent, _draw: Draw) -> str:
    """Return the distortion's terms, their size and the reason."""
    found = content.calibration.distortion
    if found is None:
        return ""
    text = f"<p>Requested: <b>{escape(found.chosen)}</b>; {escape(found.reason)}.</p>"
    if found.scale is None or found.scale_range is None:
        return text
    low, high = found.scale_range
    shares = [100.0 * share for share in (found.scale, low, high)]
    headings = ("scale at the field's edge, % of half the field", "5 %", "95 %",
                "at the last pixel, px", "log evidence over no distortion")  # fmt: skip
    return text + table(headings, [(*shares, found.edge_px, found.log_evidence_ratio)])


def parameters(content: ReportContent, _draw: Draw) -> str:
    """Return all parameters with their standard deviations."""
    diagonal = np.diag(np.array(content.calibration.covariance)).tolist()
    named = [
        (model.name, name, parameter_values(model).get(name))
        for model in content.calibration.models
        for name in model.parameter_names
    ]
    rows = [(*one, float(np.sqrt(max(v, 0)))) for one, v in zip(named, diagonal, strict=True)]
    note = "<p>Rotations are given as the sigma of a small rotation in the sensor's frame.</p>"
    return note + table(("sensor", "parameter", "value", "deviation"), rows)


def provenance(content: ReportContent, _draw: Draw) -> str:
    """Return the calibration's settings and provenance."""
    rows = [*content.provenance.items(), *settings_rows(content.calibration)]
    return table(("", ""), rows, words=True)


def parameter_values(model: object) -> dict[str, float]:
    """Return the values of a camera's parameters that have one, by name."""
    names = ("principal_distance_px", "principal_point_px", "offset_x_mm", "offset_z_mm")
    found = {name: float(getattr(model, name)) for name in names}
    distortion = getattr(model, "distortion", None)
    if distortion is not None:
        found["offset_y_mm"] = distortion.offset_y_mm
        for (i, j), value in zip(distortion.terms, distortion.coefficients, strict=True):
            found[f"u{i}v{j}"] = value
    return found


_RELATIONS: Final[dict[Relation, str]] = {
    "before": "which was active before this one",
    "active": "which is active now",
    "chosen": "as asked for",
}
_TITLES: Final[dict[Relation, str]] = {
    "before": "the calibration before",
    "active": "the active calibration",
    "chosen": "another calibration",
}


def comparison_title(content: ReportContent) -> str:
    """Return the section's title, which says with what."""
    if content.compared is None:
        return "Compared"
    return f"Compared with {_TITLES[content.compared.relation]}"


def comparison(content: ReportContent, draw: Draw) -> str:
    """Return the differences from another calibration."""
    if content.compared is None:
        return ""
    name, found = content.compared.name, content.compared.comparison
    which = f"<b>{escape(name)}</b>, {_RELATIONS[content.compared.relation]}"
    parts = [f"<p>The other is {which}. Differences are the other less this.</p>"]
    if found.positions is not None:
        where = found.positions
        lengths = (
            *((f"mean {axis}", value) for axis, value in zip("XYZ", where.mean_mm, strict=True)),
            ("RMS distance", where.rms_mm),
            ("largest distance", where.max_mm),
            ("RMS after the best rotation and shift", where.aligned_rms_mm),
        )
        parts.append(table(("positions over the box", "mm"), lengths))
    names = {"one": "this", "other": "the other", "neither": "neither clearly"}
    rows = [
        (names[row.of], row.points, row.one_rms_mm, row.other_rms_mm,
         "yes" if row.left_out else "no", names[row.better])
        for row in found.observations
    ]  # fmt: skip
    if rows:
        headings = ("on the points of", "points", "this, RMS mm", "the other, RMS mm",
                    "own points left out", "better")  # fmt: skip
        parts.append(table(headings, rows))
    parts.append(figure("comparison", draw))
    return "".join(parts)
