"""Of a report: the calibration beside another one."""

from html import escape
from typing import Final

from service.api.reports.content import Relation, ReportContent
from service.api.reports.html import Draw, figure, table

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
        parts.append(
            table(
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
