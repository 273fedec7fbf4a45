"""Writes a report, and its figures as PNG, to files."""

from pathlib import Path

from service.reports.content import ReportContent
from service.reports.page import pictures, report_page


def write_report(content: ReportContent, page: Path, folder: Path | None = None) -> None:
    """Write the report to ``page``, and its figures as NAME.png into ``folder`` where one is given.

    Raises:
        OSError: a file cannot be written.
    """
    page.write_text(report_page(content), encoding="utf-8")
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        for name, png in pictures(content).items():
            (folder / f"{name}.png").write_bytes(png)
