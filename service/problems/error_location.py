"""Where in a body an error lies: pydantic's location without its names of union members."""

from collections.abc import Sequence
from typing import Any, Final

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
    found = _path(parts, body)
    return list(location) if found is None else found + last


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
