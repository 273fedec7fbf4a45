"""Commands about the system as a whole: text of a command in, text of its reply out."""

from service.protocols.ndi import identity
from service.protocols.ndi.client_state import ClientState, Mode, nothing
from service.protocols.ndi.errors import CommandError, ErrorCode
from service.protocols.ndi.reply import OKAY, RESET
from service.protocols.ndi.reply_options import hexadecimal


def initialise(state: ClientState, text: str) -> str:
    """INIT: forget everything, and begin with the tools that are there."""
    nothing(text)
    state.restart()
    view = state.view()
    if view.several:
        state.report_problem("it wants tools, and several devices have some: set ndi_device")
        raise CommandError(ErrorCode.CANNOT_INITIALISE)
    state.mode = Mode.SETUP
    state.ports.settle(view.tools)
    return OKAY


def reset(state: ClientState, text: str) -> str:
    """RESET: as a serial break."""
    if text not in ("", "0", "1"):
        raise CommandError(ErrorCode.OUT_OF_RANGE)
    state.restart()
    return RESET


def communication(_: ClientState, text: str) -> str:
    """COMM: settings of a serial line, which mean nothing here."""
    if len(text) != 5:
        raise CommandError(ErrorCode.WRONG_PARAMETERS)
    allowed = ("01234567A", "01", "012", "01", "01")
    if not all(one in any_of for one, any_of in zip(text, allowed, strict=True)):
        raise CommandError(ErrorCode.OUT_OF_RANGE)
    return OKAY


def echo(_: ClientState, text: str) -> str:
    """ECHO: the same text."""
    if not text:
        raise CommandError(ErrorCode.TOO_SHORT)
    return text


def version(state: ClientState, text: str) -> str:
    """VER: who we are."""
    if text not in ("", "0", "1", "2", "3", "4"):
        raise CommandError(ErrorCode.OUT_OF_RANGE)
    return state.identity.firmware()


def api_revision(_: ClientState, text: str) -> str:
    """APIREV: revision of the common API."""
    nothing(text)
    return identity.API_REVISION


def features(state: ClientState, text: str) -> str:
    """SFLIST: what there is."""
    found = identity.features(hexadecimal(text, 2), len(state.view().tools))
    if found is None:
        raise CommandError(ErrorCode.OUT_OF_RANGE)
    return found


def get(state: ClientState, text: str) -> str:
    """GET: user parameters."""
    return state.parameters.get(text, state.view().frame_rate_hz)


def assign(state: ClientState, text: str) -> str:
    """SET: a user parameter."""
    state.parameters.set(text)
    return OKAY


def beep(_: ClientState, text: str) -> str:
    """BEEP: there is no beeper; drivers need no refusal."""
    if len(text) != 1 or text not in "123456789":
        raise CommandError(ErrorCode.OUT_OF_RANGE)
    return "1"


def system_status(_: ClientState, text: str) -> str:
    """SSTAT: status of processors; all are well."""
    return "00" * (hexadecimal(text, 4) & 7).bit_count()


def illumination_rate(_: ClientState, text: str) -> str:
    """IRATE: the rate is the device's own; drivers need no refusal."""
    if text not in ("0", "1", "2"):
        raise CommandError(ErrorCode.OUT_OF_RANGE)
    return OKAY


def select_volume(_: ClientState, text: str) -> str:
    """VSEL: there is one."""
    if text != "1":
        raise CommandError(ErrorCode.OUT_OF_RANGE)
    return OKAY


def start_tracking(state: ClientState, text: str) -> str:
    """TSTART: go on to TX and BX; with 80, frames are counted from now."""
    if text not in ("", "40", "80"):
        raise CommandError(ErrorCode.OUT_OF_RANGE)
    view = state.view()
    state.first_frame = max(view.sequence, 0) if text == "80" else 0
    state.reported = -1
    state.mode = Mode.TRACKING
    return OKAY


def stop_tracking(state: ClientState, text: str) -> str:
    """TSTOP: back to setting up."""
    nothing(text)
    state.mode = Mode.SETUP
    return OKAY
