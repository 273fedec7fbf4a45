"""Commands on the system and its port handles: text in, text of the reply out; None: OKAY."""

from service.protocols.ndi.client_state import (
    API_REVISION,
    ClientState,
    Mode,
    describe_features,
)
from service.protocols.ndi.command import RESET, CommandError, ErrorCode, hexadecimal, require
from service.protocols.ndi.port_handles import (
    BLOCK_BYTES,
    PortHandle,
    describe_handle,
    match_tool,
    names_in_definition,
    select_handles,
)


def led(state: ClientState, text: str) -> None:
    """LED: our tools have none; drivers need no refusal."""
    require(len(text) == 4, ErrorCode.WRONG_PARAMETERS)
    state.port(text[:2])
    require(text[2] in "123", ErrorCode.INVALID_LED)
    require(text[3] in "BFS", ErrorCode.INVALID_LED_STATE)


def handles(state: ClientState, text: str) -> str:
    """PHSR: port handles."""
    option = hexadecimal(text, 2) if text else 0
    state.ports.settle(state.view().tools)
    chosen = select_handles(state.ports, option)
    return f"{len(chosen):02X}" + "".join(f"{one.handle:02X}{one.status:03X}" for one in chosen)


def handle_information(state: ClientState, text: str) -> str:
    """PHINF: information about the tool behind a handle."""
    port = state.port(text[:2])
    return describe_handle(port, hexadecimal(text[2:], 4) if text[2:] else 1)


def request_handle(state: ClientState, text: str) -> str:
    """PHRQ: a handle for a tool whose definition will be uploaded."""
    require(len(text) == 14, ErrorCode.WRONG_PARAMETERS)
    return f"{state.ports.request().handle:02X}"


def upload(state: ClientState, text: str) -> None:
    """PVWR: a part of a tool definition."""
    require(len(text) == 6 + 2 * BLOCK_BYTES, ErrorCode.WRONG_PARAMETERS)
    port = state.port(text[:2])
    block = hexadecimal(text[6:], 2 * BLOCK_BYTES).to_bytes(BLOCK_BYTES, "big")
    port.upload(hexadecimal(text[2:6], 4), block)


def initialise_handle(state: ClientState, text: str) -> None:
    """PINIT: find the tool behind a handle."""
    port = state.port(text)
    if port.tool is None:
        port.tool = _meant(state, port)
    require(port.tool is not None and not port.removed, ErrorCode.NO_TOOL)
    port.initialised = True


def enable(state: ClientState, text: str) -> None:
    """PENA: report the tool."""
    require(len(text) == 3, ErrorCode.WRONG_PARAMETERS)
    port = state.port(text[:2])
    require(text[2] in "SDB", ErrorCode.INVALID_PRIORITY)
    require(port.initialised, ErrorCode.NOT_INITIALISED_HANDLE)
    port.enabled = True


def disable(state: ClientState, text: str) -> None:
    """PDIS: report the tool no longer."""
    state.port(text).enabled = False


def free(state: ClientState, text: str) -> None:
    """PHF: give a handle back."""
    state.ports.free(state.port(text).handle)


def _meant(state: ClientState, port: PortHandle) -> str | None:
    names, tools = names_in_definition(bytes(port.image)), state.view().tools
    tool = match_tool(names, tools, state.part_numbers)
    if tool not in tools:
        called = ", ".join(name[:40] for name in names[:5]) or "nothing"
        ours = ", ".join(tools) or "ours: there are none"
        state.report_problem(f"it uploaded a tool, called {called}, that is none of {ours}")
        return None
    return tool


def initialise(state: ClientState, text: str) -> None:
    """INIT: forget everything, and begin with the tools that are there."""
    require(not text, ErrorCode.WRONG_PARAMETERS)
    state.restart()
    view = state.view()
    if view.several:
        state.report_problem("it wants tools, and several devices have some: set ndi_device")
    require(not view.several, ErrorCode.CANNOT_INITIALISE)
    state.mode = Mode.SETUP
    state.ports.settle(view.tools)


def reset(state: ClientState, text: str) -> str:
    """RESET: as a serial break."""
    require(text in ("", "0", "1"), ErrorCode.OUT_OF_RANGE)
    state.restart()
    return RESET


def communication(_: ClientState, text: str) -> None:
    """COMM: settings of a serial line, which mean nothing here."""
    require(len(text) == 5, ErrorCode.WRONG_PARAMETERS)
    allowed = ("01234567A", "01", "012", "01", "01")
    require(
        all(one in any_of for one, any_of in zip(text, allowed, strict=True)),
        ErrorCode.OUT_OF_RANGE,
    )


def echo(_: ClientState, text: str) -> str:
    """ECHO: the same text."""
    require(bool(text), ErrorCode.TOO_SHORT)
    return text


def version(state: ClientState, text: str) -> str:
    """VER: version of the system."""
    require(text in ("", "0", "1", "2", "3", "4"), ErrorCode.OUT_OF_RANGE)
    return state.identity.firmware()


def api_revision(_: ClientState, text: str) -> str:
    """APIREV: revision of the common API."""
    require(not text, ErrorCode.WRONG_PARAMETERS)
    return API_REVISION


def features(state: ClientState, text: str) -> str:
    """SFLIST: what there is."""
    features = describe_features(hexadecimal(text, 2), len(state.view().tools))
    if features is None:
        raise CommandError(ErrorCode.OUT_OF_RANGE)
    return features


def get(state: ClientState, text: str) -> str:
    """GET: user parameters."""
    return state.parameters.get(text, state.view().frame_rate_hz)


def assign(state: ClientState, text: str) -> None:
    """SET: a user parameter."""
    state.parameters.set(text)


def beep(_: ClientState, text: str) -> str:
    """BEEP: there is no beeper; drivers need no refusal."""
    require(len(text) == 1 and text in "123456789", ErrorCode.OUT_OF_RANGE)
    return "1"


def system_status(_: ClientState, text: str) -> str:
    """SSTAT: status of processors; all are well."""
    return "00" * (hexadecimal(text, 4) & 7).bit_count()


def illumination_rate(_: ClientState, text: str) -> None:
    """IRATE: the rate is the device's own; drivers need no refusal."""
    require(text in ("0", "1", "2"), ErrorCode.OUT_OF_RANGE)


def select_volume(_: ClientState, text: str) -> None:
    """VSEL: there is one."""
    require(text == "1", ErrorCode.OUT_OF_RANGE)


def start_tracking(state: ClientState, text: str) -> None:
    """TSTART: go on to TX and BX; with 80, frames are counted from now."""
    require(text in ("", "40", "80"), ErrorCode.OUT_OF_RANGE)
    view = state.view()
    state.first_frame = max(view.sequence, 0) if text == "80" else 0
    state.reported = -1
    state.mode = Mode.TRACKING


def stop_tracking(state: ClientState, text: str) -> None:
    """TSTOP: back to setting up."""
    require(not text, ErrorCode.WRONG_PARAMETERS)
    state.mode = Mode.SETUP
