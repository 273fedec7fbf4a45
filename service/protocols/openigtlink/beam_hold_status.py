"""BeamHoldStatusSender: sends changes of beam holds to all clients as STATUS, in their order."""

import asyncio
import logging
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Final

from compute.pose.beam_hold import BeamHoldCause
from service.pipeline.beam_hold_registry import BeamHoldRegistry
from service.pipeline.frame_batch import BeamHoldState
from service.pipeline.threads import call_in_loop
from service.pipeline.transform_names import NAME_BYTES
from service.protocols.openigtlink.bodies import StatusCode
from service.protocols.openigtlink.connection import ClientConnection
from service.protocols.openigtlink.message import Message
from service.protocols.openigtlink.session import Session
from service.protocols.openigtlink.snapshot import FULL_NAME

_log = logging.getLogger(__name__)

_CODES: Final = {
    BeamHoldCause.NO_DATA: StatusCode.NOT_PRESENT,
    BeamHoldCause.MOVED: StatusCode.OVERFLOW,
    BeamHoldCause.SETTLING: StatusCode.NOT_READY,
    BeamHoldCause.LATCHED: StatusCode.MANUAL_MODE,
    BeamHoldCause.CLOCK: StatusCode.UNKNOWN_ERROR,
}
"""Of a beam that is held; only one that is not has OK."""


class BeamHoldStatusSender:
    """Beam holds as clients see them; used in one event loop, but for what the board calls."""

    def __init__(
        self,
        board: BeamHoldRegistry,
        device: str | None,
        clients: Callable[[], Iterable[ClientConnection]],
    ) -> None:
        self._board = board
        self._device = device
        self._clients = clients
        self._changes: deque[tuple[BeamHoldState, bool]] = deque()
        self._now: dict[str, BeamHoldState] = {}
        self._end: Callable[[], None] | None = None

    def start(self) -> None:
        """Send changes from now on."""
        self._loop = asyncio.get_running_loop()
        self._end = self._board.listen(self._changed)

    def close(self) -> None:
        """Send no more changes."""
        if self._end is not None:
            self._end()

    def greet(self, client: ClientConnection) -> None:
        """Send the states of all holds to a client that is new or has missed some changes."""
        self._tell_all((client,))

    def repeat(self) -> None:
        """Send the states of all holds to all clients, so that silence is informative."""
        self._tell_all(tuple(self._clients()))

    def answer(self, session: Session, name: str) -> Message | None:
        """Return the STATUS of a hold by its name on the wire; None: there is no such hold."""
        if not self._queue_changes():
            if name not in map(_short, self._now):
                return None
            return session.status(StatusCode.UNKNOWN_ERROR, "UNKNOWN", "it is not known", name)
        for now in self._now.values():
            if _short(now.hold_id) == name:
                return self._message(session, now)
        return None

    def _changed(self, device_id: str, now: BeamHoldState, last: bool) -> None:
        """Queue a change of a hold; called in any thread."""
        if self._device not in (None, device_id):
            return
        self._changes.append((now, last))
        call_in_loop(self._loop, self._queue_changes)

    def _tell_changes(self) -> None:
        changes = []
        while self._changes:
            changes.append(self._changes.popleft())
        for index, (now, last) in enumerate(changes):
            newer = (one for one, _ in changes[index + 1 :] if one.hold_id == now.hold_id)
            if not now.held and any(newer):
                # The beam is held again already: what was not told in time is not told.
                continue
            self._now[now.hold_id] = now
            for client in tuple(self._clients()):
                client.send_beam_hold(self._message(client.session, now))
            if last:
                del self._now[now.hold_id]

    def _queue_changes(self) -> bool:
        """Hold beams past their deadline, and send the changes; False: the check failed."""
        try:
            self._board.check()
        except Exception:  # noqa: BLE001 - clients are told nothing, and hold
            _log.exception("OpenIGTLink: beam holds could not be checked")
            return False
        # Now, and not when the loop comes to it: what is told after it is newer.
        self._tell_changes()
        return True

    def _tell_all(self, clients: Iterable[ClientConnection]) -> None:
        if self._queue_changes():
            for client in clients:
                for now in self._now.values():
                    client.send_beam_hold(self._message(client.session, now))

    def _message(self, session: Session, now: BeamHoldState) -> Message:
        """Return a hold's STATUS; names that are cut to the same are never OK."""
        now = now.standing
        name = _short(now.hold_id)
        same = sorted(one for one in self._now if _short(one) == name)
        if len(same) > 1:
            text = (
                f'the names of the holds {", ".join(same)} are cut to the same "{name}": a name '
                f"has {NAME_BYTES} bytes; give them shorter ids"
            )
            status = session.status(StatusCode.CONFIGURATION_ERROR, "NotSent", text, name)
        elif now.held:
            code = _CODES.get(now.cause, StatusCode.UNKNOWN_ERROR)
            word = now.cause.value.replace("-", "_").upper()
            status = session.status(code, word, now.reason or now.cause.value, name)
        else:
            status = session.status(StatusCode.OK, "OK", "the beam may go on", name)
        cut = name != now.hold_id and len(same) < 2 and session.version > 1
        metadata = {FULL_NAME: now.hold_id} if cut else {}
        # When it was said: who reads it much later reads what is not so any more.
        return replace(status, time_ns=time.time_ns(), metadata=metadata)


def _short(hold_id: str) -> str:
    return hold_id[:NAME_BYTES]
