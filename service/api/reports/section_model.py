"""Of a report: terms of the distortion, parameters, settings and provenance."""

from html import escape

import numpy as np

from service.api.reports.content import ReportContent
from service.api.reports.formatting import settings_rows
from service.api.reports.html import Cell, Draw, table


def distortion(content: ReportContent, _draw: Draw) -> str:
    """Return how the terms were chosen."""
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
        parts.append(table(headings, rows))
    for sensor, reason in chosen.reduced_terms:
        parts.append(f'<p class="warn">{escape(sensor)}: {escape(reason)}</p>')
    return "".join(parts)


def parameters(content: ReportContent, _draw: Draw) -> str:
    """Return all parameters with their deviations."""
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
    return note + table(("sensor", "parameter", "value", "deviation"), rows)


def provenance(content: ReportContent, _draw: Draw) -> str:
    """Return what is known of where the calibration comes from."""
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
