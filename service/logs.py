"""Logging: the request or device of a line, redaction of secrets, text and JSON, set-up."""

import json
import logging
import re
import sys
import traceback
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Final, Literal
from urllib.parse import unquote

from starlette.types import Scope

from service.settings import Settings

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


_HIDDEN: Final = (
    # What begins like a key, also one that is cut or mistyped, with all parts that follow: a whole
    # key may stand behind "lumi_".
    (re.compile(r"lumi(?:_[A-Za-z0-9]++){2,}+"), "lumi_***"),
    # JSON web tokens: the first part is an object in base64. Of what stands directly before, only
    # the first place in a word where one could begin is tried.
    (
        re.compile(
            r"(?<![A-Za-z0-9_-])(?>([A-Za-z0-9_-]*?)eyJ)[A-Za-z0-9_-]{5,}+"
            r"(?:\.[A-Za-z0-9_-]*+){1,4}"
        ),
        r"\1***",
    ),
    (re.compile(r"(?i)\b(bearer|basic)( |%20|\+)+[A-Za-z0-9._~+/=-]+"), r"\1 ***"),
    # The password of a database's URL, and values of query parameters that are named for one.
    (re.compile(r"(://[^\s:/@]*+):[^\s/]*@"), r"\1:***@"),
    (re.compile(r"(?i)\b((?:api_?key|access_token|token|key|password)=)[^\s&\"']+"), r"\1***"),
)

_MAX_DECODINGS: Final = 10


def redact(text: str) -> str:
    """Return the text with ``***`` in place of keys, tokens and passwords."""
    for pattern, replacement in _HIDDEN:
        text = pattern.sub(replacement, text)
    return text


def decoded(text: str) -> str:
    """Return a part of an address as it is meant: ``%5F``, and ``%255F``, hide an underscore.

    Decoded until nothing is left to decode; what is encoded too often to be meant is hidden.
    """
    for _ in range(_MAX_DECODINGS):
        before, text = text, unquote(text)
        if text == before:
            return text
    return "***"


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
        redacted = {
            name: value if isinstance(value, bool | int | float) else redact(str(value))
            for name, value in fields.items()
            if value is not None
        }
        return json.dumps(redacted)


def _time(record: logging.LogRecord) -> str:
    moment = datetime.fromtimestamp(record.created, UTC)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _marks(record: logging.LogRecord) -> dict[str, str | None]:
    return {"request": REQUEST.get(), "device": getattr(record, "device", None) or DEVICE.get()}


def _trace(record: logging.LogRecord) -> str | None:
    if not record.exc_info or record.exc_info[0] is None:
        return None
    return "".join(traceback.format_exception(*record.exc_info)).rstrip()


ACCESS: Final = "service.access"
"""Logger of the lines of requests."""
MAX_RECENT: Final = 1000
"""Log records that are kept to be looked at; a few hundred bytes each."""


@dataclass(frozen=True)
class RecentRecord:
    """A log record as it can be looked at, without secrets.

    Args:
        number: counted from the server's start.
        created_s: when, since 1970 [s].
        level: in lower case.
        logger: by which part.
        message: what.
        request_id: of the request that it belongs to.
        device_id: of the device.
        traceback: of an error.
    """

    number: int
    created_s: float
    level: str
    logger: str
    message: str
    request_id: str | None
    device_id: str | None
    traceback: str | None


class RecentRecords(logging.Handler):
    """Keeps the newest log records in memory."""

    def __init__(self) -> None:
        super().__init__()
        self._records: deque[RecentRecord] = deque(maxlen=MAX_RECENT)
        self._count = 0

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a record; called under the handler's lock."""
        if record.name == ACCESS and record.levelno < logging.WARNING:
            return  # requests, of which a page that shows these makes several a second
        try:
            marks, trace = _marks(record), _trace(record)
            self._count += 1
            self._records.append(
                RecentRecord(
                    self._count,
                    record.created,
                    record.levelname.lower(),
                    record.name,
                    redact(record.getMessage()),
                    marks["request"],
                    marks["device"],
                    None if trace is None else redact(trace),
                )
            )
        except Exception:  # noqa: BLE001 - as logging's own handlers: a log line breaks nothing
            self.handleError(record)

    def newest(self) -> list[RecentRecord]:
        """Return the kept records, oldest first."""
        with self.lock or nullcontext():
            return list(self._records)


RECENT: Final = RecentRecords()
"""Of this process, while its logging is configured."""

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
    root.addHandler(RECENT)
    try:
        yield
    finally:
        root.removeHandler(handler)
        root.removeHandler(RECENT)
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
