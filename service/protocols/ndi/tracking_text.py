"""The reply to TX: all tools as text."""

from collections.abc import Sequence

from service.protocols.ndi.fixed_point import millimetres, unit
from service.protocols.ndi.reply_options import ReplyOption
from service.protocols.ndi.tool_report import MAX_MARKERS, OUT_OF_VOLUME, HandleState, ToolReport


def tracking_text(reports: Sequence[ToolReport], system_status: int, options: ReplyOption) -> str:
    """Return the text of a reply to TX, without its checksum.

    Args:
        reports: of all tools.
        system_status: bits.
        options: what the client asked for.
    """
    tools = "".join(f"{one.handle:02X}{_tool(one, options)}\n" for one in reports)
    strays = "00" if ReplyOption.STRAYS in options else ""
    return f"{len(reports):02X}{tools}{strays}{system_status:04X}"


def _tool(one: ToolReport, options: ReplyOption) -> str:
    parts = []
    if ReplyOption.TRANSFORMS in options:
        parts += [_transform(one), f"{one.port_status:08X}", f"{one.frame:08X}"]
    if ReplyOption.INFORMATION in options:
        markers = ("3" * one.markers_used)[:MAX_MARKERS].rjust(MAX_MARKERS, "0")
        parts += [f"{one.information:02X}", markers]
    if ReplyOption.SINGLE_STRAY in options:
        parts.append("DISABLED" if one.state is HandleState.DISABLED else "MISSING")
    if ReplyOption.MARKERS in options:
        parts.append(_markers(one))
    return "".join(parts)


def _transform(one: ToolReport) -> str:
    if one.quaternion is None or one.translation_mm is None:
        return one.state.name
    numbers = "".join(unit(value) for value in one.quaternion)
    return numbers + millimetres(one.translation_mm) + unit(one.error_mm)


def _markers(one: ToolReport) -> str:
    count = len(one.markers_mm)
    outside = (1 << count) - 1 if one.port_status & OUT_OF_VOLUME else 0
    digits = -(-count // 4)
    bits = f"{outside:0{digits}X}" if digits else ""
    return f"{count:02X}{bits}" + "".join(millimetres(place) for place in one.markers_mm)
