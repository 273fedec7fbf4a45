"""Renders reports in a separate process, so that live devices keep their cores."""

from typing import Any, Final

from service.api.reports.content import ReportContent
from service.jobs.worker_process import call_in_process

TIMEOUT_S: Final = 300.0
MEMORY_BYTES: Final = 4 * 1024**3


def render_page(content: ReportContent) -> str:
    """Return the report's page; raises WorkerEnded."""
    page: str = call_in_process(_page, content, timeout_s=TIMEOUT_S, memory_bytes=MEMORY_BYTES)
    return page


def render_figure(name: str, content: ReportContent) -> bytes | None:
    """Return a figure of the report as PNG, None where there is nothing for it."""
    drawn: bytes | None = call_in_process(
        _figure, name, content, timeout_s=TIMEOUT_S, memory_bytes=MEMORY_BYTES
    )
    return drawn


def _page(_tell: Any, content: ReportContent) -> str:
    # Matplotlib is loaded by who wants a picture.
    from service.api.reports.page import report_page

    return report_page(content)


def _figure(_tell: Any, name: str, content: ReportContent) -> bytes | None:
    from service.api.reports.figures import draw

    return draw(name, content, "png")
