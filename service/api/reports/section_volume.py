"""Of a report: what the points cover, and how sure a new point is over the volume."""

from html import escape

import numpy as np

from service.api.reports.content import ReportContent
from service.api.reports.formatting import number, plain
from service.api.reports.html import Cell, Draw, figure, table


def coverage(content: ReportContent, draw: Draw) -> str:
    """Return how much of each sensor and of its field the points reach."""
    parts = [figure("coverage", draw)]
    diagnosis = content.calibration.diagnosis
    if diagnosis is not None:
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
    """Return the deviations over the volume, and which further points would lower them."""
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
