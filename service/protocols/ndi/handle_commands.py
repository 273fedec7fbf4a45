"""Commands about port handles: text of a command in, text of its reply out."""

from service.protocols.ndi import port_information
from service.protocols.ndi.client_state import ClientState
from service.protocols.ndi.errors import CommandError, ErrorCode
from service.protocols.ndi.port_handles import PortHandle
from service.protocols.ndi.reply import OKAY
from service.protocols.ndi.reply_options import hexadecimal
from service.protocols.ndi.tool_definition import BLOCK_BYTES, match_tool, names_in_definition


def led(state: ClientState, text: str) -> str:
    """LED: our tools have none; drivers need no refusal."""
    if len(text) != 4:
        raise CommandError(ErrorCode.WRONG_PARAMETERS)
    state.port(text[:2])
    if text[2] not in "123":
        raise CommandError(ErrorCode.INVALID_LED)
    if text[3] not in "BFS":
        raise CommandError(ErrorCode.INVALID_LED_STATE)
    return OKAY


def handles(state: ClientState, text: str) -> str:
    """PHSR: port handles."""
    option = hexadecimal(text, 2) if text else 0
    state.ports.settle(state.view().tools)
    chosen = port_information.handles(state.ports, option)
    return f"{len(chosen):02X}" + "".join(f"{one.handle:02X}{one.status:03X}" for one in chosen)


def handle_information(state: ClientState, text: str) -> str:
    """PHINF: what is known of the tool behind a handle."""
    port = state.port(text[:2])
    return port_information.of_handle(port, hexadecimal(text[2:], 4) if text[2:] else 1)


def request_handle(state: ClientState, text: str) -> str:
    """PHRQ: a handle for a tool whose definition will be uploaded."""
    if len(text) != 14:
        raise CommandError(ErrorCode.WRONG_PARAMETERS)
    return f"{state.ports.request().handle:02X}"


def upload(state: ClientState, text: str) -> str:
    """PVWR: a part of a tool definition."""
    if len(text) != 6 + 2 * BLOCK_BYTES:
        raise CommandError(ErrorCode.WRONG_PARAMETERS)
    port = state.port(text[:2])
    block = hexadecimal(text[6:], 2 * BLOCK_BYTES).to_bytes(BLOCK_BYTES, "big")
    port.upload(hexadecimal(text[2:6], 4), block)
    return OKAY


def initialise_handle(state: ClientState, text: str) -> str:
    """PINIT: find the tool behind a handle."""
    port = state.port(text)
    if port.tool is None:
        port.tool = _meant(state, port)
    if port.tool is None or port.gone:
        raise CommandError(ErrorCode.NO_TOOL)
    port.initialised = True
    return OKAY


def enable(state: ClientState, text: str) -> str:
    """PENA: report the tool."""
    if len(text) != 3:
        raise CommandError(ErrorCode.WRONG_PARAMETERS)
    port = state.port(text[:2])
    if text[2] not in "SDB":
        raise CommandError(ErrorCode.INVALID_PRIORITY)
    if not port.initialised:
        raise CommandError(ErrorCode.NOT_INITIALISED_HANDLE)
    port.enabled = True
    return OKAY


def disable(state: ClientState, text: str) -> str:
    """PDIS: report the tool no longer."""
    state.port(text).enabled = False
    return OKAY


def free(state: ClientState, text: str) -> str:
    """PHF: give a handle back."""
    state.ports.free(state.port(text).handle)
    return OKAY


def _meant(state: ClientState, port: PortHandle) -> str | None:
    names, tools = names_in_definition(bytes(port.image)), state.view().tools
    found = match_tool(names, tools, state.part_numbers)
    if found not in tools:
        called = ", ".join(name[:40] for name in names[:5]) or "nothing"
        ours = ", ".join(tools) or "ours: there are none"
        state.report_problem(f"it uploaded a tool, called {called}, that is none of {ours}")
        return None
    return found
