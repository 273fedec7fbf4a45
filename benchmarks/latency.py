"""Benchmark of the latency floor: exposures of a serial device to a client, beside a bare relay.

Run in a process of its own: ``python -m benchmarks.latency KIND URL --seconds 6``.
"""

import argparse
import json
import socket
import struct
import sys
import time
from pathlib import Path
from typing import Any, Final, Literal

from benchmarks.baseline_relay import MIN_EXPOSURE_BYTES

Kind = Literal["service", "relay"]
_TICK_NS: Final = 1000
_SEQUENCE_AND_TICKS: Final = struct.Struct("<IQ")
_FIRST: Final = 4  # bytes of a decoded exposure before its number


def receive(kind: Kind, url: str, seconds: float) -> dict[str, list[int]]:
    """Return when exposures were made and received, after a first second that does not count.

    Of a service they were made when it says, on this machine's clock.

    Args:
        kind: what answers at the URL.
        url: of a websocket.
        seconds: how long is counted.

    Returns:
        ``exposure_ns``, of a service monotonic time, of a relay the device's clock; and
        ``received_ns``, monotonic time.
    """
    import msgpack
    from websockets.sync.client import connect

    exposure_ns: list[int] = []
    received_ns: list[int] = []
    wall_ns = time.time_ns() - time.monotonic_ns()
    with connect(url, compression=None, max_size=None, max_queue=None) as stream:
        begin = time.monotonic_ns() + 1_000_000_000
        end = begin + round(seconds * 1e9)
        while (now := time.monotonic_ns()) < end:
            payload = stream.recv(timeout=30.0)
            now = time.monotonic_ns()
            if now < begin:
                continue
            assert isinstance(payload, bytes)
            if kind == "relay":
                exposure_ns.append(relayed_time_ns(payload))
                received_ns.append(now)
                continue
            message: dict[str, Any] = msgpack.unpackb(payload)
            for frame in message.get("frames") or [message]:
                if frame["type"] == "frame":
                    exposure_ns.append(frame["exposure_ns"] - wall_ns)
                    received_ns.append(now)
    return {"exposure_ns": exposure_ns, "received_ns": received_ns}


def relayed_time_ns(prefix: bytes) -> int:
    """Return an exposure's time on the device's clock, from its first bytes as sent (COBS)."""
    decoded = bytearray()
    at = 0
    while len(decoded) < _FIRST + _SEQUENCE_AND_TICKS.size:
        code = prefix[at]
        decoded += prefix[at + 1 : at + code]
        at += code
        if code < 255:
            decoded.append(0)
    _, ticks = _SEQUENCE_AND_TICKS.unpack_from(decoded, _FIRST)
    return int(ticks) * _TICK_NS


def shortest_delay_ns(device: tuple[str, int], start: bytes, seconds: float) -> int:
    """Return the shortest time from the middle of an exposure to its last byte here [ns].

    On the device's clock against monotonic time: their difference is in it.

    Args:
        device: host and port of the serial device.
        start: what makes it send exposures.
        seconds: how long it is listened to.
    """
    shortest: int | None = None
    rest = b""
    with socket.create_connection(device) as connection:
        connection.sendall(start)
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            data = connection.recv(1 << 16)
            now = time.monotonic_ns()
            *whole, rest = (rest + data).split(b"\0")
            for exposure in whole[-1:]:
                if len(exposure) > MIN_EXPOSURE_BYTES:
                    delay = now - relayed_time_ns(exposure)
                    shortest = delay if shortest is None else min(shortest, delay)
    if shortest is None:
        raise RuntimeError(f"the device sent no exposure in {seconds:g} s")
    return shortest


def steal_s() -> float:
    """Return the time that other machines have taken from this one [s]; 0 where not known."""
    try:
        words = Path("/proc/stat").read_text(encoding="ascii").split("\n", 1)[0].split()
    except OSError:
        return 0.0
    return float(words[8]) / 100.0


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("kind", choices=["service", "relay"])
    parser.add_argument("url")
    parser.add_argument("--seconds", type=float, default=6.0)
    given = parser.parse_args()
    json.dump(receive(given.kind, given.url, given.seconds), sys.stdout)
