"""Names of the transforms of all tools of a device, unique on the wire."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from service.pipeline.transform_names import NAME_BYTES, TO, TRACKER, TransformName, wire_name
from service.protocols.openigtlink.host import WireTool


@dataclass(frozen=True)
class ToolNames:
    """Names of all tools of a device.

    Args:
        names: by the tool's id.
        refused: why others are not sent, by their id.
    """

    names: Mapping[str, TransformName]
    refused: Mapping[str, str]


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
