"""Errors that the client raises."""

import json
from typing import Any


class ClientError(Exception):
    """Base of all errors of the client."""


class ServerUnreachable(ClientError):
    """The server did not answer, or the connection to it was lost."""


class UnreadableMessage(ClientError):
    """The server sent something that is no message of a stream and no document of its API."""


class StreamEnded(ClientError):
    """The server ended a stream for good.

    Args:
        code: of the websocket's close: 1008 when the key was revoked or has expired.
        reason: in words.
    """

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(f"the server ended the stream: {reason or 'no reason given'} ({code})")
        self.code = code
        self.reason = reason


class ServerProblem(ClientError):
    """The server refused a request, with a reason (problem document, RFC 9457).

    Args:
        status: of HTTP.
        code: stable name of the problem, such as ``unknown-device``; the path /problems/CODE of
            the server says what it means. Empty where what answered is no Lumiline server.
        detail: what was wrong, with the value, and what would be right.
        errors: each invalid member of the request, as the document lists them.
        context: the values by name.
        retry_after_s: how long to wait before asking again [s]; None: not said.
    """

    def __init__(
        self,
        status: int,
        code: str,
        detail: str,
        errors: list[dict[str, Any]] | None = None,
        context: dict[str, Any] | None = None,
        retry_after_s: float | None = None,
    ) -> None:
        super().__init__(f"{status} {code}: {detail}")
        self.status = status
        self.code = code
        self.detail = detail
        self.errors = errors or []
        self.context = context or {}
        self.retry_after_s = retry_after_s


class ResourceChanged(ServerProblem):
    """The resource was changed by somebody else after it was read; nothing was done.

    Read it again, and apply the change to what it is now.
    """


def server_problem(status: int, body: bytes, retry_after: str | None = None) -> ServerProblem:
    """Return the problem that a response reports; its body may be anything."""
    try:
        document = json.loads(body)
    except ValueError:
        document = None
    if not isinstance(document, dict):
        text = body[:200].decode("utf-8", "replace").strip()
        document = {"detail": text or "no reason given"}
    kind, errors, context = (document.get(name) for name in ("type", "errors", "context"))
    problem = ResourceChanged if status == 412 else ServerProblem
    return problem(
        status,
        kind.rsplit("/", 1)[-1] if isinstance(kind, str) else "",
        str(document.get("detail") or document.get("title") or "no reason given"),
        errors if isinstance(errors, list) else None,
        context if isinstance(context, dict) else None,
        float(retry_after) if retry_after is not None and retry_after.isdigit() else None,
    )
