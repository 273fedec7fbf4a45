"""Bounds of problem documents: texts, values by name and errors, whatever a request holds."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from service.problems.catalogue import FieldError

MAX_ERRORS: Final = 50
"""Errors of one answer; more than a person would correct before trying again."""
DETAIL_CHARACTERS: Final = 4_000
INSTANCE_CHARACTERS: Final = 2_000
_INPUT_CHARACTERS: Final = 200
_TEXT_CHARACTERS: Final = 500
_CONTEXT_BYTES: Final = 12 * 1024
_ERRORS_BYTES: Final = 32 * 1024


def cut_text(text: str, limit: int) -> str:
    """Return the text, or its begin and "..." where its JSON text has more characters.

    Args:
        text: the text.
        limit: characters of its JSON text, without the quotation marks; one of the text has up
            to 12 of them.
    """
    if len(text) <= limit and len(json.dumps(text)) - 2 <= limit:
        return text
    room = limit - 3
    for index, character in enumerate(text):
        room -= len(json.dumps(character)) - 2
        if room < 0:
            return text[:index] + "..."
    return text


def json_safe(value: Any) -> Any:
    """Return the value as JSON can hold it: NaN and infinities as text, unknown types by repr."""
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        if math.isfinite(value):
            return value
        return "NaN" if math.isnan(value) else ("Infinity" if value > 0 else "-Infinity")
    if isinstance(value, Mapping):
        return {str(key): json_safe(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [json_safe(item) for item in value]
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return repr(value)


def display_value(value: Any) -> str:
    """Return the value as JSON text, cut to a length that fits a message.

    What is cut off is not written first: the value may be a whole body, once for each error.
    """
    if isinstance(value, float) and not math.isfinite(value):
        return str(json_safe(value))
    text = ""
    for piece in _pieces(value):
        text += piece
        if len(text) > _INPUT_CHARACTERS:
            return text[: _INPUT_CHARACTERS - 3] + "..."
    return text


def _pieces(value: Any) -> Iterator[str]:
    """Yield the JSON text of a value; of a long text in it no more than is shown."""
    if isinstance(value, Mapping):
        yield "{"
        for number, (key, item) in enumerate(value.items()):
            yield f"{', ' if number else ''}{json.dumps(str(key)[: _INPUT_CHARACTERS + 1])}: "
            yield from _pieces(item)
        yield "}"
    elif isinstance(value, list | tuple | set | frozenset):
        yield "["
        for number, item in enumerate(value):
            yield ", " if number else ""
            yield from _pieces(item)
        yield "]"
    elif isinstance(value, str | bytes):
        yield json.dumps(json_safe(value[: _INPUT_CHARACTERS + 1]))
    else:
        yield json.dumps(json_safe(value))


def bound_context(context: Mapping[str, object]) -> dict[str, Any]:
    """Return the values by name as JSON can hold them, without what is too long for an answer.

    Of long lists and objects the first items stay, of long texts the begin; a value for which
    even so there is no room is left out.
    """
    kept: dict[str, Any] = {}
    room = _CONTEXT_BYTES
    for name, value in context.items():
        short = _shortened(json_safe(value))
        size = len(json.dumps({name: short}))
        if size <= room:
            kept[name] = short
            room -= size
    return kept


def _shortened(value: Any) -> Any:
    if isinstance(value, str):
        return cut_text(value, _TEXT_CHARACTERS)
    if isinstance(value, list):
        return [_shortened(item) for item in value[:MAX_ERRORS]]
    if isinstance(value, dict):
        first = list(value.items())[:MAX_ERRORS]
        return {cut_text(key, _TEXT_CHARACTERS): _shortened(item) for key, item in first}
    return value


def bound_errors(errors: Sequence[FieldError]) -> list[FieldError]:
    """Return the first errors, as many as an answer has room for; at least one where there are."""
    kept: list[FieldError] = []
    room = _ERRORS_BYTES
    for error in errors[:MAX_ERRORS]:
        room -= len(json.dumps(error.model_dump()))
        if room < 0 and kept:
            break
        kept.append(error)
    return kept
