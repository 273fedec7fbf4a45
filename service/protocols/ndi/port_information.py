"""Information on port handles: the replies to PHSR and PHINF."""

import zlib
from collections.abc import Iterable
from typing import Final

from service.protocols.ndi.errors import CommandError, ErrorCode
from service.protocols.ndi.port_handles import PortHandle
from service.protocols.ndi.tool_definition import NAME_CHARACTERS

UNOCCUPIED: Final = "UNOCCUPIED"
_TOOL_TYPE: Final = "02000000"
"""A probe without switches and lights."""
_MANUFACTURER: Final = "Lumiline".ljust(12)
_REVISION: Final = "001"
_OPTIONS: Final = 0x7F


def handles(ports: Iterable[PortHandle], option: int) -> list[PortHandle]:
    """Return the handles that PHSR lists.

    Args:
        ports: all of them.
        option: 0: all, 1: whose tool is gone, 2: to be initialised, 3: to be enabled, 4: enabled.

    Raises:
        Refused: there is no such option.
    """
    if option not in range(5):
        raise CommandError(ErrorCode.OUT_OF_RANGE)
    return [
        one
        for one in ports
        if (
            option == 0
            or (option == 1 and one.gone)
            or (option == 2 and one.occupied and not one.initialised)
            or (option == 3 and one.occupied and one.initialised and not one.enabled)
            or (option == 4 and one.occupied and one.enabled)
        )
    ]


def of_handle(port: PortHandle, options: int) -> str:
    """Return what PHINF tells of a handle.

    Args:
        port: the handle.
        options: bits: 1: kind, maker, revision, serial number and status; 2: test of currents;
            4: part number, which is the tool's id; 8: accessories; 0x10: markers; 0x20: where it
            is plugged in; 0x40: switches of another kind.

    Raises:
        Refused: there is no such option.
    """
    if options & ~_OPTIONS:
        raise CommandError(ErrorCode.OUT_OF_RANGE)
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
        _location(port),
        "00",
    )
    return "".join(part for bit, part in enumerate(parts) if options >> bit & 1)


def _location(port: PortHandle) -> str:
    """Return device, system, wired or not, socket and channel: 14 characters."""
    kind = "0" if port.location else "1"
    return f"{0:08d}0{kind}{port.location:02d}00"
