"""The report of a calibration as one self-contained HTML file, and its figures as files."""

from collections.abc import Callable, Mapping
from functools import partial
from html import escape
from pathlib import Path
from typing import Final

from service.api.reports.content import ReportContent
from service.api.reports.figures import FIGURES, draw_as
from service.api.reports.figures import draw as draw_figure
from service.api.reports.html import Draw, figure
from service.api.reports.sections import (
    comparison,
    comparison_title,
    coverage,
    cross_validation,
    distortion,
    lengths_left_out,
    outliers,
    parameters,
    provenance,
    sensors,
    summary,
    uncertainty,
    warnings,
)


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
        ("Lengths that were left out", lengths_left_out),
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


STYLE: Final = """
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
