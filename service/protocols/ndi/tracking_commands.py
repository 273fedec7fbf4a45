"""TX and BX: the newest poses of the tools that a client has initialised."""

from typing import Final

from service.protocols.ndi.client_state import ClientState
from service.protocols.ndi.port_handles import PortHandle
from service.protocols.ndi.pose_view import PoseView
from service.protocols.ndi.reply import binary_reply, text_reply
from service.protocols.ndi.reply_options import ReplyOption, reply_option
from service.protocols.ndi.tool_report import ToolReport, report
from service.protocols.ndi.tracking_binary import tracking_binary
from service.protocols.ndi.tracking_text import tracking_text

RECOVERABLE: Final = 0x0008
"""Of the system status: no new poses come."""


def tracking(state: ClientState, text: str, *, binary: bool) -> bytes:
    """Return the whole reply to TX, or to BX if ``binary``; raises Refused."""
    options = reply_option(text)
    view = state.view()
    state.ports.look(view.tools)
    state.reported = view.sequence
    frame = max(view.sequence - state.first_frame, 0) & 0xFFFFFFFF
    reports = [_report(port, view, frame, options) for port in state.ports if port.initialised]
    status = state.ports.changes | (0 if view.fresh else RECOVERABLE)
    if binary:
        return binary_reply(tracking_binary(reports, status, options))
    return text_reply(tracking_text(reports, status, options))


def _report(port: PortHandle, view: PoseView, frame: int, options: ReplyOption) -> ToolReport:
    tool = port.tool or ""
    return report(
        port,
        view.pose(tool),
        frame,
        out_of_volume=ReplyOption.OUT_OF_VOLUME in options,
        markers_mm=view.markers(tool) if ReplyOption.MARKERS in options else None,
    )
