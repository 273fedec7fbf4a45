"""A server fed by hand, an application of its own, and a client that reads every message."""

import asyncio
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import uvloop

from compute.errors import LumilineError
from compute.pose.rigid_body import PoseStatus, ToolPose
from compute.transform import rotation_matrix
from service.pipeline.beam_hold_registry import BeamHoldRegistry
from service.pipeline.frame_batch import LatestPoses, PoseEntry
from service.protocols.openigtlink.host import Landmark, Outcome, ServerSettings, WireTool
from service.protocols.openigtlink.message import Damaged, Decoder, Message, Skipped, write_message
from service.protocols.openigtlink.server import OpenIGTLinkServer

LOOPS = {"asyncio": asyncio.new_event_loop, "uvloop": uvloop.new_event_loop}
START_NS = time.time_ns()
"""Exposure of frame 0; those of others follow by 1 ns."""
PATIENCE_S = 60.0
"""How long a test waits for what is to come: nothing is said of how fast it comes."""


class Everything:
    """All types."""

    def __contains__(self, _: object) -> bool:
        return True


@dataclass
class FakeHost:
    """An application with some tools."""

    known: Sequence[WireTool] = (WireTool("probe", "sim"), WireTool("ref", "sim"))
    marked: Sequence[Landmark] = ()
    recording: str | None = None
    audited: list[tuple[str, str]] = field(default_factory=list)

    async def tools(self) -> Sequence[WireTool]:
        return self.known

    async def landmarks(self, device_id: str) -> Sequence[Landmark]:
        return self.marked

    async def devices(self) -> Sequence[str]:
        return ["sim"]

    async def start_recording(self, device_id: str, name: str | None) -> str:
        if self.recording is not None:
            raise LumilineError(f'device "{device_id}" is being recorded')
        self.recording = name or f"{device_id}.h5"
        return self.recording

    async def stop_recording(self, device_id: str) -> str:
        if self.recording is None:
            raise LumilineError(f'device "{device_id}" is not being recorded')
        name, self.recording = self.recording, None
        return name

    async def audit(
        self, operation: str, address: str, outcome: Outcome, detail: str | None
    ) -> None:
        self.audited.append((operation, outcome))


def pose(tool: str, number: int = 0, status: PoseStatus = PoseStatus.OK, **more: Any) -> ToolPose:
    """A pose of which number and tool can be told."""
    there = status in (PoseStatus.OK, PoseStatus.HIGH_ERROR, PoseStatus.OUT_OF_VOLUME)
    turned = rotation_matrix(np.array([0.1, 0.2, 0.3 + 1e-4 * number]))
    members: dict[str, Any] = {
        "rotation": turned if there else None,
        "translation_mm": np.array([float(number), len(tool), -7.5]) if there else None,
        "residual_sigma": 1.25 if there else None,
        "markers_used": 4,
    }
    exposure_ns = more.pop("exposure_ns", START_NS + number)
    reason = None if status is PoseStatus.OK else f"{tool} is {status.value}"
    return ToolPose(tool, status, reason, exposure_ns, number, **(members | more))


def entry(
    number: int = 0,
    poses: Sequence[ToolPose] | None = None,
    device: str = "sim",
    in_force: tuple[str, str | None] = ("first", None),
) -> PoseEntry:
    given = [pose("probe", number), pose("ref", number)] if poses is None else poses
    by_name = {one.tool: one for one in given}
    calibration, table = in_force
    return PoseEntry(device, number, START_NS + number, by_name, calibration, 200.0, table_id=table)


class Peer:
    """A client that reads and sends messages, and bytes."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer
        self._decoder = Decoder(Everything())

    async def send(self, *messages: Message) -> None:
        await self.raw(b"".join(map(write_message, messages)))

    async def raw(self, data: bytes) -> None:
        self.writer.write(data)
        await self.writer.drain()

    async def message(self) -> Message:
        """The next message; EOFError when the connection has ended."""
        while True:
            event = self._decoder.take()
            if event is not None:
                assert not isinstance(event, Skipped | Damaged)
                return event
            data = await asyncio.wait_for(self.reader.read(65536), PATIENCE_S)
            if not data:
                raise EOFError
            self._decoder.feed(data)

    async def of(self, kind: str, device: str | None = None) -> Message:
        """The next message of a type; others are passed over."""
        while True:
            found = await self.message()
            if found.type == kind and device in (None, found.device):
                return found

    async def ask(self, message: Message, kind: str) -> Message:
        await self.send(message)
        return await self.of(kind)

    async def close(self) -> None:
        self.writer.close()
        with suppress(OSError):
            await self.writer.wait_closed()


@dataclass
class Served:
    server: OpenIGTLinkServer
    board: LatestPoses
    host: FakeHost
    peers: list[Peer] = field(default_factory=list)

    async def connect(self, limit: int = 2**16) -> Peer:
        reader, writer = await asyncio.open_connection(*self.server.address, limit=limit)
        peer = Peer(reader, writer)
        self.peers.append(peer)
        return peer

    async def joined(self) -> Peer:
        """A client that the server knows of."""
        before = self.server.clients
        peer = await self.connect()
        await until(lambda: self.server.clients > before)
        return peer

    def put(self, number: int, poses: Sequence[ToolPose] | None = None) -> None:
        self.board.put(entry(number, poses))


async def until(holds: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < end, "it did not come to hold"
        await asyncio.sleep(0.005)


@asynccontextmanager
async def serving(
    host: FakeHost | None = None, holds: BeamHoldRegistry | None = None, **settings: Any
) -> AsyncIterator[Served]:
    host = FakeHost() if host is None else host
    board = LatestPoses()
    made = ServerSettings(port=0, rate_hz=1e9, **settings)
    server = OpenIGTLinkServer(board, host, made, holds)
    await server.start()
    served = Served(server, board, host)
    try:
        yield served
    finally:
        await server.close()
        for peer in served.peers:
            await peer.close()


def run(test: Callable[[], Awaitable[None]], loop: str = "asyncio") -> None:
    async def main() -> None:
        await test()

    with asyncio.Runner(loop_factory=LOOPS[loop]) as runner:
        runner.run(main())
