"""Exception handlers that answer with problem documents, application/problem+json (RFC 9457)."""

import errno
import json
import logging
import math
import secrets
from collections.abc import Mapping, Sequence
from typing import Any, Final

from fastapi import FastAPI
from fastapi.exceptions import RequestValidationError
from fastapi.routing import iter_route_contexts
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import Receive, Scope, Send
from starlette.websockets import WebSocket

from compute.errors import LumilineError, NonFiniteValue
from service.logs import request_record
from service.problems.catalogue import (
    MEDIA_TYPE,
    PROBLEM_TYPES,
    FieldError,
    Problem,
    ProblemType,
    problem_type_of,
)
from service.problems.errors import BodyTooLarge, BodyTooSlow, InsufficientStorage, MalformedJson

_log = logging.getLogger(__name__)

_INPUT_CHARACTERS = 200
_MESSAGE_CHARACTERS = 500
MAX_ERRORS: Final = 50
"""Errors of one answer; more than a person would mend before trying again."""
_MAX_ERRORS_IN_DETAIL = 3
_RETRY_AFTER_S = 5
_BY_STATUS = {
    404: "not-found",
    405: "method-not-allowed",
    413: BodyTooLarge.code,
    408: BodyTooSlow.code,
}

SECURITY_HEADERS: Final[Mapping[str, str]] = {
    # Reports bring their styles and figures with them; no page but those of /docs has scripts.
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; img-src data:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
}
"""Of all answers; a page that needs another policy for its content sets it itself."""


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
    """Return the value as JSON text, cut to a length that fits a message."""
    if isinstance(value, float) and not math.isfinite(value):
        return str(json_safe(value))
    text = json.dumps(json_safe(value), ensure_ascii=True)
    return text if len(text) <= _INPUT_CHARACTERS else text[: _INPUT_CHARACTERS - 3] + "..."


def problem_response(
    kind: ProblemType,
    detail: str,
    instance: str,
    *,
    errors: list[FieldError] | None = None,
    context: Mapping[str, object] | None = None,
    headers: Mapping[str, str] | None = None,
) -> Response:
    """Return the response that carries a problem document; 503 says when to try again."""
    problem = Problem(
        type=kind.type,
        title=kind.title,
        status=kind.status,
        detail=detail,
        instance=instance,
        errors=errors,
        context=json_safe(context) if context else None,
    )
    content = json.dumps(problem.model_dump(exclude_none=True), ensure_ascii=True)
    if kind.status == 503:
        headers = {"Retry-After": str(_RETRY_AFTER_S), **(headers or {})}
    return Response(content, kind.status, headers, MEDIA_TYPE)


def error_response(
    error: LumilineError, instance: str, headers: Mapping[str, str] | None = None
) -> Response:
    """Return the response that tells of an error."""
    kind = problem_type_of(type(error))
    return problem_response(kind, error.detail, instance, context=error.context, headers=headers)


async def refuse(response: Response, scope: Scope, receive: Receive, send: Send) -> None:
    """Answer a request, or a websocket's handshake, which is closed where that cannot be done."""
    if scope["type"] != "websocket":
        await response(scope, receive, send)
        return
    websocket = WebSocket(scope, receive, send)
    if "websocket.http.response" in scope.get("extensions", {}):
        await websocket.send_denial_response(response)
    else:
        await websocket.close(1008)


async def unknown_websocket(websocket: WebSocket) -> None:
    """Answer a handshake for a path that has no websocket."""
    path = websocket.url.path
    detail = f"no websocket has the path {path}; the stream is at /api/v1/stream"
    response = problem_response(PROBLEM_TYPES["not-found"], detail, path)
    await refuse(response, websocket.scope, websocket.receive, websocket.send)


async def _domain_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, LumilineError)
    return error_response(error, request.url.path)


async def _validation_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    found: Sequence[Mapping[str, Any]] = error.errors()
    kinds = {item["type"] for item in found}
    if "json_invalid" in kinds:
        item = next(item for item in found if item["type"] == "json_invalid")
        reason = item.get("ctx", {}).get("error", item["msg"])
        detail = f"the body is not JSON: {reason}; send a JSON document"
        return error_response(MalformedJson(detail), request.url.path)
    body = _parsed(error.body)
    errors = [
        FieldError(
            location=[_cut(part) for part in _location(item, body)],
            message=item["msg"][:_MESSAGE_CHARACTERS],
            input=display_value(item.get("input")),
        )
        for item in found[:MAX_ERRORS]
    ]
    not_finite = any(_is_not_finite(item.get("input")) for item in found)
    kind = problem_type_of(NonFiniteValue) if not_finite else PROBLEM_TYPES["invalid-request"]
    return problem_response(kind, _summary(errors, len(found)), request.url.path, errors=errors)


def _cut(part: str | int) -> str | int:
    return part if isinstance(part, int) or len(part) <= 100 else f"{part[:97]}..."


def _parsed(body: Any) -> Any:
    """Return the body, which is the text that was read where it was JSON; see ``JsonTypes``."""
    return json.loads(body) if isinstance(body, bytes) and body else body


def _location(item: Mapping[str, Any], body: Any) -> list[str | int]:
    source, *parts = item["loc"]
    if source == "body":
        parts = location_in_body(parts, body, missing=item["type"] == "missing")
    return [source, *parts]


def _is_not_finite(value: Any) -> bool:
    return isinstance(value, float) and not math.isfinite(value)


def _summary(errors: Sequence[FieldError], count: int) -> str:
    parts = [
        f"{'.'.join(str(part) for part in item.location)}: {item.message}, got {item.input}"
        for item in errors[:_MAX_ERRORS_IN_DETAIL]
    ]
    more = count - _MAX_ERRORS_IN_DETAIL
    return "; ".join(parts) + (f"; and {more} more" if more > 0 else "")


async def _http_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    kind = PROBLEM_TYPES[_BY_STATUS.get(error.status_code, "bad-request")]
    headers = dict(error.headers or {})
    path = request.url.path
    if error.status_code == 404:
        detail = f"no resource has the path {path}; /openapi.json lists all paths"
    elif error.status_code == 405:
        headers["Allow"] = ", ".join(allowed_methods(request))
        detail = f"{request.method} is not possible here; possible are {headers['Allow']}"
    else:
        detail = str(error.detail)
    return problem_response(kind, detail, path, headers=headers)


def allowed_methods(request: Request) -> list[str]:
    """Return the methods that the request's path has, HEAD with GET.

    As the OpenAPI document has them, which takes seconds to make: segment by segment. By the
    routes' own patterns `/recordings/x/stop` would be the recording `x/stop`, too, which can be
    deleted.
    """
    segments = request.url.path.strip("/").split("/")
    methods: set[str] = set()
    for route in iter_route_contexts(request.app.routes):
        template = (route.path_format or "").strip("/").split("/")
        if len(template) == len(segments) and all(
            part.startswith("{") or part == segment
            for part, segment in zip(template, segments, strict=True)
        ):
            methods |= route.methods or set()
    if "GET" in methods or not methods:
        methods |= {"GET", "HEAD"}
    return sorted(methods)


async def _os_error(request: Request, error: Exception) -> Response:
    """Answer a write to a full disk, or beyond a quota; other errors are unexpected."""
    assert isinstance(error, OSError)
    if error.errno not in (errno.ENOSPC, errno.EDQUOT):
        raise error
    _log.error("no room on the disk: %s", error)
    detail = "the disk of the data directory is full; make room on it: delete recordings or exports"
    return error_response(InsufficientStorage(detail), request.url.path)


async def _unexpected_error(request: Request, error: Exception) -> Response:
    # The cause may hold paths, queries or passwords: it goes to the log, a reference to the user.
    reference = secrets.token_hex(4)
    _log.error("unexpected error, reference %s", reference, exc_info=error)
    detail = f"unexpected error; the server's log has it under reference {reference}"
    # Answered around all middleware, and so around what names answers.
    headers = {"X-Request-ID": request_record(request.scope).id, **SECURITY_HEADERS}
    kind = PROBLEM_TYPES["internal-error"]
    return problem_response(kind, detail, request.url.path, headers=headers)


def install_problem_handlers(app: FastAPI) -> None:
    """Register the handlers with the application."""
    app.add_exception_handler(LumilineError, _domain_error)
    app.add_exception_handler(RequestValidationError, _validation_error)
    app.add_exception_handler(HTTPException, _http_error)
    app.add_exception_handler(OSError, _os_error)
    app.add_exception_handler(Exception, _unexpected_error)


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
