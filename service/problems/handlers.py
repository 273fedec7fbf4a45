"""Exception handlers that answer with problem documents, application/problem+json (RFC 9457)."""

import errno
import json
import logging
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
from service.problems.bounds import (
    DETAIL_CHARACTERS,
    INSTANCE_CHARACTERS,
    bound_context,
    bound_errors,
    cut_text,
)
from service.problems.catalogue import (
    MEDIA_TYPE,
    PROBLEM_TYPES,
    FieldError,
    Problem,
    ProblemType,
    problem_type_of,
)
from service.problems.errors import BodyTooLarge, BodyTooSlow, InsufficientStorage, MalformedJson
from service.problems.field_errors import FieldErrors, InvalidRequest, field_errors

_log = logging.getLogger(__name__)

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


def problem_response(
    kind: ProblemType,
    detail: str,
    instance: str,
    *,
    errors: list[FieldError] | None = None,
    context: Mapping[str, object] | None = None,
    headers: Mapping[str, str] | None = None,
) -> Response:
    """Return the response that carries a problem document; 503 says when to try again.

    It has at most 64 KiB, whatever the request held.
    """
    problem = Problem(
        type=kind.type,
        title=kind.title,
        status=kind.status,
        detail=cut_text(detail, DETAIL_CHARACTERS),
        instance=cut_text(instance, INSTANCE_CHARACTERS),
        errors=None if errors is None else bound_errors(errors),
        context=bound_context(context) if context else None,
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
    errors: Sequence[Mapping[str, Any]] = error.errors()
    kinds = {item["type"] for item in errors}
    if "json_invalid" in kinds:
        item = next(item for item in errors if item["type"] == "json_invalid")
        reason = item.get("ctx", {}).get("error", item["msg"])
        detail = f"the body is not JSON: {reason}; send a JSON document"
        return error_response(MalformedJson(detail), request.url.path)
    return _invalid_response(field_errors(errors, _parsed(error.body)), request.url.path)


async def _invalid_request(request: Request, error: Exception) -> Response:
    assert isinstance(error, InvalidRequest)
    return _invalid_response(error.errors, request.url.path)


def _invalid_response(errors: FieldErrors, instance: str) -> Response:
    code = NonFiniteValue.code if errors.not_finite else "invalid-request"
    return problem_response(
        PROBLEM_TYPES[code], errors.summary(), instance, errors=list(errors.errors)
    )


def _parsed(body: Any) -> Any:
    """Return the body, which is the text that was read where it was JSON; see ``JsonTypes``."""
    return json.loads(body) if isinstance(body, bytes) and body else body


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
    app.add_exception_handler(InvalidRequest, _invalid_request)
    app.add_exception_handler(HTTPException, _http_error)
    app.add_exception_handler(OSError, _os_error)
    app.add_exception_handler(Exception, _unexpected_error)
