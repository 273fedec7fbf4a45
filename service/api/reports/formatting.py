"""Numbers and settings as a report shows them."""

from dataclasses import asdict
from math import isfinite

from compute.calibration.result import Calibration


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
