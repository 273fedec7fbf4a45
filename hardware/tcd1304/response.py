"""Responses of a board, unframed and delimited by silence, and their dark correction."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hardware.tcd1304.protocol import (
    ELEMENTS,
    FIRST_PIXEL,
    FULL_SCALE,
    PIXELS,
    RESPONSE_BYTES,
    SHIELDED,
)


@dataclass(frozen=True, eq=False)
class Response:
    """One response.

    Args:
        counts: raw counts, uint16, shape (3694,); dark is high.
        first_byte_ns: arrival of its first bytes.
    """

    counts: NDArray[np.uint16]
    first_byte_ns: int


@dataclass(frozen=True)
class InvalidResponse:
    """Bytes that are not a response, and the reason."""

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
        self._buffer = bytearray()
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
        self._buffer += data[: RESPONSE_BYTES - len(self._buffer)]

    def silence(self) -> Response | InvalidResponse | None:
        """Evaluate the bytes before a silence; None: there were none."""
        count, received = self._bytes, bytes(self._buffer)
        self.clear()
        if not count:
            return None
        if count != RESPONSE_BYTES:
            detail = f"{count} bytes came where an answer has {RESPONSE_BYTES}"
            return InvalidResponse(count, detail)
        counts = np.frombuffer(received, _FORMAT).astype(np.uint16)
        largest = int(counts.max())
        if largest > FULL_SCALE:
            where = int(counts.argmax())
            return InvalidResponse(
                count,
                f"element {where} of {ELEMENTS} is {largest}, where counts go to {FULL_SCALE}: "
                "bytes were lost or changed",
            )
        return Response(counts, self._first_ns)

    def clear(self) -> None:
        """Discard the bytes."""
        self._buffer.clear()
        self._bytes = 0


OFFSET_COUNTS: Final = 64
"""Output count without light: keeps noise below the dark level."""


def dark_level(counts: NDArray[np.uint16]) -> float:
    """Return the dark level: the mean count of the shielded pixels.

    Args:
        counts: what the converter read, shape (3694,).
    """
    return float(counts[SHIELDED].mean())


def dark_corrected_counts(counts: NDArray[np.uint16], saturated_at: int) -> NDArray[np.uint16]:
    """Return the counts of the pixels above the scan's dark level.

    The CCD saturates before the converter ends, at a voltage of its own. Such pixels are set to
    full scale, by which peak detection knows that they are saturated.

    Args:
        counts: what the converter read, shape (3694,).
        saturated_at: the count at which, and below, a pixel is full.

    Returns:
        Counts, uint16, shape (3648,): OFFSET_COUNTS without light, 4095 where full.
    """
    pixels = counts[FIRST_PIXEL : FIRST_PIXEL + PIXELS]
    dark = round(dark_level(counts)) + OFFSET_COUNTS
    light = np.clip(dark - pixels.astype(np.int32), 0, FULL_SCALE)
    light[pixels <= saturated_at] = FULL_SCALE
    return light.astype(np.uint16)
