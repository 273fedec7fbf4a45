"""Commands about port handles: text of a command in, text of its reply out."""

from service.ndi import information
from service.ndi.definition import BLOCK_BYTES, meant_tool, names_in
from service.ndi.options import hexadecimal
from service.ndi.ports import Port
from service.ndi.refusal import ErrorCode, Refused
from service.ndi.reply import OKAY
from service.ndi.state import State


def led(state: State, text: str) -> str:
    """LED: our tools have none; drivers need no refusal."""
    if len(text) != 4:
        raise Refused(ErrorCode.WRONG_PARAMETERS)
    state.port(text[:2])
    if text[2] not in "123":
        raise Refused(ErrorCode.INVALID_LED)
    if text[3] not in "BFS":
        raise Refused(ErrorCode.INVALID_LED_STATE)
    return OKAY


def handles(state: State, text: str) -> str:
    """PHSR: port handles."""
    option = hexadecimal(text, 2) if text else 0
    state.ports.settle(state.view().tools)
    chosen = information.handles(state.ports, option)
    return f"{len(chosen):02X}" + "".join(f"{one.handle:02X}{one.status:03X}" for one in chosen)


def handle_information(state: State, text: str) -> str:
    """PHINF: what is known of the tool behind a handle."""
    port = state.port(text[:2])
    return information.of_handle(port, hexadecimal(text[2:], 4) if text[2:] else 1)


def request_handle(state: State, text: str) -> str:
    """PHRQ: a handle for a tool whose definition will be uploaded."""
    if len(text) != 14:
        raise Refused(ErrorCode.WRONG_PARAMETERS)
    return f"{state.ports.request().handle:02X}"


def upload(state: State, text: str) -> str:
    """PVWR: a part of a tool definition."""
    if len(text) != 6 + 2 * BLOCK_BYTES:
        raise Refused(ErrorCode.WRONG_PARAMETERS)
    port = state.port(text[:2])
    block = hexadecimal(text[6:], 2 * BLOCK_BYTES).to_bytes(BLOCK_BYTES, "big")
    port.upload(hexadecimal(text[2:6], 4), block)
    return OKAY


def initialise_handle(state: State, text: str) -> str:
    """PINIT: find the tool behind a handle."""
    port = state.port(text)
    if port.tool is None:
        port.tool = _meant(state, port)
    if port.tool is None or port.gone:
        raise Refused(ErrorCode.NO_TOOL)
    port.initialised = True
    return OKAY


def enable(state: State, text: str) -> str:
    """PENA: report the tool."""
    if len(text) != 3:
        raise Refused(ErrorCode.WRONG_PARAMETERS)
    port = state.port(text[:2])
    if text[2] not in "SDB":
        raise Refused(ErrorCode.INVALID_PRIORITY)
    if not port.initialised:
        raise Refused(ErrorCode.NOT_INITIALISED_HANDLE)
    port.enabled = True
    return OKAY


def disable(state: State, text: str) -> str:
    """PDIS: report the tool no longer."""
    state.port(text).enabled = False
    return OKAY


def free(state: State, text: str) -> str:
    """PHF: give a handle back."""
    state.ports.free(state.port(text).handle)
    return OKAY


def _meant(state: State, port: Port) -> str | None:
    names, tools = names_in(bytes(port.image)), state.view().tools
    found = meant_tool(names, tools, state.part_numbers)
    if found not in tools:
        called = ", ".join(name[:40] for name in names[:5]) or "nothing"
        ours = ", ".join(tools) or "ours: there are none"
        state.complain(f"it uploaded a tool, called {called}, that is none of {ours}")
        return None
    return found
