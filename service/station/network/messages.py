"""Requests, answers and what a station says of itself, between machines: plain values only.

Nothing here is pickled. Requests name devices, holds and taps by their ids; what a device is to be
is in the database, which both ends read.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Final

import msgpack

from compute.errors import LumilineError
from service.problems.errors import StationFailed

Positions = dict[str, int]
"""Numbers of the newest messages, by the words of their subjects behind the station."""


class BadRequest(ValueError):
    """The bytes are no request or answer of this version of the bus."""


@dataclass(frozen=True)
class Presence:
    """What a station says of itself, twice a second and when it changes.

    Args:
        host: the machine.
        process_id: of the process that owns the devices.
        restarts: how often that was lost and started again.
        messages_missed: messages that were overwritten between its two processes.
        began_ns: when the station began [ns since 1970].
        positions: of all its subjects.
        configurations: what each device tracks, as a digest: another where that has changed.
        complaint: what does not work; None: all does.
        ending: whether it ends now.
    """

    host: str
    process_id: int
    restarts: int
    messages_missed: int
    began_ns: int
    positions: Positions = field(default_factory=dict)
    configurations: dict[str, str] = field(default_factory=dict)
    complaint: str | None = None
    ending: bool = False


def pack_presence(presence: Presence) -> bytes:
    """Return what a station says of itself as bytes."""
    packed: bytes = msgpack.packb(asdict(presence))
    return packed


def read_presence(data: bytes) -> Presence:
    """Return what a station says of itself; raises BadRequest."""
    try:
        return Presence(**msgpack.unpackb(data))
    except (TypeError, ValueError, msgpack.UnpackException) as error:
        raise BadRequest(f"this is no presence of a station: {error}") from error


def pack_request(args: Sequence[Any], members: Mapping[str, Any]) -> bytes:
    """Return the arguments of a call as bytes."""
    packed: bytes = msgpack.packb((list(args), dict(members)))
    return packed


def read_request(data: bytes) -> tuple[list[Any], dict[str, Any]]:
    """Return the arguments of a call; raises BadRequest."""
    try:
        args, members = msgpack.unpackb(data)
    except (TypeError, ValueError, msgpack.UnpackException) as error:
        raise BadRequest(f"this is no request to a station: {error}") from error
    if not isinstance(args, list) or not isinstance(members, dict):
        raise BadRequest("this is no request to a station: it has other members")
    return args, members


@dataclass(frozen=True)
class Reply:
    """What became of a call.

    Args:
        result: plain values.
        error: what it raised; None: nothing.
        incarnation: of the station that answers.
        positions: numbers of the newest messages of subjects that it may have caused.
        station_s: the station's clock when it answered (``time.monotonic``) [s].
    """

    result: Any
    error: LumilineError | None
    incarnation: str
    positions: Positions
    station_s: float


def pack_reply(reply: Reply) -> bytes:
    """Return an answer as bytes."""
    error = reply.error
    told = None if error is None else (error.code, error.detail, _plain(error.context))
    packed: bytes = msgpack.packb(
        (reply.result, told, reply.incarnation, reply.positions, reply.station_s)
    )
    return packed


def read_reply(data: bytes) -> Reply:
    """Return an answer; raises BadRequest."""
    try:
        result, told, incarnation, positions, station_s = msgpack.unpackb(data)
        error = None if told is None else _error(*told)
        return Reply(result, error, str(incarnation), dict(positions), float(station_s))
    except (TypeError, ValueError, msgpack.UnpackException) as error:
        raise BadRequest(f"this is no answer of a station: {error}") from error


def _plain(context: Mapping[str, object]) -> dict[str, Any]:
    simple = (str, int, float, bool, type(None))
    return {key: one if isinstance(one, simple) else str(one) for key, one in context.items()}


def _error(code: str, detail: str, context: Mapping[str, Any]) -> LumilineError:
    found = _errors().get(code, StationFailed)
    return found(detail, **{str(key): value for key, value in context.items()})


def _errors() -> dict[str, type[LumilineError]]:
    known: dict[str, type[LumilineError]] = {}
    waiting: list[type[LumilineError]] = [LumilineError]
    while waiting:
        kind = waiting.pop()
        known.setdefault(kind.code, kind)
        waiting += kind.__subclasses__()
    return known


DEADLINE_S: Final[Mapping[str, float]] = {
    "start": 60.0,
    "sensors": 60.0,
    "apply": 30.0,
    "hello": 1.0,
    "refresh": 1.0,
}
"""How long a call may take; all others ``CALL_S``."""
CALL_S: Final = 10.0
LOST_CALL_S: Final = 1.0
"""How long a call to a station may take that is lost: it may be back without a word yet."""


def deadline_s(method: str, *, lost: bool) -> float:
    """Return how long a call may take [s]."""
    known_s = DEADLINE_S.get(method, CALL_S)
    return min(known_s, LOST_CALL_S) if lost else known_s
