"""Deserialisation of a profile to dataclasses; errors name the dotted path."""

import dataclasses
import types
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final, Literal, Union, get_args, get_origin, get_type_hints

from compute.errors import InvalidParameter, LumilineError
from compute.optics.coded_aperture.coded_window import CodedWindow, maximal_length_code
from compute.optics.profiles.device_profile import DeviceProfile, PlateOptics
from compute.optics.profiles.error_sources import ErrorSources
from compute.optics.profiles.profile_sections import LedMarkers, RetroMarkers
from compute.optics.profiles.units import (
    InvalidQuantity,
    Unit,
    format_any,
    magnitude,
    split_unit,
)
from compute.optics.tracing.assembly import Assembly, Lens, Stop
from compute.optics.tracing.surfaces import Conic, Cylinder, Plane, Toroid

KINDS: Final[dict[type, str]] = {
    Assembly: "assembly",
    CodedWindow: "coded-window",
    PlateOptics: "gray-plate",
    Lens: "lens",
    Stop: "stop",
    Plane: "plane",
    Conic: "conic",
    Cylinder: "cylinder",
    Toroid: "toroid",
    LedMarkers: "led",
    RetroMarkers: "retro",
}
"""What ``kind`` a table says it is, where it may be one of several."""


@dataclass(frozen=True)
class Problem:
    """One error in a profile.

    Args:
        path: dotted path of the field.
        text: what is wrong with it, and what would be right.
    """

    path: str
    text: str

    def __str__(self) -> str:
        return f"{self.path}: {self.text}"


_LARGEST: Final = 1e300


class _InvalidField(Exception):
    """Something below is wrong and in the list of problems; there is no value."""


@dataclass
class ProfileDeserialiser:
    """Builds typed values from parsed TOML, and collects all errors.

    A field whose name ends in a unit (``radius_mm``) is written without it (``radius``), as text
    with any unit of that kind ("16.54 mm"); the other numbers are written as numbers.
    """

    problems: list[Problem] = field(default_factory=list)

    def build(self, expected: Any, value: object, path: str, unit: Unit | None = None) -> Any:
        """Return ``value`` as ``expected``, a type or a union or tuple of types.

        Args:
            expected: a type, or a union or tuple of types.
            value: the parsed value.
            path: its dotted path in the profile.
            unit: unit of the field's name; None: no quantity.

        Raises:
            _InvalidField: it cannot be one; ``problems`` says why.
        """
        origin, arguments = get_origin(expected), get_args(expected)
        if origin in (Union, types.UnionType):
            alternatives = [one for one in arguments if one is not type(None)]
            if len(alternatives) == 1:  # absent is None, and there is no null in a profile
                return self.build(alternatives[0], value, path, unit)
            return self._one_of(alternatives, value, path)
        if origin is tuple:
            return self._tuple(arguments, value, path, unit)
        if origin is Mapping:
            return self._mapping(arguments[1], value, path)
        if origin is Literal:
            return self._literal(arguments, value, path)
        if dataclasses.is_dataclass(expected) and isinstance(expected, type):
            return self._dataclass(expected, value, path)
        return self._leaf(expected, value, path, unit)

    def _leaf(self, expected: type, value: object, path: str, unit: Unit | None) -> object:
        if unit is not None:
            try:
                return magnitude(value, unit)
            except InvalidQuantity as error:
                raise self._invalid(path, str(error)) from None
        if expected is str and isinstance(value, str) and value.strip():
            return value
        # The bound refuses what no float holds, infinities and NaN too.
        if isinstance(value, bool):
            pass  # to Python a whole number, to a reader none
        elif isinstance(value, int | float) and abs(value) < _LARGEST:
            if expected is float:
                return float(value)
            if expected is int and isinstance(value, int):
                return value
        right = {str: "text that is not empty", int: "a whole number", float: "a number"}[expected]
        raise self._invalid(path, f"{_format_value(value)} is not {right}")

    def _literal(self, allowed: tuple[Any, ...], value: object, path: str) -> object:
        if isinstance(value, str) and value in allowed:
            return value
        choices = ", ".join(f'"{one}"' for one in allowed)
        raise self._invalid(path, f"{_format_value(value)} is not one of {choices}")

    def _tuple(
        self, arguments: tuple[Any, ...], value: object, path: str, unit: Unit | None
    ) -> tuple[Any, ...]:
        if not isinstance(value, list):
            raise self._invalid(path, f"{_format_value(value)} is not a list; write it in [ ]")
        if arguments[-1] is Ellipsis:
            arguments = (arguments[0],) * len(value)
        if len(value) != len(arguments):
            raise self._invalid(path, f"it has {len(value)} items; it must have {len(arguments)}")
        paths = [f"{path}[{number}]" for number in range(len(value))]
        return tuple(self._each(zip(arguments, value, paths, strict=True), unit))

    def _mapping(self, expected: Any, value: object, path: str) -> Mapping[str, Any]:
        table = self._table(value, path)
        parts = [(expected, item, join(path, key)) for key, item in table.items()]
        return types.MappingProxyType(dict(zip(table, self._each(parts), strict=True)))

    def _each(
        self, parts: Iterable[tuple[Any, object, str]], unit: Unit | None = None
    ) -> list[Any]:
        """Build every part, so that all that is wrong is found.

        Raises:
            _InvalidField: a part cannot be built; ``problems`` says why.
        """
        built, wrong = [], False
        for expected, value, path in parts:
            try:
                built.append(self.build(expected, value, path, unit))
            except _InvalidField:
                wrong = True
        if wrong:
            raise _InvalidField
        return built

    def _one_of(self, alternatives: list[Any], value: object, path: str) -> object:
        table = dict(self._table(value, path))
        names = {KINDS[one]: one for one in alternatives}
        choices = ", ".join(f'"{name}"' for name in names)
        if "kind" not in table:
            raise self._invalid(join(path, "kind"), f"it is missing; give one of {choices}")
        kind = table.pop("kind")
        if not isinstance(kind, str) or kind not in names:
            raise self._invalid(
                join(path, "kind"), f"{_format_value(kind)} is not one of {choices}"
            )
        return self._dataclass(names[kind], table, path)

    def _dataclass(self, expected: type, value: object, path: str) -> object:
        table = self._table(value, path)
        before = len(self.problems)
        hints = get_type_hints(expected)
        fields = {split_unit(one.name)[0]: one for one in dataclasses.fields(expected)}
        for key in table:
            if key not in fields:
                text = f"there is no such field; there are {', '.join(fields)}"
                self._invalid(join(path, key), text)
        values = {}
        for key, one in fields.items():
            here, unit = join(path, key), split_unit(one.name)[1]
            if key in table:
                with suppress(_InvalidField):
                    values[one.name] = self._field(
                        expected, one.name, hints[one.name], table[key], here, unit
                    )
            elif one.default is dataclasses.MISSING and one.default_factory is dataclasses.MISSING:
                right = f"; give {unit.expected}" if unit else ""
                self._invalid(here, f"it is missing{right}")
        if len(self.problems) > before:
            raise _InvalidField
        try:
            return expected(**values)
        except LumilineError as error:
            named = [split_unit(name)[0] for name in error.context if name in hints]
            raise self._invalid(join(path, named[0]) if named else path, error.detail) from None

    def _field(
        self, owner: type, name: str, expected: Any, value: object, path: str, unit: Unit | None
    ) -> object:
        if owner is CodedWindow and name == "code" and isinstance(value, Mapping):
            sequence = self._dataclass(_MaximalLength, value, path)
            assert isinstance(sequence, _MaximalLength)
            return maximal_length_code(sequence.maximal_length_order)
        return self.build(expected, value, path, unit)

    def _table(self, value: object, path: str) -> Mapping[str, object]:
        if not isinstance(value, Mapping):
            raise self._invalid(path, f"{_format_value(value)} is not a table")
        return value

    def _invalid(self, path: str, text: str) -> _InvalidField:
        self.problems.append(Problem(path, text))
        return _InvalidField()


@dataclass(frozen=True)
class _MaximalLength:
    """A code written as ``code = {maximal_length_order = 9}`` instead of as 511 bars."""

    maximal_length_order: int

    def __post_init__(self) -> None:
        try:
            maximal_length_code(self.maximal_length_order)
        except InvalidParameter as error:
            raise InvalidParameter(
                error.detail, maximal_length_order=self.maximal_length_order
            ) from None


def build_profile(document: Mapping[str, object]) -> tuple[DeviceProfile | None, list[Problem]]:
    """Return the profile of a parsed document, or None, and the errors."""
    return _build(DeviceProfile, document, "")


def build_error_sources(table: Mapping[str, object]) -> tuple[ErrorSources | None, list[Problem]]:
    """Return the error sources of a parsed table, or None, and the errors."""
    return _build(ErrorSources, table, "error_sources")


def _build(expected: type, document: Mapping[str, object], path: str) -> tuple[Any, list[Problem]]:
    deserialiser = ProfileDeserialiser()
    try:
        return deserialiser.build(expected, document, path), deserialiser.problems
    except _InvalidField:
        return None, deserialiser.problems


def join(path: str, key: str) -> str:
    """Return the dotted path of a key in a table.

    Args:
        path: of the table; empty for the profile itself.
        key: in the table.
    """
    return f"{path}.{key}" if path else key


def _format_value(value: object) -> str:
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, Mapping):
        return "a table"
    return "a list" if isinstance(value, list) else format_any(value)
