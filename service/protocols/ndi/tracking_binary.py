"""The reply to BX: all tools as binary records, little-endian."""

import struct
from collections.abc import Sequence

from service.protocols.ndi.reply_options import ReplyOption
from service.protocols.ndi.tool_report import MAX_MARKERS, OUT_OF_VOLUME, HandleState, ToolReport


def tracking_binary(
    reports: Sequence[ToolReport], system_status: int, options: ReplyOption
) -> bytes:
    """Return the body of a reply to BX, without start and checksums.

    Args:
        reports: of all tools.
        system_status: bits.
        options: what the client asked for.
    """
    body = bytearray([len(reports)])
    for one in reports:
        body += bytes((one.handle, one.state))
        if one.state is not HandleState.DISABLED:
            body += _tool(one, options)
    if ReplyOption.STRAYS in options:
        body.append(0)
    return bytes(body) + struct.pack("<H", system_status)


def _tool(one: ToolReport, options: ReplyOption) -> bytes:
    data = b""
    if ReplyOption.TRANSFORMS in options:
        if one.quaternion is not None and one.translation_mm is not None:
            data += struct.pack("<8f", *one.quaternion, *one.translation_mm, one.error_mm)
        data += struct.pack("<II", one.port_status, one.frame)
    if ReplyOption.INFORMATION in options:
        used = min(one.markers_used, MAX_MARKERS)
        # Half a byte for each marker, that of the first marker last.
        markers = int("3" * used or "0", 16).to_bytes(MAX_MARKERS // 2, "big")
        data += bytes((one.information,)) + markers
    if ReplyOption.SINGLE_STRAY in options:
        data += b"\0"
    if ReplyOption.MARKERS in options:
        data += _markers(one)
    return data


def _markers(one: ToolReport) -> bytes:
    count = len(one.markers_mm)
    outside = (1 << count) - 1 if one.port_status & OUT_OF_VOLUME else 0
    places = (struct.pack("<3f", *place) for place in one.markers_mm)
    return bytes((count,)) + outside.to_bytes(-(-count // 8), "little") + b"".join(places)
