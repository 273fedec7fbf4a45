"""The top of a report: figures in short, what to look at, the sensors."""

from html import escape

import numpy as np

from service.api.reports.content import SUSPICIOUS_SIGMA, ReportContent
from service.api.reports.formatting import number
from service.api.reports.html import Draw, table


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
        said.append(f"Labels look wrong ({len(calibration.labels)} findings): see below.")
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
