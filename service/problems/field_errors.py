"""Errors of a request that does not fit its schema: where, what, and the value, bounded."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from service.problems.bounds import MAX_ERRORS, cut_text, display_value
from service.problems.catalogue import FieldError

_MESSAGE_CHARACTERS: Final = 500
_PART_CHARACTERS: Final = 100
_MAX_ERRORS_IN_DETAIL: Final = 3


@dataclass(frozen=True)
class FieldErrors:
    """Errors of one request.

    Args:
        errors: the first MAX_ERRORS.
        count: of all.
        not_finite: whether one of them is a NaN or an infinity.
    """

    errors: tuple[FieldError, ...]
    count: int
    not_finite: bool

    def summary(self) -> str:
        """Return the first few as one text, with the number of the others."""
        parts = [
            f"{'.'.join(str(part) for part in item.location)}: {item.message}, got {item.input}"
            for item in self.errors[:_MAX_ERRORS_IN_DETAIL]
        ]
        more = self.count - _MAX_ERRORS_IN_DETAIL
        return "; ".join(parts) + (f"; and {more} more" if more > 0 else "")


class InvalidRequest(Exception):
    """The request does not fit the schema; validated by us and not by the framework."""

    def __init__(self, errors: FieldErrors) -> None:
        super().__init__(errors)
        self.errors = errors


def field_errors(errors: Sequence[Mapping[str, Any]], body: Any) -> FieldErrors:
    """Return pydantic's errors as clients see them.

    Args:
        errors: the errors, each location beginning with its source: ``body``, ``query``, ...
        body: the parsed body.
    """
    return FieldErrors(
        tuple(
            FieldError(
                location=[_cut(part) for part in _location(item, body)],
                message=cut_text(item["msg"], _MESSAGE_CHARACTERS),
                input=display_value(item.get("input")),
            )
            for item in errors[:MAX_ERRORS]
        ),
        len(errors),
        any(_is_not_finite(item.get("input")) for item in errors),
    )


def _cut(part: str | int) -> str | int:
    return part if isinstance(part, int) else cut_text(part, _PART_CHARACTERS)


def _location(item: Mapping[str, Any], body: Any) -> list[str | int]:
    source, *parts = item["loc"]
    if source == "body":
        parts = location_in_body(parts, body, missing=item["type"] == "missing")
    return [source, *parts]


def _is_not_finite(value: Any) -> bool:
    return isinstance(value, float) and not math.isfinite(value)


Location = list[str | int]

_DISCRIMINATORS: Final = ("kind", "method")
"""Fields by which unions of bodies are told apart."""


def location_in_body(location: Sequence[str | int], body: Any, *, missing: bool) -> Location:
    """Return the path to the value; unchanged where it does not lead through the body.

    Pydantic puts into a location which member of a union it tried, and that is no key of the
    body: ``source, external, sensors, 1, name`` stands for ``source.sensors[1].name``.

    Args:
        location: the parts below the body.
        body: the parsed body.
        missing: whether the last part is a key that the body lacks.
    """
    parts = list(location)
    last = [parts.pop()] if missing and parts else []
    path = _path(parts, body)
    return list(location) if path is None else path + last


def _path(parts: Location, value: Any, *, tagged: bool = False) -> Location | None:
    """Return the parts that lead through the value, None where a needed one does not.

    A member's name may be the same as a key's. Where the value says by a discriminator that it is
    this member, the first part of the name is the member, and the next is the key. Otherwise of
    the two readings the one counts that more parts lead on from; as a key where both are as long.

    Args:
        parts: of the location.
        value: that they begin at.
        tagged: whether the part that says which member the value is was passed already.
    """
    if not parts:
        return []
    part, rest = parts[0], parts[1:]
    if not tagged and _is_member(value, part):
        within = _path(rest, value, tagged=True)
        if within is not None:
            return within
    below = _path(rest, value[part]) if _has(value, part) else None
    beside = None if isinstance(part, int) else _path(rest, value, tagged=tagged)
    if below is None or (beside is not None and len(beside) > len(below) + 1):
        return beside
    return [part, *below]


def _is_member(value: Any, part: str | int) -> bool:
    """Whether a value's own discriminator names this member of a union."""
    return isinstance(value, dict) and any(value.get(key) == part for key in _DISCRIMINATORS)


def _has(value: Any, part: str | int) -> bool:
    if isinstance(value, dict):
        return part in value
    return isinstance(value, list) and isinstance(part, int) and 0 <= part < len(value)
