"""Context of log lines: the request or device that they belong to."""

from contextvars import ContextVar
from dataclasses import dataclass
from typing import Final, Literal

from starlette.types import Scope

REQUEST: Final[ContextVar[str | None]] = ContextVar("lumiline_log_request", default=None)
DEVICE: Final[ContextVar[str | None]] = ContextVar("lumiline_log_device", default=None)

REFUSED: Final[ContextVar[bool]] = ContextVar("lumiline_log_refused", default=False)
"""Whether the handshake of this task's websocket was answered with a problem document."""


def set_request_id(request_id: str) -> None:
    """Mark log lines of this task, and of those it starts, with a request's id."""
    REQUEST.set(request_id)


def set_device_id(device_id: str) -> None:
    """Mark log lines of this thread with a device's id."""
    DEVICE.set(device_id)


RECORD: Final = "lumiline.request"
"""Under which the ASGI scope has its request's record."""


@dataclass
class RequestRecord:
    """One request, from its first byte to the last of its answer.

    Args:
        id: its X-Request-ID, or one made for it.
        kind: http or websocket.
        method: of a websocket, GET.
        route: template of the path that the router found; None: it found none.
        status: of the answer, 101 for a websocket that was opened; None: none was begun.
        duration_s: until its end, for a websocket until it was opened or refused.
    """

    id: str
    kind: Literal["http", "websocket"]
    method: str
    route: str | None = None
    status: int | None = None
    duration_s: float = 0.0


def request_record(scope: Scope) -> RequestRecord:
    """Return the record of the request that a scope is of."""
    record: RequestRecord = scope[RECORD]
    return record
