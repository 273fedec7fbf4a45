"""Commands about the system as a whole: text of a command in, text of its reply out."""

from service.ndi import identity
from service.ndi.options import hexadecimal
from service.ndi.refusal import ErrorCode, Refused
from service.ndi.reply import OKAY, RESET
from service.ndi.state import Mode, State, nothing


def initialise(state: State, text: str) -> str:
    """INIT: forget everything, and begin with the tools that are there."""
    nothing(text)
    state.restart()
    view = state.view()
    if view.several:
        state.complain("it wants tools, and several devices have some: set ndi_device")
        raise Refused(ErrorCode.CANNOT_INITIALISE)
    state.mode = Mode.SETUP
    state.ports.settle(view.tools)
    return OKAY


def reset(state: State, text: str) -> str:
    """RESET: as a serial break."""
    if text not in ("", "0", "1"):
        raise Refused(ErrorCode.OUT_OF_RANGE)
    state.restart()
    return RESET


def communication(_: State, text: str) -> str:
    """COMM: settings of a serial line, which mean nothing here."""
    if len(text) != 5:
        raise Refused(ErrorCode.WRONG_PARAMETERS)
    allowed = ("01234567A", "01", "012", "01", "01")
    if not all(one in any_of for one, any_of in zip(text, allowed, strict=True)):
        raise Refused(ErrorCode.OUT_OF_RANGE)
    return OKAY


def echo(_: State, text: str) -> str:
    """ECHO: the same text."""
    if not text:
        raise Refused(ErrorCode.TOO_SHORT)
    return text


def version(state: State, text: str) -> str:
    """VER: who we are."""
    if text not in ("", "0", "1", "2", "3", "4"):
        raise Refused(ErrorCode.OUT_OF_RANGE)
    return state.identity.firmware()


def api_revision(_: State, text: str) -> str:
    """APIREV: revision of the common API."""
    nothing(text)
    return identity.API_REVISION


def features(state: State, text: str) -> str:
    """SFLIST: what there is."""
    found = identity.features(hexadecimal(text, 2), len(state.view().tools))
    if found is None:
        raise Refused(ErrorCode.OUT_OF_RANGE)
    return found


def get(state: State, text: str) -> str:
    """GET: user parameters."""
    return state.parameters.get(text, state.view().frame_rate_hz)


def assign(state: State, text: str) -> str:
    """SET: a user parameter."""
    state.parameters.set(text)
    return OKAY


def beep(_: State, text: str) -> str:
    """BEEP: there is no beeper; drivers need no refusal."""
    if len(text) != 1 or text not in "123456789":
        raise Refused(ErrorCode.OUT_OF_RANGE)
    return "1"


def system_status(_: State, text: str) -> str:
    """SSTAT: status of processors; all are well."""
    return "00" * (hexadecimal(text, 4) & 7).bit_count()


def illumination_rate(_: State, text: str) -> str:
    """IRATE: the rate is the device's own; drivers need no refusal."""
    if text not in ("0", "1", "2"):
        raise Refused(ErrorCode.OUT_OF_RANGE)
    return OKAY


def select_volume(_: State, text: str) -> str:
    """VSEL: there is one."""
    if text != "1":
        raise Refused(ErrorCode.OUT_OF_RANGE)
    return OKAY


def start_tracking(state: State, text: str) -> str:
    """TSTART: go on to TX and BX; with 80, frames are counted from now."""
    if text not in ("", "40", "80"):
        raise Refused(ErrorCode.OUT_OF_RANGE)
    view = state.view()
    state.first_frame = max(view.sequence, 0) if text == "80" else 0
    state.reported = -1
    state.mode = Mode.TRACKING
    return OKAY


def stop_tracking(state: State, text: str) -> str:
    """TSTOP: back to setting up."""
    nothing(text)
    state.mode = Mode.SETUP
    return OKAY
