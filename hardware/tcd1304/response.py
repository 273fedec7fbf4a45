"""Collects a board's answer, which has no framing: silence before it and after it marks it."""

from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hardware.tcd1304.protocol import ELEMENTS, FULL_SCALE, RESPONSE_BYTES


@dataclass(frozen=True, eq=False)
class Response:
    """One answer.

    Args:
        counts: what the converter read, uint16, shape (3694,); dark is high.
        first_byte_ns: when its first bytes were here.
    """

    counts: NDArray[np.uint16]
    first_byte_ns: int


class Fault(Enum):
    """Why bytes between two silences are no answer."""

    SHORT = "short"
    LONG = "long"
    RANGE = "range"


@dataclass(frozen=True)
class InvalidResponse:
    """Bytes that are no answer, and why."""

    fault: Fault
    bytes: int
    detail: str


_FORMAT: Final = np.dtype("<u2")


class ResponseCollector:
    """Bytes in, answers out; never raises on input, and keeps at most one answer's bytes.

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
        """Take bytes, and when they were here."""
        if not data:
            return
        if not self._bytes:
            self._first_ns = now_ns
        self._bytes += len(data)
        self._kept += data[: RESPONSE_BYTES - len(self._kept)]

    def silence(self) -> Response | InvalidResponse | None:
        """Return what the bytes before this silence were; None: there were none."""
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
        """Forget the bytes."""
        self._kept.clear()
        self._bytes = 0
