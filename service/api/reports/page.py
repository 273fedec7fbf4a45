"""The report of a calibration as one HTML file that needs nothing else."""

from collections.abc import Callable, Mapping
from functools import partial
from html import escape

from service.api.reports.content import ReportContent
from service.api.reports.figures import draw as draw_figure
from service.api.reports.html import Draw, figure
from service.api.reports.section_comparison import comparison, comparison_title
from service.api.reports.section_model import distortion, parameters, provenance
from service.api.reports.section_points import cross_validation, outliers
from service.api.reports.section_summary import sensors, summary, warnings
from service.api.reports.section_volume import coverage, uncertainty
from service.api.reports.style import STYLE


def report_page(content: ReportContent, figures: Mapping[str, bytes] | None = None) -> str:
    """Return the whole page; nothing in it is loaded from elsewhere, and no script runs.

    Every text that comes from outside is escaped.

    Args:
        content: what the report is made of.
        figures: its figures as SVG by name, where they were drawn before; None: they are drawn.
    """
    draw = figures.get if figures is not None else partial(_draw, content)
    parts: list[tuple[str, Callable[[ReportContent, Draw], str]]] = [
        ("In short", summary),
        ("What to look at", warnings),
        ("Sensors", sensors),
        ("Residuals", _figures("residuals-order", "residuals-position")),
        ("Residuals over pixels", _figures("residuals-pixels", "residuals-histogram")),
        ("Outliers and labels", outliers),
        ("Points that were left out", cross_validation),
        ("Coverage", coverage),
        ("Uncertainty over the volume", uncertainty),
        ("Distortion terms", distortion),
        (comparison_title(content), comparison),
        ("Parameters", parameters),
        ("Settings and provenance", provenance),
    ]
    sections = []
    for title, part in parts:
        body = part(content, draw)
        if body:
            sections.append(f"<section><h2>{escape(title)}</h2>{body}</section>")
    title = escape(content.title)
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; '
        "img-src data:; style-src 'unsafe-inline'\">"
        f"<title>{title}</title><style>{STYLE}</style></head>"
        f"<body><h1>{title}</h1>{''.join(sections)}</body></html>\n"
    )


def _draw(content: ReportContent, name: str) -> bytes | None:
    return draw_figure(name, content, "svg")


def _figures(*names: str) -> Callable[[ReportContent, Draw], str]:
    return lambda _content, draw: "".join(figure(name, draw) for name in names)
