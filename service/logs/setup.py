"""Sets logging up: every logger, the server's own and libraries' too, in one form."""

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from service.logs.context import REFUSED
from service.logs.formatter import JsonFormatter, TextFormatter
from service.settings import Settings

_OURS: Final = ("service", "hardware", "compute")
_UVICORN: Final = "uvicorn.error"
_OF_WEBSOCKETS: Final = (
    '%s - "WebSocket',
    "connection open",
    "connection closed",
    "connection rejected",
)


@contextmanager
def logging_as(settings: Settings) -> Iterator[None]:
    """Log to standard error in the form, and from the level, that the settings say."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter() if settings.log_format == "json" else TextFormatter())
    level = settings.log_level.upper()
    loggers = [logging.getLogger(name) for name in (*_OURS, _UVICORN)]
    before = [logger.level for logger in loggers]
    root = logging.getLogger()
    for logger in loggers:
        logger.setLevel(level)
    logging.getLogger(_UVICORN).addFilter(of_the_server)
    root.addHandler(handler)
    try:
        yield
    finally:
        root.removeHandler(handler)
        logging.getLogger(_UVICORN).removeFilter(of_the_server)
        for logger, was in zip(loggers, before, strict=True):
            logger.setLevel(was)


def of_the_server(record: logging.LogRecord) -> bool:
    """Whether uvicorn tells something of the server; of each websocket our own lines do.

    It also takes a handshake that was answered with a problem document for one that was not.
    """
    text = str(record.msg)
    if text.startswith(_OF_WEBSOCKETS):
        return False
    return not (text.startswith("ASGI callable returned without") and REFUSED.get())
