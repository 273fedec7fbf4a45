"""What a tool's transform is called on the wire: ``probeToTracker``, ``probeToPatient``."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from service.protocols.openigtlink.header import NAME_BYTES
from service.protocols.openigtlink.host import WireTool

TRACKER: Final = "Tracker"
"""The frame of the device's own coordinates."""
TO: Final = "To"
_MAX_FRAME_BYTES: Final = NAME_BYTES - len(TO)
_FRAME_LEAST: Final = 9
"""What the second frame keeps of its name before the first is cut below what is left."""


@dataclass(frozen=True)
class TransformName:
    """The name of a transform.

    Args:
        short: at most 20 bytes, as the header has it.
        full: the whole name.
        frame: id of the tool that the transform is to; None: the tracker.
    """

    short: str
    full: str
    frame: str | None


@dataclass(frozen=True)
class ToolNames:
    """Names of all tools of a device.

    Args:
        names: by the tool's id.
        refused: why others are not sent, by their id.
    """

    names: Mapping[str, TransformName]
    refused: Mapping[str, str]


def frame_name(tool: str | None) -> str:
    """Return a frame's name behind "To".

    With a capital, as "Tracker" has: readers find the "To" of ``probeToPatient`` by what is
    behind it, so that they do not take that of "toolTop" for it.
    """
    return TRACKER if tool is None else tool[:1].upper() + tool[1:]


def wire_name(tool: str, reference: str | None) -> TransformName:
    """Return the name of a tool's transform; both frames are cut where it is too long.

    The second keeps at least nine bytes of its name, and the first has the rest.
    """
    frame = frame_name(reference)
    full = f"{tool}{TO}{frame}"
    kept = frame[: max(_FRAME_LEAST, _MAX_FRAME_BYTES - len(tool))]
    return TransformName(f"{tool[: _MAX_FRAME_BYTES - len(kept)]}{TO}{kept}", full, reference)


def name_tools(tools: Sequence[WireTool]) -> ToolNames:
    """Name all tools; those whose name would be another's too are all refused.

    Args:
        tools: of one device.
    """
    known = {tool.id for tool in tools}
    names: dict[str, TransformName] = {}
    refused: dict[str, str] = {}
    for tool in tools:
        wrong = _wrong(tool, known)
        if wrong is None:
            names[tool.id] = wire_name(tool.id, tool.reference)
        else:
            refused[tool.id] = wrong
    counts = Counter(name.short for name in names.values())
    for one, name in list(names.items()):
        if counts[name.short] > 1:
            others = sorted(other for other in names if names[other].short == name.short)
            refused[one] = (
                f'the names of {", ".join(others)} are cut to the same "{name.short}": a name has '
                f"{NAME_BYTES} bytes; give the tools shorter ids"
            )
    kept = {one: name for one, name in names.items() if one not in refused}
    return ToolNames(MappingProxyType(kept), MappingProxyType(refused))


def _wrong(tool: WireTool, known: set[str]) -> str | None:
    for frame in filter(None, (tool.id, tool.reference)):
        if TO in frame or not frame.isascii():
            return f'"{frame}" cannot be the name of a frame: it has "{TO}" in it, or is not ASCII'
    if tool.id == tool.reference or tool.id == TRACKER:
        return f'"{tool.id}" cannot be given relative to itself, nor be called like the tracker'
    if tool.reference is not None and tool.reference not in known:
        return f'its reference "{tool.reference}" is no tool of the same device'
    return None
