"""The report of a calibration as one HTML file that needs nothing else."""

import base64
from collections.abc import Callable, Iterable
from html import escape
from typing import Final

import numpy as np

from service.reports.content import SUSPICIOUS_SIGMA, ReportContent
from service.reports.figures import FIGURES, draw
from service.reports.text import number, plain, settings_rows

_CAPTIONS: Final = {
    "residuals-order": "Fitted less measured reading. Grey: two standard deviations. A drift or a "
    "jump means that something moved while it was measured.",
    "residuals-position": "A curve is what the camera model does not describe: more distortion "
    "terms, or a correction table.",
    "residuals-pixels": "A pattern here belongs to the pixels, or to distortion along the row.",
    "residuals-histogram": "Wider than the curve: the stated noise is too small, or the model does "
    "not fit. Single bars far out: wrong readings.",
    "coverage": "What lies beyond the control points is extrapolated.",
    "point-errors": "Points that were left out say what to expect of new ones.",
    "uncertainty": "Of readings as good as the control points', within their box. White: fewer "
    "than three sensors see it.",
    "comparison": "Grey: two deviations. Calibrations that share readings differ by less.",
}

_STYLE: Final = """
:root{color-scheme:light}
body{font:15px/1.45 system-ui,sans-serif;max-width:62rem;margin:0 auto;padding:1rem;color:#111;
background:#fff}
h1{font-size:1.5rem;overflow-wrap:anywhere}h2{font-size:1.15rem;margin-top:2rem;
border-bottom:1px solid #ccc}
.scroll{overflow-x:auto}table{border-collapse:collapse;margin:.5rem 0;font-size:.9rem}
th,td{padding:.2rem .6rem;border-bottom:1px solid #ddd;text-align:right;vertical-align:top}
th:first-child,td:first-child{text-align:left}
td.w{text-align:left}table.words td{text-align:left;overflow-wrap:anywhere}
figure{margin:1rem 0;break-inside:avoid}
figure img{display:block;width:100%;min-width:40rem;max-width:58rem;height:auto}
figcaption{color:#444;font-size:.9rem}
.facts{display:grid;grid-template-columns:repeat(auto-fit,minmax(9.5rem,1fr));gap:.5rem;padding:0;
list-style:none}.facts li{border:1px solid #ccc;border-radius:.4rem;padding:.5rem}
.facts b{display:block;font-size:1.2rem}.warn{border-left:4px solid #D55E00;padding-left:.7rem}
@media print{body{max-width:none;font-size:10pt}figure img{min-width:0}.scroll{overflow:visible}
h2{break-after:avoid}tr{break-inside:avoid}}
"""

Cell = str | float | int | None


def report_page(content: ReportContent) -> str:
    """Return the whole page; nothing in it is loaded from elsewhere, and no script runs.

    Every text that comes from outside is escaped.
    """
    parts: list[tuple[str, Callable[[ReportContent], str]]] = [
        ("In short", _summary),
        ("What to look at", _warnings),
        ("Sensors", _sensors),
        ("Residuals", _figures("residuals-order", "residuals-position")),
        ("Residuals over pixels", _figures("residuals-pixels", "residuals-histogram")),
        ("Outliers and labels", _outliers),
        ("Points that were left out", _cross_validation),
        ("Coverage", _coverage),
        ("Uncertainty over the volume", _uncertainty),
        ("Distortion terms", _distortion),
        ("Compared with the previous calibration", _comparison),
        ("Parameters", _parameters),
        ("Settings and provenance", _provenance),
    ]
    sections = []
    for title, part in parts:
        body = part(content)
        if body:
            sections.append(f"<section><h2>{escape(title)}</h2>{body}</section>")
    title = escape(content.title)
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; '
        "img-src data:; style-src 'unsafe-inline'\">"
        f"<title>{title}</title><style>{_STYLE}</style></head>"
        f"<body><h1>{title}</h1>{''.join(sections)}</body></html>\n"
    )


def _table(headings: Iterable[str], rows: Iterable[Iterable[Cell]], *, words: bool = False) -> str:
    head = "".join(f"<th>{escape(heading)}</th>" for heading in headings)
    body = "".join("<tr>" + "".join(map(_cell, row)) + "</tr>" for row in rows)
    kind = ' class="words"' if words else ""
    return (
        f'<div class="scroll"><table{kind}><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def _cell(cell: Cell) -> str:
    kind = ' class="w"' if isinstance(cell, str) else ""
    return f"<td{kind}>{escape(plain(cell))}</td>"


def _figures(*names: str) -> Callable[[ReportContent], str]:
    return lambda content: "".join(_figure(name, content) for name in names)


def _figure(name: str, content: ReportContent) -> str:
    drawn = draw(name, content, "svg")
    if drawn is None:
        return ""
    data = base64.b64encode(drawn).decode()
    caption = escape(_CAPTIONS[name])
    return (
        f'<figure><div class="scroll"><img alt="{caption}" '
        f'src="data:image/svg+xml;base64,{data}"></div>'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _summary(content: ReportContent) -> str:
    calibration = content.calibration
    facts = [
        ("method", calibration.method),
        ("control points", str(len(content.points_mm))),
        ("sensors", str(len(calibration.sensors))),
    ]
    residuals = content.residuals_px[np.isfinite(content.residuals_px)]
    if len(residuals):
        facts.append(("residuals, RMS", f"{number(float(np.sqrt((residuals**2).mean())))} px"))
    rms = _rms(content.fitted_errors_mm)
    if rms is not None:
        facts.append(("fitted points, RMS", f"{number(rms)} mm"))
    for check in calibration.cross_validation:
        rows = [row for row in check.differences_mm if row is not None]
        left_out = _rms(np.array(rows, dtype=np.float64).reshape(-1, 3))
        if left_out is not None:
            what = "points left out" if check.scheme == "points" else "blocks left out"
            facts.append((f"{what}, RMS", f"{number(left_out)} mm"))
    deviation = np.linalg.norm(content.volume_uncertainty_mm, axis=1)
    if np.isfinite(deviation).any():
        facts.append(("expected deviation", f"{number(float(np.nanmedian(deviation)))} mm"))
    items = "".join(f"<li>{escape(name)}<b>{escape(value)}</b></li>" for name, value in facts)
    return f'<ul class="facts">{items}</ul>'


def _rms(errors_mm: np.ndarray) -> float | None:
    known = errors_mm[np.isfinite(errors_mm).all(axis=1)]
    return float(np.sqrt((known**2).sum(axis=1).mean())) if len(known) else None


def _warnings(content: ReportContent) -> str:
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


def _sensors(content: ReportContent) -> str:
    headings = ("sensor", "points", "RMS, px", "largest, px", "deviation, px", "taken from",
                "chi²/dof", "c, px", "p0, px")  # fmt: skip
    rows = [
        (fit.model.name, fit.points, fit.rms_px, fit.max_px, fit.sigma_px, fit.sigma_source,
         fit.chi2_per_dof, fit.model.principal_distance_px, fit.model.principal_point_px)
        for fit in content.calibration.sensors
    ]  # fmt: skip
    return _table(headings, rows)


def _outliers(content: ReportContent) -> str:
    parts = []
    findings = content.calibration.labels
    if findings:
        rows = [
            (
                one.kind,
                one.sensor or "all",
                ", ".join(_point(content, place) for place in one.points),
                one.probability,
                ", ".join(plain(value) for value in one.off_px),
                ", ".join(plain(value) for value in one.off_sigma),
            )
            for one in findings
        ]
        headings = ("label", "sensor", "points", "probability", "off, px", "off, deviations")
        parts.append("<p>Labels that do not fit:</p>" + _table(headings, rows))
    if content.suspicious:
        parts.append(
            f"<p>Residuals beyond {SUSPICIOUS_SIGMA} deviations:</p>"
            + _table(("point", "sensor", "residual, px", "deviations"), content.suspicious[:50])
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


def _point(content: ReportContent, place: int) -> str:
    """Return the name of a point counted from 1."""
    return content.names[place - 1] if 0 < place <= len(content.names) else str(place)


def _cross_validation(content: ReportContent) -> str:
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
    table = _table(headings, rows) if rows else ""
    return _figure("point-errors", content) + table


def _coverage(content: ReportContent) -> str:
    parts = [_figure("coverage", content)]
    diagnosis = content.calibration.diagnosis
    if diagnosis is not None:
        rows = [
            (one.sensor, f"{one.pixel_share:.0%}", one.condition, *one.depth_mm,
             one.weakest_in_words)
            for one in diagnosis.sensors
        ]  # fmt: skip
        headings = ("sensor", "pixels used", "condition", "nearest, mm", "farthest, mm",
                    "known worst")  # fmt: skip
        parts.append(_table(headings, rows))
    return "".join(parts)


def _uncertainty(content: ReportContent) -> str:
    parts = [_figure("uncertainty", content)]
    known = content.volume_uncertainty_mm
    known = known[np.isfinite(known).all(axis=1)]
    if len(known):
        rows: list[tuple[Cell, ...]] = [
            (axis, *(float(value) for value in np.quantile(known[:, place], (0.5, 0.95, 1.0))))
            for place, axis in enumerate("XYZ")
        ]
        parts.append(_table(("deviation", "median, mm", "95 %, mm", "largest, mm"), rows))
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
            + _table(("at X, Y, Z, mm", "RMS with it, mm", "largest with it, mm"), rows_of)
        )
    return "".join(parts)


def _distortion(content: ReportContent) -> str:
    chosen = content.calibration.distortion
    if chosen is None:
        return ""
    parts = [f"<p>Chosen: <b>{escape(chosen.chosen)}</b>. {escape(chosen.reason)}</p>"]
    if chosen.candidates:
        rows = [
            (one.name, one.parameters, one.left_out_rms_px, one.loss, one.loss_excess,
             one.loss_excess_error, one.note)
            for one in chosen.candidates
        ]  # fmt: skip
        headings = ("set", "parameters a sensor", "left out RMS, px", "loss", "above the best",
                    "its error", "")  # fmt: skip
        parts.append(_table(headings, rows))
    for sensor, reason in chosen.smaller:
        parts.append(f'<p class="warn">{escape(sensor)}: {escape(reason)}</p>')
    return "".join(parts)


def _comparison(content: ReportContent) -> str:
    if content.previous is None:
        return ""
    name, found = content.previous
    parts = [f"<p>Previous: <b>{escape(name)}</b>. Differences are previous less this.</p>"]
    if found.positions is not None:
        where = found.positions
        parts.append(
            _table(
                ("positions over the box", "mm"),
                (
                    ("mean X", where.mean_mm[0]),
                    ("mean Y", where.mean_mm[1]),
                    ("mean Z", where.mean_mm[2]),
                    ("RMS distance", where.rms_mm),
                    ("largest distance", where.max_mm),
                    ("RMS after the best turn and shift", where.aligned_rms_mm),
                ),
            )
        )
    names = {"one": "this", "other": "the previous", "neither": "neither clearly"}
    rows = [
        (names[row.of], row.points, row.one_rms_mm, row.other_rms_mm,
         "yes" if row.left_out else "no", names[row.better])
        for row in found.observations
    ]  # fmt: skip
    if rows:
        headings = ("on the points of", "points", "this, RMS mm", "previous, RMS mm",
                    "own points left out", "better")  # fmt: skip
        parts.append(_table(headings, rows))
    parts.append(_figure("comparison", content))
    return "".join(parts)


def _parameters(content: ReportContent) -> str:
    diagonal = np.diag(np.array(content.calibration.covariance)).tolist()
    rows: list[tuple[Cell, ...]] = []
    place = 0
    for model in content.calibration.models:
        values = parameter_values(model)
        for name in model.parameter_names:
            rows.append(
                (model.name, name, values.get(name), float(np.sqrt(max(diagonal[place], 0))))
            )
            place += 1
    note = "<p>Rotations are given as the deviation of a small turn in the sensor's frame.</p>"
    return note + _table(("sensor", "parameter", "value", "deviation"), rows)


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


def _provenance(content: ReportContent) -> str:
    rows = [*content.provenance.items(), *settings_rows(content.calibration)]
    return _table(("", ""), rows, words=True)


def pictures(content: ReportContent) -> dict[str, bytes]:
    """Return the report's figures as PNG by name, those that there is something for."""
    drawn = {name: draw(name, content, "png") for name in FIGURES}
    return {name: png for name, png in drawn.items() if png is not None}
