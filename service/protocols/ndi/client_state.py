"""ClientState: state that the common API keeps for one client."""

from collections.abc import Mapping
from enum import Enum, auto
from typing import Final

from service.protocols.ndi.errors import CommandError, ErrorCode
from service.protocols.ndi.identity import Identity
from service.protocols.ndi.port_handles import PortHandle, PortHandles
from service.protocols.ndi.pose_view import GetPoseView, PoseView
from service.protocols.ndi.reply_options import hexadecimal
from service.protocols.ndi.user_parameters import UserParameters

MAX_PROBLEMS: Final = 50


class Mode(Enum):
    """What the client has brought the system to."""

    STARTED = auto()
    SETUP = auto()
    TRACKING = auto()


class ClientState:
    """Every client has its own: its handles, its mode, its parameters.

    Args:
        identity: what to say of ourselves.
        look: where poses come from.
        part_numbers: tools by what uploaded definitions call them.

    Attributes:
        mode: where the client is.
        ports: its handles.
        parameters: its user parameters.
        device: the device whose tools it sees; None: not known yet.
        first_frame: the frame that counts as 0.
        reported: number of the frame that was reported last; -1: none was.
        complaints: why the client did not get what it wanted, in words, for the log; the first
            MAX_COMPLAINTS.
    """

    def __init__(
        self, identity: Identity, look: GetPoseView, part_numbers: Mapping[str, str]
    ) -> None:
        self.problems: list[str] = []
        self.identity = identity
        self.part_numbers = part_numbers
        self._look = look
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
        """Keep a complaint."""
        if len(self.problems) < MAX_PROBLEMS:
            self.problems.append(text)

    def view(self) -> PoseView:
        """Return what there is now; the first device that is seen stays the client's."""
        view = self._look(self.device)
        if self.device is None:
            self.device = view.device_id
        return view

    def port(self, text: str) -> PortHandle:
        """Return the handle that two hexadecimal digits are; raises Refused."""
        if len(text) != 2:
            raise CommandError(ErrorCode.WRONG_PARAMETERS)
        try:
            handle = hexadecimal(text, 2)
        except CommandError:
            raise CommandError(ErrorCode.INVALID_HANDLE) from None
        return self.ports.find(handle)


def nothing(text: str) -> None:
    """Refuse parameters of a command that has none."""
    if text:
        raise CommandError(ErrorCode.WRONG_PARAMETERS)
