"""Session: one client's conversation. Commands in, replies out; no socket, no clock."""

from collections.abc import Callable, Mapping
from typing import Final

from service.protocols.ndi import commands
from service.protocols.ndi.client_state import ClientState, Identity, Mode
from service.protocols.ndi.command import (
    OKAY,
    RESET,
    Command,
    CommandError,
    ErrorCode,
    Received,
    error_reply,
    text_reply,
)
from service.protocols.ndi.pose_feed import GetPoseView
from service.protocols.ndi.tracking import tracking

_Carry = Callable[[ClientState, str], str | None]


class Session:
    """Answers one client.

    Attributes:
        state: what the client has done so far.
        answered: commands that were carried out.
        refused: commands that were not, and what was none.
    """

    def __init__(
        self,
        identity: Identity,
        get_view: GetPoseView,
        part_numbers: Mapping[str, str] | None = None,
    ) -> None:
        self.state = ClientState(identity, get_view, part_numbers or {})
        self.answered = self.refused = 0

    def repeats(self, received: Received) -> bool:
        """Return whether the reply would have nothing new: a moment's wait may be worth it."""
        return (
            isinstance(received, Command)
            and received.name in _TRACKING
            and self.state.mode is Mode.TRACKING
            and self.state.view().sequence == self.state.reported
        )

    def answer(self, received: Received) -> bytes:
        """Return the reply to what came."""
        try:
            if isinstance(received, ErrorCode):
                raise CommandError(received)
            reply = self._execute(received) if isinstance(received, Command) else self._reset()
        except CommandError as refused:
            self.refused += 1
            return error_reply(refused.code)
        self.answered += 1
        return reply

    def _reset(self) -> bytes:
        self.state.restart()
        return text_reply(RESET)

    def _execute(self, command: Command) -> bytes:
        entry = _COMMANDS.get(command.name)
        if entry is None and command.name not in _TRACKING:
            raise CommandError(ErrorCode.INVALID_COMMAND)
        modes, carry = entry or (_IN_TRACKING, None)
        if self.state.mode not in modes:
            started = self.state.mode is Mode.STARTED
            raise CommandError(
                ErrorCode.NOT_INITIALISED if started else ErrorCode.INVALID_IN_THIS_MODE
            )
        if carry is None:
            return tracking(self.state, command.text, binary=command.name == "BX")
        reply = carry(self.state, command.text)
        return text_reply(OKAY if reply is None else reply)


_ANY: Final = frozenset(Mode)
_READY: Final = frozenset((Mode.SETUP, Mode.TRACKING))
_IN_SETUP: Final = frozenset((Mode.SETUP,))
_IN_TRACKING: Final = frozenset((Mode.TRACKING,))
_TRACKING: Final = ("TX", "BX")
_COMMANDS: Final[dict[str, tuple[frozenset[Mode], _Carry]]] = {
    "INIT": (_ANY, commands.initialise),
    "RESET": (_ANY, commands.reset),
    "COMM": (_ANY, commands.communication),
    "ECHO": (_ANY, commands.echo),
    "VER": (_ANY, commands.version),
    "APIREV": (_ANY, commands.api_revision),
    "SFLIST": (_ANY, commands.features),
    "GET": (_ANY, commands.get),
    "SET": (_ANY, commands.assign),
    "BEEP": (_ANY, commands.beep),
    "SSTAT": (_READY, commands.system_status),
    "LED": (_READY, commands.led),
    "PHSR": (_READY, commands.handles),
    "PHINF": (_READY, commands.handle_information),
    "PHRQ": (_IN_SETUP, commands.request_handle),
    "PVWR": (_IN_SETUP, commands.upload),
    "PINIT": (_IN_SETUP, commands.initialise_handle),
    "PENA": (_IN_SETUP, commands.enable),
    "PDIS": (_IN_SETUP, commands.disable),
    "PHF": (_IN_SETUP, commands.free),
    "IRATE": (_IN_SETUP, commands.illumination_rate),
    "VSEL": (_IN_SETUP, commands.select_volume),
    "TSTART": (_IN_SETUP, commands.start_tracking),
    "TSTOP": (_IN_TRACKING, commands.stop_tracking),
}
"""In which modes a command is carried out, and by what; all others are refused."""
