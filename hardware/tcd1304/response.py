"""Collects a board's response, which is unframed and delimited by silence."""

from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hardware.tcd1304.protocol import ELEMENTS, FULL_SCALE, RESPONSE_BYTES


@dataclass(frozen=True, eq=False)
class Response:
    """One response.

    Args:
        counts: raw counts, uint16, shape (3694,); dark is high.
        first_byte_ns: arrival of its first bytes.
    """

    counts: NDArray[np.uint16]
    first_byte_ns: int


class Fault(Enum):
    """Reason why bytes between two silences are not a response."""

    SHORT = "short"
    LONG = "long"
    RANGE = "range"


@dataclass(frozen=True)
class InvalidResponse:
    """Bytes that are not a response, and the reason."""

    fault: Fault
    bytes: int
    detail: str


_FORMAT: Final = np.dtype("<u2")


class ResponseCollector:
    """Collects responses; never raises on input, and buffers at most one response.

    Lost, doubled or foreign bytes shift all that follows them, and nothing in the stream tells
    where a line begins. So whatever came between two silences is an answer when it has exactly
    its length and 12-bit counts, and nothing otherwise.
    """

    def __init__(self) -> None:
        self._kept = bytearray()
        self._bytes = 0
        self._first_ns = 0

    @property
    def pending(self) -> int:
        """Bytes since the last silence."""
        return self._bytes

    def feed(self, data: bytes, now_ns: int) -> None:
        """Add received bytes and their arrival time."""
        if not data:
            return
        if not self._bytes:
            self._first_ns = now_ns
        self._bytes += len(data)
        self._kept += data[: RESPONSE_BYTES - len(self._kept)]

    def silence(self) -> Response | InvalidResponse | None:
        """Evaluate the bytes before a silence; None: there were none."""
        count, kept = self._bytes, bytes(self._kept)
        self.clear()
        if not count:
            return None
        if count != RESPONSE_BYTES:
            short = count < RESPONSE_BYTES
            return InvalidResponse(
                Fault.SHORT if short else Fault.LONG,
                count,
                f"{count} bytes came where an answer has {RESPONSE_BYTES}",
            )
        counts = np.frombuffer(kept, _FORMAT).astype(np.uint16)
        largest = int(counts.max())
        if largest > FULL_SCALE:
            where = int(counts.argmax())
            return InvalidResponse(
                Fault.RANGE,
                count,
                f"element {where} of {ELEMENTS} is {largest}, where counts go to {FULL_SCALE}: "
                "bytes were lost or changed",
            )
        return Response(counts, self._first_ns)

    def clear(self) -> None:
        """Discard the bytes."""
        self._kept.clear()
        self._bytes = 0
