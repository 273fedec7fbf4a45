"""Poses on a board, and a server that gives them to NDI clients."""

import asyncio
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any, ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from compute.pose.rigid_body import PoseStatus, ToolPose
from service.pipeline.frame_batch import LatestPoses, PoseEntry
from service.protocols.ndi.pose_feed import PoseFeed
from service.protocols.ndi.server import NdiOptions, NdiServer

PATIENT_S = 600.0
"""Poses are not old before: the machine may be busy."""


def pose(
    tool: str,
    status: PoseStatus = PoseStatus.OK,
    seed: int = 0,
    sequence: int = 7,
    **changed: Any,
) -> ToolPose:
    """A pose anywhere in the volume."""
    rng = np.random.default_rng(seed)
    there = status in (PoseStatus.OK, PoseStatus.HIGH_ERROR, PoseStatus.OUT_OF_VOLUME)
    spread = np.diag([1e-6] * 3 + [0.01, 0.04, 0.09])
    members: dict[str, Any] = {
        "rotation": Rotation.random(random_state=seed).as_matrix(),
        "translation_mm": rng.uniform(-500.0, 500.0, 3),
        "covariance": spread,
        "tip_mm": np.zeros(3),
        "tip_covariance_mm2": np.eye(3),
        "residual_sigma": 0.9,
        "markers_used": 4,
        "readings_used": 12,
    }
    reason = None if status is PoseStatus.OK else "as the test has it"
    own = (members if there else {}) | changed
    return ToolPose(tool, status, reason, time.time_ns(), sequence, **own)


def entry(
    *poses: ToolPose, device: str = "bar", sequence: int = 7, rate_hz: float = 100.0
) -> PoseEntry:
    """All poses of a device."""
    by_name = {one.tool: one for one in poses}
    return PoseEntry(device, sequence, time.time_ns(), by_name, "cal", rate_hz)


@asynccontextmanager
async def answering(board: LatestPoses, **options: Any) -> AsyncIterator[NdiServer]:
    """A running server on a free port."""
    feed = PoseFeed(board, age_s=PATIENT_S)
    server = NdiServer(NdiOptions(0, **options), feed)
    await server.start()
    try:
        yield server
    finally:
        await Talker.close_all()
        await server.close()


class Talker:
    """A client that sends whatever it likes; ``all`` are closed by the test."""

    all: ClassVar[list["Talker"]] = []

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer
        self.all.append(self)

    @classmethod
    async def to(cls, server: NdiServer) -> "Talker":
        return cls(*await asyncio.open_connection(*server.address))

    async def ask(self, command: str) -> str:
        """Return the text of a reply, without its checksum."""
        self.writer.write(command.encode() + b"\r")
        return (await self.reader.readuntil(b"\r"))[:-5].decode()

    async def begin(self) -> None:
        """Start tracking all tools."""
        assert await self.ask("INIT") == "OKAY"
        listed = await self.ask("PHSR 02")
        for place in range(2, len(listed), 5):
            handle = listed[place : place + 2]
            assert await self.ask(f"PINIT {handle}") == "OKAY"
            assert await self.ask(f"PENA {handle}D") == "OKAY"
        assert await self.ask("TSTART") == "OKAY"

    @classmethod
    async def close_all(cls) -> None:
        """Close every connection that was made."""
        for one in cls.all:
            one.writer.transport.abort()
        cls.all.clear()
        await asyncio.sleep(0)
