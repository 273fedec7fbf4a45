"""Benchmark of poses over OpenIGTLink at a client: latency and jitter."""

import socket
import struct
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

PERCENTILES: Final = (50.0, 90.0, 99.0, 99.9)

_HEADER: Final = struct.Struct(">H12s20sIIQQ")
_EXTENDED: Final = struct.Struct(">HHII")
_MATRIX: Final = struct.Struct(">12f")
_PIECE: Final = 1 << 16
_NS: Final = 1_000_000_000


@dataclass(frozen=True)
class Received:
    """One transform.

    Args:
        device: its name, such as ``probeToTracker``.
        exposure_ns: the time stamp of its header [ns].
        received_ns: when its last byte was there [ns].
        sequence: number of the frame; -1 without metadata.
        matrix: its upper three rows, shape (3, 4), translation in mm.
    """

    device: str
    exposure_ns: int
    received_ns: int
    sequence: int
    matrix: NDArray[np.float64]


@dataclass(frozen=True)
class Figures:
    """Latency from mid exposure to reception, and jitter of the transforms.

    Args:
        seconds: from the first to the last.
        transforms: how many came.
        out_of_order: with a time stamp before the one before.
        latency_ms: by percentile, and the largest ("max").
        jitter_ms: likewise, of how far the time between two transforms is from the time between
            their exposures.
    """

    seconds: float
    transforms: int
    out_of_order: int
    latency_ms: dict[str, float]
    jitter_ms: dict[str, float]


def transforms(
    host: str, port: int, seconds: float, progress: Callable[[float], None] | None = None
) -> Iterator[Received]:
    """Yield all transforms that a server sends, for some seconds from the first.

    It says that it speaks header version 2, so that transforms have their frame's number.

    Raises:
        RuntimeError: none came within ten seconds, or the server hung up.
    """
    with socket.create_connection((host, port), timeout=10.0) as connection:
        connection.sendall(_question())
        waiting = bytearray()
        begin = None
        while begin is None or time.monotonic() < begin + seconds:
            try:
                piece = connection.recv(_PIECE)
            except TimeoutError:
                raise RuntimeError("no transform came within ten seconds") from None
            if not piece:
                raise RuntimeError("the OpenIGTLink server hung up")
            now = time.time_ns()
            waiting += piece
            for one in _taken(waiting, now):
                if begin is None:
                    begin = time.monotonic()
                yield one
            if progress is not None and begin is not None:
                progress(time.monotonic() - begin)


def summed(received: list[Received]) -> Figures:
    """Return the statistics of one device's transforms.

    Raises:
        RuntimeError: there are fewer than two.
    """
    if len(received) < 2:
        raise RuntimeError(f"{len(received)} transforms came; too few to sum up")
    exposed = np.array([one.exposure_ns for one in received])
    came = np.array([one.received_ns for one in received])
    late = (came - exposed) * 1e-6
    uneven = np.abs(np.diff(came) - np.diff(exposed)) * 1e-6
    return Figures(
        float(exposed[-1] - exposed[0]) * 1e-9,
        len(received),
        int((np.diff(exposed) < 0).sum()),
        _percentiles(late),
        _percentiles(uneven),
    )


def _percentiles(values: NDArray[np.float64]) -> dict[str, float]:
    found = {f"p{p:g}": float(v) for p, v in zip(PERCENTILES, np.percentile(values, PERCENTILES),
                                                 strict=True)}  # fmt: skip
    return found | {"max": float(values.max())}


def _question() -> bytes:
    """Return GET_STATUS with a header of version 2; its body has no content, so no checksum."""
    body = _EXTENDED.pack(_EXTENDED.size, 2, 0, 1) + b"\0\0"
    return _HEADER.pack(2, b"GET_STATUS", b"", 0, 0, len(body), _crc(body)) + body


def _crc(data: bytes) -> int:
    """Return the CRC-64 of a few bytes (ECMA-182, as the protocol has it)."""
    crc = 0
    for byte in data:
        crc ^= byte << 56
        for _ in range(8):
            crc = (crc << 1) ^ (0x42F0E1EBA9EA3693 if crc >> 63 else 0)
            crc &= (1 << 64) - 1
    return crc


def _taken(waiting: bytearray, now: int) -> Iterator[Received]:
    """Yield the complete transforms and remove all complete messages from the buffer."""
    index = 0
    while len(waiting) >= index + _HEADER.size:
        version, kind, device, whole, part, size, _ = _HEADER.unpack_from(waiting, index)
        end = index + _HEADER.size + size
        if len(waiting) < end:
            break
        if kind.rstrip(b"\0") == b"TRANSFORM":
            body = bytes(waiting[index + _HEADER.size : end])
            content, sequence = _content(body, version)
            columns = np.array(_MATRIX.unpack(content)).reshape(4, 3)
            stamp = whole * _NS + ((part * _NS) >> 32)
            name = device.rstrip(b"\0").decode()
            yield Received(name, stamp, now, sequence, columns.T)
        index = end
    del waiting[:index]


def _content(body: bytes, version: int) -> tuple[bytes, int]:
    """Return a transform's 48 bytes and its frame's number."""
    if version < 2:
        return body, -1
    skipped, head, metadata, _ = _EXTENDED.unpack_from(body)
    values = body[len(body) - metadata :]
    sizes = body[len(body) - metadata - head : len(body) - metadata]
    place, sequence = 0, -1
    for index in range(struct.unpack_from(">H", sizes)[0]):
        key, _, value = struct.unpack_from(">HHI", sizes, 2 + 8 * index)
        if values[place : place + key] == b"FrameNumber":
            sequence = int(values[place + key : place + key + value])
        place += key + value
    return body[skipped : skipped + _MATRIX.size], sequence
