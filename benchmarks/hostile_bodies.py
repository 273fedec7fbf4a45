"""Benchmark of a server under hostile bodies: stalls of /healthz, a stream and hold statuses.

Run beside a service with an OpenIGTLink port: ``python -m benchmarks.hostile_bodies URL PORT``;
``lumiline bench hostile-bodies`` starts one. Each body is sent alone, then by several at once.
"""

import argparse
import asyncio
import contextlib
import json
import os
import pathlib
import socket
import struct
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Final
from urllib.parse import urlsplit

from benchmarks.stream_clients import percentiles

MIB: Final = 1024 * 1024
INLINE_BYTES: Final = 16 * 1024
"""Bodies up to this size are read in the event loop itself."""
PROBE_S: Final = 0.02
QUIET_S: Final = 3.0
ANSWER_S: Final = 90.0
TEXT_BYTES: Final = 500
HEADER: Final = struct.Struct("> H 12s 20s Q Q Q")
"""Of an OpenIGTLink message: version, type, name, time, length of the body, checksum."""


def filled(head: str, item: str, tail: str, size: int) -> bytes:
    """Return ``head``, as many ``item`` with commas as fit into ``size`` bytes, and ``tail``."""
    count = (size - len(head) - len(tail)) // (len(item) + 1)
    return (head + ",".join([item] * count) + tail).encode()


_SCANS: Final = '{"method": {"method": "fit"}, "scans": '
_POINTS: Final = '{"device_id": "sim", "points": ['
_SURFACE: Final = (
    '{"kind": "surface", "id": "hostile", "device_id": "sim", "parent_id": "none", "points_mm": '
    '[[0,0,0]], "surface": {"kind": "mesh", "triangles": [[0,1,2]], "vertices_mm": ['
)
_POINT: Final = '{"name":"P","position_mm":[1,2,3],"readings":{"left":"x","right":"x"}}'

_OBSERVED: Final = (
    '{"name":"P%d","readings":{"vertical":900,"horizontal":1000,"diagonal-rising":950,'
    '"diagonal-falling":1050}}'
)
_MAX_POINTS: Final = 10_000

_SCENE: Final = (
    '{"id": "hostile", "title": "Hostile", "source": {"kind": "simulated", "settings": {"scene": '
    '{"kind": "still-points", "points_mm": ['
)
_HOLD: Final = (
    '{"id": "hostile", "device_id": "sim", "title": "Hostile", "limits": {"shift_mm": 1}, "watch": '
    '{"kind": "simultaneous-markers", "markers": 1}, "reference": {"kind": "simultaneous-markers", '
    '"positions_mm": ['
)
_PROFILE: Final = '{"toml": "%s"}'


def _toml(text: str) -> bytes:
    return (_PROFILE % text.replace("\n", "\\n")).encode()


def small_bodies() -> dict[str, tuple[str, str, bytes]]:
    """Return those that are read in the event loop itself, or have small documents in them."""
    admin = "admin:devices"
    inline, medium = INLINE_BYTES - 64, 64 * 1024
    members = ",".join(f'"m{number}":{{"a":1}}' for number in range(990))
    keys = "\n".join(f"k{number}=1" for number in range(7_000))
    dotted = "a" + ".a" * 30_000 + "=1"
    sizes = {"small": inline, "larger": medium}
    return {
        **{
            f"{name}, {title}": (scope, path, filled(head, "[]", tail, size))
            for title, size in sizes.items()
            for name, scope, path, head, tail in (
                ("points of a scene", admin, "devices", _SCENE, "]}}}}"),
                ("positions of a hold", "write:holds", "beam-holds", _HOLD, "]}}"),
                (
                    "markers of a hold", "write:holds", "beam-holds",
                    '{"watch": {"kind": "strobed-markers", "markers": [', "]}}",
                ),
                (
                    "positions of a reference", "operate:holds", "beam-holds/none/reference",
                    '{"given": {"positions_mm": [', "]}}",
                ),
                (
                    "light of levels", "write:calibrations", "radiometric-calibrations",
                    '{"source": {"kind": "scans", "relative_light": [', "]}}",
                ),
                ("markers", "write:tools", "tools", '{"markers_mm": [', "]}"),
                ("types of events", "admin:webhooks", "webhooks", '{"event_types": [', "]}"),
                ("tools of an export", "write:results", "runs/export", '{"tool_ids": [', "]}"),
                (
                    "points of a check", "operate:checks",
                    "calibrations/sim-nominal/drift-checks", '{"points": [', "]}",
                ),
                (
                    "markers of a check", "operate:checks", "devices/sim/quality-checks",
                    '{"kind": "point-to-point", "markers": [', "]}",
                ),
            )
        },
        "unknown members": (admin, "devices", f"{{{members}}}".encode()),
        "profile of unknown keys": (admin, "profile-plans", _toml(keys)),
        "profile of a dotted key": (admin, "profile-plans", _toml(dotted)),
        "profile of nested lists": (admin, "device-profiles", _toml("a=" + "[" * 5_000)),
        "profile of digits": (admin, "device-profiles", _toml("a=" + "9" * 5_000)),
    }  # fmt: skip


def bodies() -> dict[str, tuple[str, str, bytes]]:
    """Return scope, path and body by name: of each scope, what costs a server most."""
    read, write, admin, keys = (
        "read:stream", "write:calibrations", "admin:devices", "admin:keys"
    )  # fmt: skip
    register, record = "write:registrations", "operate:recordings"
    large, medium, small = 8 * MIB - 64, 2 * MIB - 64, 128 * 1024 - 64
    lines = [[100, 101, 99, 100] * 512] * 256
    scans, detailed = (
        json.dumps({"method": {"method": method}, "scans": lines[:count], "detail": count < 256})
        for method, count in (("fit", 256), ("matched", 32))
    )
    points = _POINTS + ",".join(_OBSERVED % number for number in range(_MAX_POINTS)) + "]}"
    return {
        "scan of zeros": (read, "line-scans", filled(_SCANS + "[[", "0", "]]}", large)),
        "scans that are empty": (read, "line-scans", filled(_SCANS + "[", "[]", "]}", large)),
        "scan of fractions": (read, "line-scans", filled(_SCANS + "[[", "1.0", "]]}", large)),
        "scans as many as may be": (read, "line-scans", scans.encode()),
        "scans in detail": (read, "line-scans", detailed.encode()),
        "points as many as may be": (read, "reconstructions", points.encode()),
        "member of empty lists": (read, "line-scans", filled('{"x": [', "[]", "]}", large)),
        "member of objects": (read, "line-scans", filled('{"x": [', '{"a":1}', "]}", large)),
        "nested lists": (read, "line-scans", b"[" * large),
        "text of escapes": (read, "line-scans", filled('{"x": "', "\\u0041", '"}', large)),
        "not JSON at its end": (read, "line-scans", filled("[", "0.1", "}", large)),
        "wrong readings": (read, "reconstructions", filled(_POINTS, _POINT, "]}", medium)),
        "empty points": (read, "reconstructions", filled(_POINTS, "{}", "]}", medium)),
        "picture of zeros": (read, "line-scans.png", filled(_SCANS + "[[", "0", "]]}", large)),
        "control points": (write, "calibrations", filled(_POINTS, _POINT, "]}", medium)),
        "members of points": (write, "calibrations", filled(_POINTS, '{"a":0}', "]}", medium)),
        "targets": (
            write, "captures", filled('{"device_id": "sim", "targets": [', "{}", "]}", medium),
        ),
        "points of a run": (write, "runs/mapping", filled(_POINTS, "{}", "]}", medium)),
        "vertices": (register, "registrations", filled(_SURFACE, "[0,0,0]", "]}}", large)),
        "empty vertices": (register, "registrations", filled(_SURFACE, "[]", "]}}", large)),
        "frames": (
            write, "radiometric-calibrations", filled('{"scans": {"x": [[', "0", "]]}}", large),
        ),
        "tool of markers": ("write:tools", "tools", filled('{"markers_mm": [', "[]", "]}", small)),
        "table that is none": (write, "correction-tables", b"\x89HDF\r\n\x1a\n" + bytes(60 * MIB)),
        "device of sensors": (admin, "devices", filled('{"source": [', "{}", "]}", small)),
        "recording of contents": (
            record, "devices/sim/recordings", filled('{"contents": [', "0", "]}", small),
        ),
        "key of scopes": (keys, "keys", filled('{"scopes": [', "{}", "]}", small)),
        **small_bodies(),
    }  # fmt: skip


@dataclass
class Heard:
    """Times of what good clients received while bodies were sent.

    Args:
        healthz_ns: from each question to its answer.
        frames_ns: moments of the websocket's messages.
        statuses_ns: moments of the hold statuses of an OpenIGTLink client.
    """

    healthz_ns: list[int] = field(default_factory=list)
    frames_ns: list[int] = field(default_factory=list)
    statuses_ns: list[int] = field(default_factory=list)

    def clear(self) -> None:
        """Begin again; the last of each stays, so that a gap over this moment counts."""
        self.healthz_ns.clear()
        del self.frames_ns[:-1], self.statuses_ns[:-1]

    def figures(self) -> dict[str, Any]:
        """Return the longest stalls so far [ms]."""
        now = time.monotonic_ns()
        return {
            "healthz_ms": percentiles(self.healthz_ns),
            "frame_gap_ms": _gap_ms(self.frames_ns, now),
            "status_gap_ms": _gap_ms(self.statuses_ns, now),
        }


def _gap_ms(moments: list[int], now: int) -> float | None:
    if not moments:
        return None
    ends = [*moments[1:], now]
    return max(b - a for a, b in zip(moments, ends, strict=True)) / 1e6


async def _probe(server: str, heard: Heard) -> None:
    host = urlsplit(server)
    reader, writer = await asyncio.open_connection(host.hostname, host.port)
    try:
        while True:
            begin = time.monotonic_ns()
            writer.write(f"GET /healthz HTTP/1.1\r\nHost: {host.netloc}\r\n\r\n".encode())
            await reader.readuntil(b"}")
            heard.healthz_ns.append(time.monotonic_ns() - begin)
            await asyncio.sleep(PROBE_S)
    finally:
        writer.close()


async def _stream(server: str, heard: Heard) -> None:
    from websockets.asyncio.client import connect

    url = f"{server.replace('http', 'ws', 1)}/api/v1/stream?device_id=sim"
    # Without pings, at whose time limit the client itself would end a stalled connection.
    async with connect(url, compression=None, max_size=None, ping_interval=None) as stream:
        while True:
            await stream.recv()
            heard.frames_ns.append(time.monotonic_ns())


async def _statuses(server: str, port: int, heard: Heard) -> None:
    reader, writer = await asyncio.open_connection(urlsplit(server).hostname, port)
    try:
        while True:
            _, kind, _, _, size, _ = HEADER.unpack(await reader.readexactly(HEADER.size))
            await reader.readexactly(size)
            if kind.rstrip(b"\0") == b"STATUS":
                heard.statuses_ns.append(time.monotonic_ns())
    finally:
        writer.close()


def _post(server: str, path: str, body: bytes, key: str | None) -> dict[str, Any]:
    """Send a body, and return status, length and duration of the answer."""
    host = urlsplit(server)
    begin = time.monotonic()
    kind = "application/x-hdf5" if path == "correction-tables" else "application/json"
    head = (
        f"POST /api/v1/{path} HTTP/1.1\r\nHost: {host.netloc}\r\nContent-Type: {kind}\r\n"
        f"Content-Length: {len(body)}\r\nConnection: close\r\n"
    )
    if key is not None:
        head += f"Authorization: Bearer {key}\r\n"
    parts: list[bytes] = []
    with socket.create_connection((host.hostname, host.port), ANSWER_S) as connection:
        with contextlib.suppress(OSError):  # the answer may come, and the end, before all is sent
            connection.sendall(head.encode() + b"\r\n")
            connection.sendall(body)
        with contextlib.suppress(OSError):
            while part := connection.recv(MIB):
                parts.append(part)
    answer = b"".join(parts)
    status = int(answer[9:12]) if answer.startswith(b"HTTP/1.1 ") else None
    return {
        "status": status,
        "answer_bytes": len(answer),
        "seconds": time.monotonic() - begin,
        "answer": answer[answer.find(b"\r\n\r\n") + 4 :][:TEXT_BYTES].decode("latin-1"),
    }


def memory_bytes(pid: int) -> int:
    """Return the resident memory of a process and of its children; Linux only."""
    sizes, parents = {}, {}
    for folder in pathlib.Path("/proc").glob("[0-9]*"):
        try:
            stat = (folder / "stat").read_text(encoding="ascii")
            pages = int((folder / "statm").read_text(encoding="ascii").split()[1])
        except (OSError, ValueError, IndexError):
            continue  # it has ended
        parents[int(folder.name)] = int(stat.rsplit(")", 1)[1].split()[1])
        sizes[int(folder.name)] = pages * os.sysconf("SC_PAGESIZE")
    return sum(size for one, size in sizes.items() if pid in _ancestors(one, parents))


def _ancestors(pid: int, parents: dict[int, int]) -> Iterator[int]:
    while pid in parents:
        yield pid
        pid = parents[pid]


async def measure(
    server: str,
    port: int,
    at_once: int,
    *,
    pid: int | None = None,
    key: str | None = None,
    only: str = "",
) -> list[dict[str, Any]]:
    """Return a row for each body, after one of a quiet server, and one of it afterwards.

    Args:
        server: its URL.
        port: of its OpenIGTLink server.
        at_once: clients that send each body at the same time.
        pid: of the server's process; None: its memory is not measured.
        key: sent with the bodies.
        only: part of the names of the bodies to send.
    """
    sent = {name: body for name, body in bodies().items() if only in name}
    heard = Heard()
    rows: list[dict[str, Any]] = []

    def row(name: str, **members: Any) -> None:
        memory = None if pid is None else memory_bytes(pid)
        rows.append({"body": name, **members, **heard.figures(), "memory_bytes": memory})

    async with asyncio.TaskGroup() as tasks:
        good = [
            tasks.create_task(one)
            for one in (
                _probe(server, heard), _stream(server, heard), _statuses(server, port, heard)
            )
        ]  # fmt: skip
        await asyncio.sleep(QUIET_S)
        heard.clear()
        await asyncio.sleep(QUIET_S)
        row("none")
        for name, (scope, path, body) in sent.items():
            heard.clear()
            # In threads, which wait for the socket: what is measured here goes on meanwhile.
            posts = (asyncio.to_thread(_post, server, path, body, key) for _ in range(at_once))
            answers = await asyncio.gather(*posts)
            await asyncio.sleep(5 * PROBE_S)
            slowest = max(answers, key=lambda one: one["seconds"])
            row(
                name,
                scope=scope,
                path=path,
                statuses=sorted({one["status"] or 0 for one in answers}),
                answer_bytes=max(one["answer_bytes"] for one in answers),
                seconds=slowest["seconds"],
                answer=slowest["answer"],
            )
        await asyncio.sleep(QUIET_S)
        heard.clear()
        await asyncio.sleep(QUIET_S)
        row("none, afterwards")
        for task in good:
            task.cancel()
    return rows


def main(arguments: list[str] | None = None) -> int:
    """Print the figures of each body as a line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("server")
    parser.add_argument("port", type=int)
    parser.add_argument("--at-once", type=int, default=1)
    parser.add_argument("--pid", type=int)
    parser.add_argument("--only", default="")
    parser.add_argument("--key")
    chosen = parser.parse_args(arguments)
    found = asyncio.run(
        measure(
            chosen.server, chosen.port, chosen.at_once,
            pid=chosen.pid, key=chosen.key, only=chosen.only,
        )
    )  # fmt: skip
    for row in found:
        print(json.dumps(row), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
