"""Numbers of text replies: signed, of fixed width, their decimal point left out."""

from collections.abc import Sequence
from typing import Final

MAX_UNIT: Final = 9.9999
"""Largest number of 4 decimals: quaternions, errors."""
MAX_MM: Final = 9999.99
"""Largest number of 2 decimals: positions."""


class TooLarge(Exception):
    """A number has more digits than its place."""


def unit(value: float) -> str:
    """Return a number as sign and 5 digits, 4 of them behind the point; raises TooLarge."""
    return _digits(value, 4, 5)


def millimetres(values: Sequence[float]) -> str:
    """Return lengths as sign and 6 digits each, 2 of them behind the point; raises TooLarge."""
    return "".join(_digits(value, 2, 6) for value in values)


def _digits(value: float, decimals: int, width: int) -> str:
    if not abs(value) < 10.0 ** (width - decimals):  # NaN, too
        raise TooLarge
    whole = round(value * 10**decimals)
    if abs(whole) >= 10**width:
        raise TooLarge
    # A rounded -0.001 has no minus: whole is an integer.
    return f"{whole:+0{width + 1}d}"
