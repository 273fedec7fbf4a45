"""Where in a body an error lies: pydantic's location without its names of union members."""

from collections.abc import Sequence
from typing import Any

Location = list[str | int]


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


def _path(parts: Location, value: Any) -> Location | None:
    """Return the parts that lead through the value, None where a needed one does not.

    A member's name may be the same as a key's: of the two readings of a part, as a key and as a
    member, the one counts that more parts lead on from; as a key where both are as long.
    """
    if not parts:
        return []
    part, rest = parts[0], parts[1:]
    below = _path(rest, value[part]) if _has(value, part) else None
    beside = None if isinstance(part, int) else _path(rest, value)
    if below is None or (beside is not None and len(beside) > len(below) + 1):
        return beside
    return [part, *below]


def _has(value: Any, part: str | int) -> bool:
    if isinstance(value, dict):
        return part in value
    return isinstance(value, list) and isinstance(part, int) and 0 <= part < len(value)
