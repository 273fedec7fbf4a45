"""Formatters of log lines: text and JSON."""

import json
import logging
import traceback
from datetime import UTC, datetime
from typing import Any, Final

from service.logs.context import DEVICE, REQUEST
from service.logs.redaction import redact

_STANDARD: Final = frozenset(vars(logging.makeLogRecord({}))) | {
    "message",
    "asctime",
    "color_message",  # of uvicorn, for terminals
    "taskName",
}
_BREAKS: Final = {number: f"\\x{number:02x}" for number in (*range(32), 127, 0x85)}
"""What could begin a line of its own, or steer a terminal."""


class TextFormatter(logging.Formatter):
    """Time, level, logger, message; then request and device where there is one."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the record as it is written; a traceback has lines of its own."""
        marks = "".join(
            f" [{name} {value}]" for name, value in _marks(record).items() if value is not None
        )
        message = record.getMessage().translate(_BREAKS)
        line = f"{_time(record)} {record.levelname} {record.name}: {message}{marks}"
        trace = _trace(record)
        return redact(line if trace is None else f"{line}\n{trace}")


class JsonFormatter(logging.Formatter):
    """One object: time, level, logger, message, request, device, what the line adds, traceback.

    Secrets are taken out value by value: a pattern over the whole line could take quotes away.
    """

    def format(self, record: logging.LogRecord) -> str:
        """Return the record as it is written."""
        fields: dict[str, Any] = {
            "time": _time(record),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **_marks(record),
            "traceback": _trace(record),
        }
        fields |= {name: value for name, value in vars(record).items() if name not in _STANDARD}
        shown = {
            name: value if isinstance(value, bool | int | float) else redact(str(value))
            for name, value in fields.items()
            if value is not None
        }
        return json.dumps(shown)


def _time(record: logging.LogRecord) -> str:
    moment = datetime.fromtimestamp(record.created, UTC)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _marks(record: logging.LogRecord) -> dict[str, str | None]:
    return {"request": REQUEST.get(), "device": getattr(record, "device", None) or DEVICE.get()}


def _trace(record: logging.LogRecord) -> str | None:
    if not record.exc_info or record.exc_info[0] is None:
        return None
    return "".join(traceback.format_exception(*record.exc_info)).rstrip()
