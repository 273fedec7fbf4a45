"""Port handles: tools by number, their uploaded definitions, and replies about them."""

import re
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Final

from service.protocols.ndi.command import ErrorCode, require

MAX_DEFINITION_BYTES: Final = 2048
"""What a handle has room for."""
BLOCK_BYTES: Final = 64
"""What one command uploads."""
NAME_CHARACTERS: Final = 20
"""Of part numbers."""

_MAGIC: Final = b"NDI"
_PART_NUMBER: Final = slice(592, 592 + NAME_CHARACTERS)
_TEXT: Final = re.compile(rb"[\x20-\x7e]+")


def names_in_definition(image: bytes) -> tuple[str, ...]:
    """Return the names that a tool definition could mean a tool by, at most 100.

    Of a definition file (``.rom``) it is the part number. Of anything else, all text in it: a
    file that holds a tool's name and nothing more will do.
    """
    searched = image[_PART_NUMBER] if image.startswith(_MAGIC) else image
    names = (part.strip().decode() for part in _TEXT.findall(searched))
    return tuple(dict.fromkeys(name for name in names if name))[:100]


def match_tool(
    names: Sequence[str], tools: Sequence[str], part_numbers: Mapping[str, str]
) -> str | None:
    """Return the tool that one of these names means; None: none does, or more than one."""
    tool_of_number = {number.casefold(): tool for number, tool in part_numbers.items()}
    meant = {
        tool for name in names for tool in _tools_called(name.casefold(), tools, tool_of_number)
    }
    return meant.pop() if len(meant) == 1 else None


def _tools_called(
    name: str, tools: Sequence[str], tool_of_number: Mapping[str, str]
) -> Iterator[str]:
    if name in tool_of_number:
        yield tool_of_number[name]
        return
    exact = [tool for tool in tools if tool.casefold() == name]
    cut = [tool for tool in tools if tool.casefold()[:NAME_CHARACTERS] == name]
    yield from exact or cut


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
    removed: bool = False

    @property
    def occupied(self) -> bool:
        """Whether there is a tool, or the definition of one."""
        return not self.removed and (self.tool is not None or bool(self.image))

    @property
    def status(self) -> int:
        """Status bits of the handle: occupied, initialised, enabled."""
        return OCCUPIED * self.occupied + INITIALISED * self.initialised + ENABLED * self.enabled

    def upload(self, address: int, block: bytes) -> None:
        """Keep a part of a tool's definition; what was initialised is so no longer.

        Raises:
            CommandError: the tool came plugged in, or the part lies beyond the end.
        """
        require(not self.location, ErrorCode.NO_SUCH_FEATURE)
        end = address + len(block)
        require(end <= MAX_DEFINITION_BYTES, ErrorCode.OUT_OF_RANGE)
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
        """Return a handle; raises CommandError."""
        require(handle in self._ports, ErrorCode.NOT_ALLOCATED)
        return self._ports[handle]

    def poll_tools(self, tools: Sequence[str]) -> None:
        """Note which tools came and went, for the system status."""
        plugged = {port.tool for port in self._ports.values() if port.location}
        if len(self._ports) < MAX_HANDLES and any(tool not in plugged for tool in tools):
            self.changes |= 0x40
        for port in self._ports.values():
            removed = port.tool is not None and port.tool not in tools
            if removed and not port.removed:
                self.changes |= 0x80
            port.removed = removed

    def settle(self, tools: Sequence[str]) -> None:
        """Give every tool that is there, and has none yet, a handle, as far as they go."""
        self.poll_tools(tools)
        self.changes = 0
        plugged = {port.tool for port in self._ports.values() if port.location}
        for tool in tools:
            if tool not in plugged and len(self._ports) < MAX_HANDLES:
                used = {port.location for port in self._ports.values()}
                self._add(next(number for number in count(1) if number not in used), tool)

    def request(self) -> PortHandle:
        """Return a new handle, for a tool whose definition is uploaded; raises CommandError."""
        require(len(self._ports) < MAX_HANDLES, ErrorCode.ALL_ALLOCATED)
        return self._add(0, None)

    def free(self, handle: int) -> None:
        """Take a handle back; raises CommandError."""
        self.find(handle)
        del self._ports[handle]

    def _add(self, location: int, tool: str | None) -> PortHandle:
        handle = next(number for number in count(1) if number not in self._ports)
        port = self._ports[handle] = PortHandle(handle, location, tool)
        return port


UNOCCUPIED: Final = "UNOCCUPIED"
_TOOL_TYPE: Final = "02000000"
"""A probe without switches and lights."""
_MANUFACTURER: Final = "Lumiline".ljust(12)
_REVISION: Final = "001"
_OPTIONS: Final = 0x7F


def select_handles(ports: Iterable[PortHandle], option: int) -> list[PortHandle]:
    """Return the handles that PHSR lists.

    Args:
        ports: all of them.
        option: 0: all, 1: whose tool is gone, 2: to be initialised, 3: to be enabled, 4: enabled.

    Raises:
        CommandError: there is no such option.
    """
    require(option in range(5), ErrorCode.OUT_OF_RANGE)
    return [
        one
        for one in ports
        if (
            True,
            one.removed,
            one.occupied and not one.initialised,
            one.occupied and one.initialised and not one.enabled,
            one.occupied and one.enabled,
        )[option]
    ]


def describe_handle(port: PortHandle, options: int) -> str:
    """Return the reply of PHINF about a handle.

    Args:
        port: the handle.
        options: bits: 1: kind, maker, revision, serial number and status; 2: test of currents;
            4: part number, which is the tool's id; 8: accessories; 0x10: markers; 0x20: where it
            is plugged in; 0x40: switches of another kind.

    Raises:
        CommandError: there is no such option.
    """
    require(not options & ~_OPTIONS, ErrorCode.OUT_OF_RANGE)
    if not port.occupied:
        return UNOCCUPIED
    name = port.tool or ""
    serial = f"{zlib.crc32(name.encode()):08X}"
    parts = (
        f"{_TOOL_TYPE}{_MANUFACTURER}{_REVISION}{serial}{port.status:02X}",
        "00000000",
        name[:NAME_CHARACTERS].ljust(NAME_CHARACTERS),
        "00",
        "00",
        # Device, system, wired or not, socket and channel:
        f"{0:08d}0{0 if port.location else 1}{port.location:02d}00",
        "00",
    )
    return "".join(part for bit, part in enumerate(parts) if options >> bit & 1)
