"""ClientState: state that the common API keeps for one client, and its user parameters."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, auto
from typing import Final

from service.protocols.ndi.command import CommandError, ErrorCode, hexadecimal, require
from service.protocols.ndi.port_handles import MAX_HANDLES, PortHandle, PortHandles
from service.protocols.ndi.pose_feed import GetPoseView, PoseView

API_REVISION: Final = "G.002.001"
"""The common API with BX; BX2 begins with G.003."""


@dataclass(frozen=True)
class Identity:
    """Model, version and serial number that clients are told."""

    model: str
    version: str
    serial: str

    def firmware(self) -> str:
        """Return the reply to VER: lines that drivers look through for their beginnings."""
        return (
            f"{self.model} Control Firmware\n"
            f"NDI S/N: {self.serial}\n"
            f"Freeze Tag: {self.model} {self.version}\n"
            "Lumiline answers the common API; no product of Northern Digital Inc.\n"
        )


def describe_features(option: int, sockets: int) -> str | None:
    """Return the reply to SFLIST; None: there is no such option.

    Args:
        option: 0: summary, 1: ports of active tools, 2: of passive ones, 3: volumes, 4: ports that
            sense current, 5: wireless ports.
        sockets: tools that can be plugged in.
    """
    return {0: "00000003", 1: f"{min(sockets, 15):X}", 2: "9", 3: "0", 4: "0", 5: "0"}.get(option)


_MAX_TEXT: Final = 255


_TEXTS: Final = tuple(f"Param.User.String{number}" for number in range(5))
_NUMBERS: Final = {
    # What drivers set as a matter of course; what has one value only cannot be otherwise here.
    "Param.Tracking.Track Frequency": (2, (2,)),
    "Param.Tracking.Selected Volume": (0, (0,)),
    "Param.Data Averaging.Depth": (1, (1,)),
    "Param.Default Wavelength.Return Warning": (0, (0, 1)),
    "Param.System Beeper": (1, (0, 1)),
}


class UserParameters:
    """The parameters of one client; none of them changes what is measured."""

    def __init__(self, identity: Identity) -> None:
        self._fixed = {
            "Features.Firmware.Version": identity.version,
            "Features.Firmware.API Revision": API_REVISION,
            "Features.Hardware.Model": identity.model,
            "Features.Hardware.Serial Number": identity.serial,
            "Features.Tools.Enabled Tools": str(MAX_HANDLES),
        }
        self._values = {name: str(value) for name, (value, _) in _NUMBERS.items()}
        self._values |= dict.fromkeys(_TEXTS, "")

    def get(self, name: str, frame_rate_hz: float) -> str:
        """Return the lines ``name=value`` of a parameter, or of all that begin as before ``*``.

        Raises:
            CommandError: there is none.
        """
        parameters = self._fixed | self._values
        parameters["Param.Tracking.Frame Frequency"] = str(round(frame_rate_hz))
        if name.endswith("*"):
            chosen = sorted(one for one in parameters if one.startswith(name[:-1]))
        else:
            chosen = [name] if name in parameters else []
        require(bool(chosen), ErrorCode.NO_SUCH_PARAMETER)
        return "\n".join(f"{one}={parameters[one]}" for one in chosen)

    def set(self, assignment: str) -> None:
        """Set a parameter: ``name=value``; raises CommandError."""
        name, equals, value = assignment.partition("=")
        require(bool(equals), ErrorCode.WRONG_PARAMETERS)
        read_only = name in self._fixed or name == "Param.Tracking.Frame Frequency"
        require(not read_only, ErrorCode.READ_ONLY)
        require(name in self._values, ErrorCode.NO_SUCH_PARAMETER)
        if name in _NUMBERS:
            value = _checked(value, _NUMBERS[name][1])
        else:
            fits = len(value) <= _MAX_TEXT and value.isprintable()
            require(fits, ErrorCode.VALUE_OUT_OF_RANGE)
        self._values[name] = value


def _checked(value: str, allowed: tuple[int, ...]) -> str:
    require(value.removeprefix("-").isdecimal(), ErrorCode.WRONG_VALUE_TYPE)
    require(len(value) <= 10 and int(value) in allowed, ErrorCode.VALUE_OUT_OF_RANGE)
    return str(int(value))


MAX_PROBLEMS: Final = 50


class Mode(Enum):
    """Operating mode of the system for one client."""

    STARTED = auto()
    SETUP = auto()
    TRACKING = auto()


class ClientState:
    """Every client has its own: its handles, its mode, its parameters.

    Attributes:
        mode: where the client is.
        ports: its handles.
        parameters: its user parameters.
        device: the device whose tools it sees; None: not known yet.
        first_frame: the frame that counts as 0.
        reported: number of the frame that was reported last; -1: none was.
        problems: why the client did not get what it wanted, in words, for the log; the first
            MAX_PROBLEMS.
    """

    def __init__(
        self, identity: Identity, get_view: GetPoseView, part_numbers: Mapping[str, str]
    ) -> None:
        self.problems: list[str] = []
        self.identity = identity
        self.part_numbers = part_numbers
        self._get_view = get_view
        self.restart()

    def restart(self) -> None:
        """Forget everything."""
        self.mode = Mode.STARTED
        self.ports = PortHandles()
        self.parameters = UserParameters(self.identity)
        self.device: str | None = None
        self.first_frame = 0
        self.reported = -1

    def report_problem(self, text: str) -> None:
        """Keep a problem for the log."""
        if len(self.problems) < MAX_PROBLEMS:
            self.problems.append(text)

    def view(self) -> PoseView:
        """Return what there is now; the first device that is seen stays the client's."""
        view = self._get_view(self.device)
        if self.device is None:
            self.device = view.device_id
        return view

    def port(self, text: str) -> PortHandle:
        """Return the handle that two hexadecimal digits are; raises CommandError."""
        require(len(text) == 2, ErrorCode.WRONG_PARAMETERS)
        try:
            handle = hexadecimal(text, 2)
        except CommandError:
            raise CommandError(ErrorCode.INVALID_HANDLE) from None
        return self.ports.find(handle)
