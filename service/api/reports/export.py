"""Writes a report, and its figures as PNG, to files."""

from pathlib import Path

from service.api.reports.content import ReportContent
from service.api.reports.figures import FIGURES, draw_as
from service.api.reports.page import report_page


def write_report(content: ReportContent, page: Path, folder: Path | None = None) -> None:
    """Write the report to ``page``, and its figures as NAME.png into ``folder`` where one is given.

    Raises:
        OSError: a file cannot be written.
    """
    if folder is None:
        page.write_text(report_page(content), encoding="utf-8")
        return
    drawn = {name: draw_as(name, content, ("svg", "png")) for name in FIGURES}
    figures = {name: kinds for name, kinds in drawn.items() if kinds is not None}
    page.write_text(
        report_page(content, {name: kinds["svg"] for name, kinds in figures.items()}),
        encoding="utf-8",
    )
    folder.mkdir(parents=True, exist_ok=True)
    for name, kinds in figures.items():
        (folder / f"{name}.png").write_bytes(kinds["png"])
