"""JSON bodies: their text is checked and validated, in this process or in one of its own."""

import email.message
import json
from functools import lru_cache
from typing import Any, Final

from anyio import CapacityLimiter
from anyio.to_thread import run_sync
from pydantic import TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from service.jobs.call_process import CallProcess
from service.problems.errors import (
    BodyTooLarge,
    Busy,
    DuplicateKey,
    MalformedJson,
    NotReady,
    UnsupportedMediaType,
    WorkerEnded,
)
from service.problems.field_errors import FieldErrors, InvalidRequest, field_errors

INLINE_BYTES: Final = 16 * 1024
"""Largest body that is read in the event loop itself.

The worst of this size take some 10 ms, ordinary ones 0.5 ms. In the process it would be ten times
as much, and seconds where that has to be started: readings of a hundred points stay here.
"""
_MAX_MEMBERS: Final = 1000
"""Of one object: each that a model does not know is an error of its own."""
_MAX_VALUES: Final = 2**20
"""Of one body, in lists and objects; a settings' larger body may have one in 8 bytes."""
_BYTES_PER_VALUE: Final = 8
_TIMEOUT_S: Final = 120.0
"""Seconds for a body; the largest takes some, and ten times that on a busy machine."""
_MEMORY_BYTES: Final = 2**30
_PEAK_BYTES: Final = 256 * 2**20
_MAX_WAITING: Final = 8


class BodyReader:
    """Reads large bodies, one at a time, in a process of its own.

    The libraries that parse and validate hold the interpreter's lock, so that a thread would stop
    all others, the event loop and devices with them.

    Args:
        limit_bytes: largest body.
    """

    def __init__(self, limit_bytes: int) -> None:
        self._max_values = max(_MAX_VALUES, limit_bytes // _BYTES_PER_VALUE)
        self._process = CallProcess(_MEMORY_BYTES, _PEAK_BYTES)
        self._turns = CapacityLimiter(1)
        self._waiting = 0

    async def read(self, wanted: Any, content_type: str | None, body: bytes) -> Any:
        """Return a body as a type; the arguments are those of ``read_json_body``.

        Raises:
            Busy: too many bodies wait for their turn.
            BodyTooLarge: it takes too much time or memory.
            NotReady: the server stops.
            UnsupportedMediaType, MalformedJson, DuplicateKey, InvalidRequest: as
                ``read_json_body``.
        """
        if self._waiting >= _MAX_WAITING:
            raise Busy(f"{self._waiting} large bodies wait to be read; send this one again later")
        self._waiting += 1
        try:
            # In a thread that is no other request's, and after those that came before.
            found = await run_sync(self._call, wanted, content_type, body, limiter=self._turns)
        finally:
            self._waiting -= 1
        if isinstance(found, FieldErrors):
            raise InvalidRequest(found)
        return found

    def close(self) -> None:
        """End the process."""
        self._process.close()

    def _call(self, wanted: Any, content_type: str | None, body: bytes) -> Any:
        try:
            return self._process.call(
                read_json_body, wanted, content_type, body, self._max_values, timeout_s=_TIMEOUT_S
            )
        except WorkerEnded as error:
            if self._process.closed:
                raise NotReady(error.detail) from error
            raise BodyTooLarge(
                f"the body could not be read within {_TIMEOUT_S:g} s and {_MEMORY_BYTES} bytes of "
                f"memory: {error.detail}"
            ) from error


def read_json_body(wanted: Any, content_type: str | None, body: bytes, max_values: int) -> Any:
    """Return a body as a type, or the ``FieldErrors`` for which it does not fit.

    Args:
        wanted: what ``TypeAdapter`` takes.
        content_type: the request's, None without.
        body: its text.
        max_values: of the body.

    Raises:
        UnsupportedMediaType, MalformedJson, DuplicateKey, BodyTooLarge: as ``check_json_body``.
    """
    check_json_body(content_type, body, max_values)
    try:
        return validate_text(_adapter(wanted), body)
    except ValidationError as error:
        found = [{**item, "loc": ("body", *item["loc"])} for item in error.errors()]
    return field_errors(found, json.loads(body))


@lru_cache(maxsize=64)
def _adapter(wanted: Any) -> TypeAdapter[Any]:
    return TypeAdapter(wanted)


def validate_text(adapter: TypeAdapter[Any], text: str | bytes) -> Any:
    """Return a JSON text as the adapter's type, in strict mode but that 8.0 is an integer.

    Raises:
        ValidationError: it does not fit.
    """
    try:
        return adapter.validate_json(text, strict=True)
    except ValidationError as error:
        if not any(_is_whole_number(item) for item in error.errors()):
            raise
    return adapter.validate_json(_with_whole_numbers(text), strict=True)


def _is_whole_number(error: ErrorDetails) -> bool:
    """Whether a strict validation refused 8.0 as an integer, which JSON schema says it is."""
    found = error["input"]
    return error["type"] == "int_type" and isinstance(found, float) and found.is_integer()


def _with_whole_numbers(text: str | bytes) -> str:
    """Write the whole numbers of a JSON text without a decimal point."""

    def number(literal: str) -> float | int:
        value = float(literal)
        return int(value) if value.is_integer() else value

    return json.dumps(json.loads(text, parse_float=number))


def check_json_body(content_type: str | None, body: bytes, max_values: int = _MAX_VALUES) -> None:
    """Check that a body is JSON, says so, and gives no key of an object twice.

    Args:
        content_type: the request's, None without.
        body: its text.
        max_values: of the body; counted before it is parsed.

    Raises:
        UnsupportedMediaType, MalformedJson, DuplicateKey.
        BodyTooLarge: it has too many values, or an object too many members.
    """
    if not _is_json(content_type) and (content_type or body):
        given = f'"{content_type}"' if content_type else "not given"
        raise UnsupportedMediaType(f"the body's media type is {given}; send application/json")
    if not body:
        return
    values = sum(map(body.count, (b",", b"[", b"{")))
    if values > max_values:
        raise BodyTooLarge(f"the body has about {values} values; the limit is {max_values}")
    try:
        json.loads(body, object_pairs_hook=_unique)
    except json.JSONDecodeError as error:
        found = json.dumps(error.doc[error.pos : error.pos + 20])
        raise MalformedJson(
            f"the body is not JSON: {error.msg} at line {error.lineno} column {error.colno}, "
            f"where it has {found}; send a JSON document"
        ) from error
    except UnicodeDecodeError as error:
        raise MalformedJson(f"the body is not UTF-8: {error.reason}; send UTF-8") from error
    except RecursionError as error:
        raise MalformedJson("the body is nested too deeply to be read") from error
    except ValueError as error:  # an integer of thousands of digits
        raise MalformedJson(f"the body cannot be read: {error}") from error


def _unique(pairs: list[tuple[str, Any]]) -> None:
    if len(pairs) > _MAX_MEMBERS:
        raise BodyTooLarge(
            f"an object of the body has {len(pairs)} members; the limit is {_MAX_MEMBERS}"
        )
    seen: set[str] = set()
    for key, _ in pairs:
        if key in seen:
            raise DuplicateKey(
                f"the key {json.dumps(key)} is given twice in one object; give it once", key=key
            )
        seen.add(key)


def _is_json(content_type: str | None) -> bool:
    message = email.message.Message()
    message["content-type"] = content_type or ""
    if message.get_content_maintype() != "application" or not content_type:
        return False
    subtype = message.get_content_subtype()
    return subtype == "json" or subtype.endswith("+json")
