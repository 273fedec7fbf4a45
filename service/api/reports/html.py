"""HTML of a report: numbers, tables and figures, all text from outside escaped."""

import base64
from collections.abc import Callable, Iterable
from dataclasses import asdict
from html import escape
from math import isfinite
from typing import Final

from compute.calibration.result import Calibration

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

Cell = str | float | int | None
Draw = Callable[[str], bytes | None]
"""Returns a figure of the report by its name as SVG, None where there is nothing for it."""


def table(headings: Iterable[str], rows: Iterable[Iterable[Cell]], *, words: bool = False) -> str:
    """Return a table that is scrolled by itself where it is too wide."""
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


def figure(name: str, draw: Draw) -> str:
    """Return a figure with its caption, nothing where there is nothing for it."""
    drawn = draw(name)
    if drawn is None:
        return ""
    data = base64.b64encode(drawn).decode()
    caption = escape(_CAPTIONS[name])
    return (
        f'<figure><div class="scroll"><img alt="{caption}" '
        f'src="data:image/svg+xml;base64,{data}"></div>'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def number(value: float | None) -> str:
    """Return four significant digits, without an exponent where it can be read without."""
    if value is None or not isfinite(value):
        return "–"
    if value == 0.0:
        return "0"
    size = abs(value)
    if size >= 1e5 or size < 1e-3:
        return f"{value:.3e}"
    digits = max(0, 3 - len(str(int(size))) + (1 if size >= 1 else 2))
    return f"{value:.{digits}f}"


def plain(cell: str | float | int | None) -> str:
    """Return what stands in a cell of a table."""
    if isinstance(cell, str):
        return cell
    if isinstance(cell, int):
        return str(cell)
    return number(cell)


def settings_rows(calibration: Calibration) -> list[tuple[str, str]]:
    """Return what the calibration was asked to do, by name."""
    if calibration.settings is None:
        return [("method", calibration.method)]
    return [(name, _value(value)) for name, value in asdict(calibration.settings).items()]


def _value(value: object) -> str:
    if value is None:
        return "none"
    if isinstance(value, tuple):
        return ", ".join(str(item) for item in value)
    return str(value)
