"""Query of the websocket: parameters of a stream, parsed and checked."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, TypeVar

from compute.errors import InvalidParameter
from service.api.base_models import checked_slug
from service.protocols.stream.hub import StreamRequest
from service.protocols.stream.messages import CONTENTS, ENCODINGS, Content

STATE: Final = "state"
"""The content that every client gets; by itself, without frames."""
MODES: Final = ("live", "lossless")
MAX_RATE_HZ: Final = 100_000.0
MAX_BUNDLE_MS: Final = 1000.0

T = TypeVar("T")


@dataclass(frozen=True)
class StreamQuery:
    """The query of the websocket, as it is sent."""

    device_id: str | None = None
    content: str | None = None
    encoding: str | None = None
    mode: str | None = None
    rate_hz: str | None = None
    bundle_ms: str | None = None
    stream: str | None = None
    after: str | None = None

    def given(self) -> dict[str, str]:
        """Return what it has."""
        return {name: value for name, value in vars(self).items() if value is not None}


def parse_stream_request(query: Mapping[str, str]) -> StreamRequest:
    """Return the stream that a query asks for.

    Raises:
        InvalidParameter: it has something that contradicts itself.
    """
    if not query.get("device_id"):
        raise InvalidParameter("the query names no device; add ?device_id=ID")
    lossless = _one_of(query, "mode", MODES) == "lossless"
    rate_hz = _number(query, "rate_hz", MAX_RATE_HZ, "Hz")
    bundle_ms = _number(query, "bundle_ms", MAX_BUNDLE_MS, "ms")
    if rate_hz is not None and (lossless or bundle_ms is not None):
        other = "mode=lossless" if lossless else "bundle_ms"
        raise InvalidParameter(
            f"the query has rate_hz, the newest frame now and then, and {other}, all of them; "
            "leave one of them out"
        )
    after = query.get("after")
    if not lossless and (after is not None or "stream" in query):
        raise InvalidParameter(
            "the query has stream or after without mode=lossless; only a lossless stream goes on "
            "where another ended"
        )
    if (after is None) != ("stream" not in query):
        raise InvalidParameter(
            "the query has one of stream and after; give both: the stream's id of hello, and the "
            "number n of the last message that you have, or neither"
        )
    return StreamRequest(
        checked_slug(query["device_id"]),
        _content(query.get("content", "points")),
        _one_of(query, "encoding", ENCODINGS),
        lossless=lossless,
        rate_hz=rate_hz,
        bundle_s=None if bundle_ms is None else bundle_ms / 1000.0,
        stream=query.get("stream"),
        after=None if after is None else _parse_integer(after),
    )


def _content(text: str) -> frozenset[Content]:
    contents = {str(one): one for one in CONTENTS}
    words = text.split(",")
    for word in words:
        if word != STATE and word not in contents:
            raise InvalidParameter(
                f'content has "{word}"; it must be one or more of ' + ", ".join((*CONTENTS, STATE))
            )
    return frozenset(contents[word] for word in words if word != STATE)


def _one_of(query: Mapping[str, str], name: str, allowed: tuple[T, ...]) -> T:
    """Return the value of a parameter; the first that is known when it is left out."""
    value = query.get(name)
    if value is None:
        return allowed[0]
    for one in allowed:
        if one == value:
            return one
    raise InvalidParameter(f'{name} is "{value}"; it must be {" or ".join(map(str, allowed))}')


def _number(query: Mapping[str, str], name: str, most: float, unit: str) -> float | None:
    text = query.get(name)
    if text is None:
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value <= most:
        raise InvalidParameter(
            f'{name} is "{text}"; it must be a number above 0, at most {most:g} {unit}'
        )
    return value


def _parse_integer(text: str) -> int:
    if not text.isascii() or not text.isdigit() or len(text) > 18:
        raise InvalidParameter(
            f'after is "{text}"; it must be the number n of the last message that you have'
        )
    return int(text)
