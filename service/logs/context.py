"""Which request or device a log line is of: set once, found wherever something is logged."""

from contextvars import ContextVar
from typing import Final

REQUEST: Final[ContextVar[str | None]] = ContextVar("lumiline_log_request", default=None)
DEVICE: Final[ContextVar[str | None]] = ContextVar("lumiline_log_device", default=None)

REFUSED: Final[ContextVar[bool]] = ContextVar("lumiline_log_refused", default=False)
"""Whether the handshake of this task's websocket was answered with a problem document."""


def set_request_id(request_id: str) -> None:
    """Have what this task, and what it starts, logs marked with a request's id."""
    REQUEST.set(request_id)


def set_device_id(device_id: str) -> None:
    """Have what this thread logs marked with a device's id."""
    DEVICE.set(device_id)
