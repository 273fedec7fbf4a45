"""The OpenIGTLink server: listens, gives every client the newest poses, and ends in good order."""

import asyncio
import contextlib
import logging
import socket
import time
from collections.abc import Coroutine, Mapping, Sequence
from typing import TYPE_CHECKING, Final

from compute.errors import LumilineError
from service.allow_list import AllowList
from service.pipeline.beam_hold_registry import BeamHoldRegistry
from service.pipeline.frame_batch import LatestPoses, PoseEntry
from service.protocols.openigtlink.beam_hold_status import BeamHoldStatusSender
from service.protocols.openigtlink.bodies import StatusCode
from service.protocols.openigtlink.connection import ClientConnection
from service.protocols.openigtlink.counters import Counters
from service.protocols.openigtlink.handlers import MessageHandlers
from service.protocols.openigtlink.host import Host, ServerSettings, WireTool
from service.protocols.openigtlink.snapshot import Snapshot
from service.protocols.openigtlink.transforms import ToolNames, name_tools

if TYPE_CHECKING:
    from service.api.tools.tip_limit import TipLimit

_log = logging.getLogger(__name__)

_LOOK_S: Final = 0.25
_TOOLS_S: Final = 2.0
"""How often the application is asked for its tools, besides when an unknown one appears."""
_CLOSING_S: Final = 2.0
_REFUSALS_S: Final = 10.0
_BACKLOG: Final = 64


class OpenIGTLinkServer:
    """Serves clients from a pose board; made and used in one event loop."""

    def __init__(
        self,
        board: LatestPoses,
        host: Host,
        settings: ServerSettings,
        holds: BeamHoldRegistry | None = None,
    ) -> None:
        self.counters = Counters()
        if holds is None:
            holds = BeamHoldRegistry(lambda *_: None)
        self.holds = BeamHoldStatusSender(holds, settings.device, lambda: self._clients)
        self._board = board
        self._host = host
        self.settings = settings
        self.handlers = MessageHandlers(
            host,
            self._fresh,
            lambda: self._tools,
            self.counters,
            self.holds.answer,
            invalid=settings.send_invalid,
            changes=settings.changes,
        )
        self._allowed = AllowList(settings.allow)
        self._clients: set[ClientConnection] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self._newest: Snapshot | None = None
        self._tools: Sequence[WireTool] = ()
        self._naming: dict[str, ToolNames] = {}
        self._limits: Mapping[str, TipLimit] = {}
        self._requested_tools: frozenset[str] = frozenset()
        self._wake = asyncio.Event()
        self._failing = False
        self._refusal_logged_s = 0.0
        self._others: set[str] = set()

    @property
    def clients(self) -> int:
        """Number of connected clients."""
        return len(self._clients)

    @property
    def address(self) -> tuple[str, int]:
        """Host and port that it listens on."""
        address: tuple[str, int] = self._server.sockets[0].getsockname()[:2]
        return address

    async def start(self) -> None:
        """Listen.

        Raises:
            OSError: the port is taken, or the address is none of this machine.
        """
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(
            lambda: ClientConnection(self),
            self.settings.host,
            self.settings.port,
            family=socket.AF_UNSPEC,
            backlog=_BACKLOG,
        )
        await self.refresh()
        self._end = self._board.listen(self._on_poses)
        self.holds.start()
        self._watcher = loop.create_task(self._watch())
        host, port = self.address
        others = ", ".join(self.settings.allow)
        _log.info(
            "OpenIGTLink on %s:%d, for %s",
            host,
            port,
            f"this machine and {others}" if others else "this machine only",
        )

    async def close(self) -> None:
        """Tell all clients, and close; those that do not read are cut off."""
        self._end()
        self.holds.close()
        self._watcher.cancel()
        self._server.close()
        for client in list(self._clients):
            client.end("the server is stopping", StatusCode.SHUT_DOWN, "shutdown")
        end = time.monotonic() + _CLOSING_S
        while (self._clients or self._tasks) and time.monotonic() < end:
            await asyncio.sleep(0.01)

    def spawn(self, work: Coroutine[None, None, None]) -> None:
        """Begin a task and keep it: what was commanded is done also if the client has gone."""
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def _fresh(self) -> Snapshot | None:
        """Return the newest poses, unless they are too old to be sent."""
        newest = self._newest
        return newest if newest is not None and newest.fresh else None

    def admit(self, client: ClientConnection) -> tuple[str, StatusCode | None] | None:
        """Admit a client, or return why not; addresses that are not allowed get no reply."""
        address = client.session.address
        if not self._allowed.permits(address):
            self.counters.refused["address"] += 1
            self._tell_refused(f"{address} is in no network that may connect")
            return "address", None
        if len(self._clients) >= self.settings.clients:
            self.counters.refused["full"] += 1
            reason = f"{self.settings.clients} clients are connected, and no more are let in"
            self._tell_refused(f"{address}: {reason}")
            return reason, StatusCode.NOT_ENOUGH_RESOURCE
        self._clients.add(client)
        _log.info("OpenIGTLink client %s connected", address)
        newest = self._fresh()
        if newest is not None:
            client.offer(newest)
        self.greet(client)
        return None

    def greet(self, client: ClientConnection) -> None:
        """Send the states of all beam holds to a client."""
        self.holds.greet(client)

    def _tell_refused(self, text: str) -> None:
        """Write into the log that somebody was refused, now and then: the metrics count all."""
        now = time.monotonic()
        if now >= self._refusal_logged_s:
            self._refusal_logged_s = now + _REFUSALS_S
            _log.warning("OpenIGTLink: %s", text)

    def forget(self, client: ClientConnection) -> None:
        """Note that a connection has ended."""
        if client in self._clients:
            self._clients.discard(client)
            self.counters.ended[client.ending] += 1
            _log.info("OpenIGTLink client %s: %s", client.session.address, client.ending)

    def _on_poses(self, entry: PoseEntry) -> None:
        """Take a frame from the board, and give it to all clients."""
        device = self._device()
        if device is None:
            device = entry.device_id
        if entry.device_id != device:
            if entry.poses and entry.device_id not in self._others:
                self._others.add(entry.device_id)
                _log.warning(
                    "OpenIGTLink: tools of device %s are not sent, those of %s are: each has its "
                    "own coordinates; the setting openigtlink_device chooses",
                    entry.device_id,
                    device,
                )
            return
        unknown = frozenset(entry.poses) - {tool.id for tool in self._tools}
        if unknown - self._requested_tools:
            self._requested_tools |= unknown
            self._wake.set()
        snapshot = Snapshot(entry, self.named(device), time.monotonic(), self._limits)
        self._newest = snapshot
        for client in list(self._clients):
            client.offer(snapshot)

    def _device(self) -> str | None:
        """Return the device whose tools are sent: as set, or the first that had any."""
        if self.settings.device is not None:
            return self.settings.device
        if self._newest is None:
            return None
        device = self._newest.entry.device_id
        stopped = not self._newest.fresh and device not in self._board.newest()
        return None if stopped else device

    def named(self, device_id: str) -> ToolNames:
        """Return the names of a device's tools."""
        names = self._naming.get(device_id)
        if names is None:
            of_device = [tool for tool in self._tools if tool.device_id == device_id]
            names = self._naming[device_id] = name_tools(of_device)
            for tool, why in names.refused.items():
                _log.warning("OpenIGTLink: tool %s is not sent: %s", tool, why)
        return names

    async def _watch(self) -> None:
        """Refresh the tools, repeat the beam holds, and report when no frames come."""
        requested_s = time.monotonic()
        while True:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._wake.wait(), _LOOK_S)
            if self._wake.is_set() or time.monotonic() - requested_s > _TOOLS_S:
                self._wake.clear()
                await self.refresh()
                requested_s = time.monotonic()
            self.holds.repeat()
            if self._newest is not None and not self._newest.fresh:
                age_s = self._newest.age_s
                for client in list(self._clients):
                    client.send_stale(self._newest.entry.device_id, age_s)

    async def refresh(self) -> None:
        """Read the application's tools; where that fails, the known ones stay."""
        try:
            tools = tuple(await self._host.tools())
        except Exception as error:  # noqa: BLE001 - the poses of known tools go on
            if not self._failing:
                expected = isinstance(error, LumilineError)
                level = logging.WARNING if expected else logging.ERROR
                text = "OpenIGTLink: the tools are not known: %s"
                _log.log(level, text, error, exc_info=not expected)
            self._failing = True
            return
        self._failing = False
        self._requested_tools = frozenset()
        if _names(tools) != _names(self._tools):
            self._naming = {}
        self._tools = tools
        self._limits = {tool.id: tool.limit for tool in tools if tool.limit is not None}


def _names(tools: Sequence[WireTool]) -> set[tuple[str, str, str | None]]:
    """Return all that names depend on."""
    return {(tool.id, tool.device_id, tool.reference) for tool in tools}
