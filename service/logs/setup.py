"""Configures logging: every logger, also of the server and libraries, in one format."""

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from service.logs.context import REFUSED
from service.logs.formatter import JsonFormatter, TextFormatter
from service.settings import Settings

_SERVER_LOGGERS: Final = ("service", "hardware", "compute")
_UVICORN: Final = "uvicorn.error"
_WEBSOCKET_MESSAGES: Final = (
    '%s - "WebSocket',
    "connection open",
    "connection closed",
    "connection rejected",
)


@contextmanager
def configured_logging(settings: Settings) -> Iterator[None]:
    """Log to standard error in the form, and from the level, that the settings say."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter() if settings.log_format == "json" else TextFormatter())
    level = settings.log_level.upper()
    loggers = [logging.getLogger(name) for name in (*_SERVER_LOGGERS, _UVICORN)]
    before = [logger.level for logger in loggers]
    root = logging.getLogger()
    for logger in loggers:
        logger.setLevel(level)
    logging.getLogger(_UVICORN).addFilter(is_server_record)
    root.addHandler(handler)
    try:
        yield
    finally:
        root.removeHandler(handler)
        logging.getLogger(_UVICORN).removeFilter(is_server_record)
        for logger, was in zip(loggers, before, strict=True):
            logger.setLevel(was)


def is_server_record(record: logging.LogRecord) -> bool:
    """Whether a line of uvicorn is about the server; websockets are logged by the service.

    It also takes a handshake that was answered with a problem document for one that was not.
    """
    text = str(record.msg)
    if text.startswith(_WEBSOCKET_MESSAGES):
        return False
    return not (text.startswith("ASGI callable returned without") and REFUSED.get())
