"""Quantities with units as text ("13 um", "5 kHz"), converted to the unit of a field."""

import re
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from typing import Final

from pint import UndefinedUnitError, UnitRegistry

# Our own list of units, because in pint's a radian and a steradian are plain numbers: there
# "2 W" would pass for a radiant intensity and "0.3" for an angle.
_DEFINITIONS: Final = """
nano- = 1e-9 = n-
micro- = 1e-6 = µ- = μ- = u-
milli- = 1e-3 = m-
centi- = 1e-2 = c-
kilo- = 1e3 = k-
mega- = 1e6 = M-
metre = [length] = m = meter
second = [time] = s
radian = [angle] = rad
gram = [mass] = g
candela = [luminosity] = cd
electron = [electron]
count = [count]
pixel = [pixel] = px
kelvin = [temperature] = K
steradian = radian ** 2 = sr
degree = 0.017453292519943295 * radian = deg
inch = 25.4e-3 * metre = in
hertz = 1 / second = Hz
joule = kilogram * metre ** 2 / second ** 2 = J
watt = joule / second = W
lux = candela * steradian / metre ** 2 = lx
"""


@dataclass(frozen=True)
class Unit:
    """Unit that a field's name carries.

    Args:
        name: the unit in which the program keeps the value.
        noun: what such a value is called.
        example: how one is written.
    """

    name: str
    noun: str
    example: str

    @property
    def expected(self) -> str:
        """Expected notation, for a message."""
        article = "an" if self.noun[0] in "aeiou" else "a"
        return f'{article} {self.noun} such as "{self.example}"'


UNITS: Final = {
    "_electrons_per_count": Unit("electron/count", "gain", "50 electrons/count"),
    "_electrons_per_s": Unit("electron/s", "rate of electrons", "2000 electrons/s"),
    "_electrons": Unit("electron", "number of electrons", "200 electrons"),
    "_counts": Unit("count", "number of counts", "20 counts"),
    "_w_per_sr": Unit("W/sr", "radiant intensity", "50 mW/sr"),
    "_per_sr": Unit("1/sr", "coefficient of retroreflection", "300 cd/lx/m^2"),
    "_mm_per_s": Unit("mm/s", "speed", "100 mm/s"),
    "_per_k": Unit("1/K", "coefficient of expansion", "23.6 um/m/K"),
    "_k": Unit("K", "difference of temperatures", "2 K"),
    "_px": Unit("px", "number of pixels", "0.05 px"),
    "_mm": Unit("mm", "length", "16.54 mm"),
    "_um": Unit("um", "length", "13 um"),
    "_nm": Unit("nm", "length", "880 nm"),
    "_rad": Unit("rad", "angle", "35 deg"),
    "_hz": Unit("Hz", "rate", "5 kHz"),
    "_s": Unit("s", "time", "200 us"),
}
"""By the end of a field's name; the longer ends come first."""

_MAX_CHARACTERS: Final = 100
"""Of a quantity with its unit; the pattern tries a long text again and again."""
_NAME = r"[A-Za-zµμ]+(?:\^-?[0-9])?"
_QUANTITY = re.compile(
    rf"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{{1,3}})?)\s*((?:1|{_NAME})(?:\s*[/*]\s*{_NAME})*)?\s*",
    re.ASCII,
)


class InvalidQuantity(ValueError):
    """A value that is no quantity of the expected kind; the message says why."""


def split_unit(field_name: str) -> tuple[str, Unit | None]:
    """Return a field's name without its unit, and that unit: ``pitch_um`` is ``pitch`` in um."""
    for end, unit in UNITS.items():
        if field_name.endswith(end):
            return field_name.removesuffix(end), unit
        if field_name == end[1:]:  # electrons_per_count: a name that is all unit stays
            return field_name, unit
    return field_name, None


def magnitude(value: object, unit: Unit) -> float:
    """Return a quantity, given as text with its unit, as a number in ``unit``.

    Args:
        value: the text, as "13 um".
        unit: unit of the result.

    Raises:
        InvalidQuantity: not text, no number, no unit, an unknown unit, one of another kind.
    """
    right = f"give {unit.expected}"
    if isinstance(value, int | float) and not isinstance(value, bool):
        raise InvalidQuantity(f"{format_any(value)} has no unit; {right}")
    if not isinstance(value, str):
        raise InvalidQuantity(f"{format_any(value)} is no quantity; {right}")
    if len(value) > _MAX_CHARACTERS:
        raise InvalidQuantity(
            f'"{value[:_MAX_CHARACTERS]}..." is longer than {_MAX_CHARACTERS} characters; {right}'
        )
    match = _QUANTITY.fullmatch(value)
    if match is None:
        raise InvalidQuantity(f'"{value}" is not a number and a unit; {right}')
    number, written = match.groups()
    if written is None:
        raise InvalidQuantity(f'"{value}" has no unit; {right}')
    try:
        factor = _factor(written, unit.name)
    except UndefinedUnitError:
        raise InvalidQuantity(f'"{value}": the unit {written} is not known; {right}') from None
    if factor is None:
        raise InvalidQuantity(f'"{value}" is no {unit.noun}; {right}')
    try:
        return float(Fraction(number) * factor)
    except OverflowError:
        raise InvalidQuantity(f'"{value}" is too large; {right}') from None


def format_any(value: object) -> str:
    """Return a value as text, also with integers of more digits than Python writes."""
    try:
        return str(value)
    except ValueError:
        return "a number of thousands of digits"


@cache
def _registry() -> UnitRegistry[Fraction]:
    # Fractions: "13 um" is the double next to 0.013 mm, whatever units it goes through.
    registry: UnitRegistry[Fraction] = UnitRegistry(None, non_int_type=Fraction)
    registry.load_definitions(_DEFINITIONS.strip().splitlines())
    return registry


@cache
def _factor(written: str, expected: str) -> Fraction | None:
    """Return the size of a written unit in expected units; None where it is of another kind."""
    registry = _registry()
    unit, target = registry.parse_units(written), registry.parse_units(expected)
    if unit.dimensionality != target.dimensionality:
        return None
    return Fraction(registry.convert(Fraction(1), unit, target))
