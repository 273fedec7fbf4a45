"""Port handles: which tool is behind which number, and whether the client wants it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

from service.protocols.ndi.errors import CommandError, ErrorCode
from service.protocols.ndi.tool_definition import MAX_BYTES

MAX_HANDLES: Final = 24
"""Number of tools that drivers have room for; some drivers do not count."""

OCCUPIED: Final = 0x01
INITIALISED: Final = 0x10
ENABLED: Final = 0x20


@dataclass
class PortHandle:
    """A handle.

    Args:
        handle: its number, from 1.
        location: number of the socket that its tool is plugged into, from 1; 0: the client asked
            for the handle, and uploads the tool's definition.
        tool: the tool; None: not known yet.
        image: what was uploaded.
        initialised: by PINIT.
        enabled: by PENA.
        gone: the tool is no longer there.
    """

    handle: int
    location: int
    tool: str | None = None
    image: bytearray = field(default_factory=bytearray)
    initialised: bool = False
    enabled: bool = False
    gone: bool = False

    @property
    def occupied(self) -> bool:
        """Whether there is a tool, or the definition of one."""
        return not self.gone and (self.tool is not None or bool(self.image))

    @property
    def status(self) -> int:
        """The bits that tell how far it is."""
        return OCCUPIED * self.occupied + INITIALISED * self.initialised + ENABLED * self.enabled

    def upload(self, address: int, block: bytes) -> None:
        """Keep a part of a tool's definition; what was initialised is so no longer.

        Raises:
            Refused: the tool came plugged in, or the part lies beyond the end.
        """
        if self.location:
            raise CommandError(ErrorCode.NO_SUCH_FEATURE)
        end = address + len(block)
        if end > MAX_BYTES:
            raise CommandError(ErrorCode.OUT_OF_RANGE)
        self.image.extend(bytes(max(0, end - len(self.image))))
        self.image[address:end] = block
        self.tool, self.initialised, self.enabled = None, False, False


class PortHandles:
    """The handles of one client, by number."""

    def __init__(self) -> None:
        self._ports: dict[int, PortHandle] = {}
        self.changes = 0
        """Bits of the system status: a tool came (0x40), one went (0x80), since ``settle``."""

    def __iter__(self) -> Iterator[PortHandle]:
        return iter(self._ports[handle] for handle in sorted(self._ports))

    def __len__(self) -> int:
        return len(self._ports)

    def find(self, handle: int) -> PortHandle:
        """Return a handle; raises Refused."""
        port = self._ports.get(handle)
        if port is None:
            raise CommandError(ErrorCode.NOT_ALLOCATED)
        return port

    def look(self, tools: Sequence[str]) -> None:
        """Note which tools came and went, for the system status."""
        plugged = {port.tool for port in self._ports.values() if port.location}
        if len(self._ports) < MAX_HANDLES and any(tool not in plugged for tool in tools):
            self.changes |= 0x40
        for port in self._ports.values():
            gone = port.tool is not None and port.tool not in tools
            if gone and not port.gone:
                self.changes |= 0x80
            port.gone = gone

    def settle(self, tools: Sequence[str]) -> None:
        """Give every tool that is there, and has none yet, a handle, as far as they go."""
        self.look(tools)
        self.changes = 0
        plugged = {port.tool for port in self._ports.values() if port.location}
        for tool in tools:
            if tool not in plugged and len(self._ports) < MAX_HANDLES:
                used = {port.location for port in self._ports.values()}
                location = next(
                    number for number in range(1, MAX_HANDLES + 2) if number not in used
                )
                self._add(location, tool)

    def request(self) -> PortHandle:
        """Return a new handle, for a tool whose definition is uploaded; raises Refused."""
        if len(self._ports) >= MAX_HANDLES:
            raise CommandError(ErrorCode.ALL_ALLOCATED)
        return self._add(0, None)

    def free(self, handle: int) -> None:
        """Take a handle back; raises Refused."""
        self.find(handle)
        del self._ports[handle]

    def _add(self, location: int, tool: str | None) -> PortHandle:
        handle = next(number for number in range(1, MAX_HANDLES + 1) if number not in self._ports)
        port = self._ports[handle] = PortHandle(handle, location, tool)
        return port
