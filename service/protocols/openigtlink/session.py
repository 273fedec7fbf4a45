"""Session: state of one client: header version, subscriptions, what it was sent."""

from dataclasses import dataclass, field
from typing import Final, Literal

from compute.pose.rigid_body import PoseStatus
from service.protocols.openigtlink.bodies import StatusCode, write_status
from service.protocols.openigtlink.message import BadMessage, Header, Message, write_message
from service.protocols.openigtlink.snapshot import Snapshot

Kind = Literal["TRANSFORM", "POSITION", "TDATA", "QTDATA"]
SERVER: Final = "Lumiline"
"""Name of messages that are of no tool."""

LANDMARKS: Final = "Landmarks"
"""Name of what is said of them."""

_EARLY: Final = 1e-4
"""How much too early a frame may be for the least time between two [s]."""

_CODES: Final = {
    PoseStatus.OK: StatusCode.OK,
    PoseStatus.MISSING: StatusCode.NOT_PRESENT,
    PoseStatus.OUT_OF_VIEW: StatusCode.NOT_PRESENT,
    PoseStatus.OUT_OF_VOLUME: StatusCode.OVERFLOW,
    PoseStatus.INVALID: StatusCode.UNKNOWN_ERROR,
    PoseStatus.HIGH_ERROR: StatusCode.UNKNOWN_ERROR,
    PoseStatus.LOW_RELIABILITY: StatusCode.UNKNOWN_ERROR,
    PoseStatus.UNKNOWN: StatusCode.NOT_READY,
}


@dataclass
class Subscription:
    """One kind of message that a client gets of each frame.

    Args:
        interval_s: least time between two frames [s].
        device: name of the messages, where they are of all tools.
        frame: coordinate system; empty: each tool's own.
        due_s: before when nothing more is sent, on the loop's clock [s].
    """

    interval_s: float = 0.0
    device: str = ""
    frame: str = ""
    due_s: float = 0.0


@dataclass
class Session:
    """One client, as far as the protocol goes.

    Args:
        address: of the client.
        version: of the headers that it is sent: 1 until it has sent 2.
        wanted: what it gets of each frame; TRANSFORM without asking.
    """

    address: str
    version: int = 1
    subscriptions: dict[Kind, Subscription] = field(
        default_factory=lambda: {"TRANSFORM": Subscription()}
    )
    _last_statuses: dict[str, PoseStatus] = field(default_factory=dict)
    _refused: dict[str, str] = field(default_factory=dict)
    _stale: bool = False
    _landmarks: tuple[str, str | None, str | None] | None = None
    """Device, calibration and table that landmarks which the client has were given with."""

    def received(self, header: Header | Message) -> None:
        """Take note of a message's header."""
        self.version = max(self.version, header.version)

    def frame(self, snapshot: Snapshot, now_s: float, *, invalid: bool) -> bytes:
        """Return all that the client is to get of a frame."""
        parts = [write_message(message) for message in self._statuses(snapshot)]
        for kind, subscription in list(self.subscriptions.items()):
            if now_s + _EARLY < subscription.due_s:
                continue
            subscription.due_s = now_s + subscription.interval_s
            if kind == "TRANSFORM" or kind == "POSITION":
                parts.append(snapshot.encoded(kind, self.version, invalid=invalid))
                continue
            try:
                tracking = snapshot.tracking(
                    kind, self.version, subscription.device, subscription.frame
                )
                parts.append(write_message(tracking))
            except BadMessage as error:  # the frame has been taken away
                del self.subscriptions[kind]
                parts.append(self.status_bytes(StatusCode.NOT_FOUND, "NoFrame", error.detail))
        return b"".join(parts)

    def landmarks_sent(self, snapshot: Snapshot) -> None:
        """Take note that the client has landmarks, with what is active in a frame."""
        self._landmarks = _in_force(snapshot)

    def stale(self, device_id: str, age_s: float) -> bytes:
        """Return the STATUS for when no frame comes in time; nothing if the client knows."""
        if self._stale:
            return b""
        self._stale = True
        text = (
            f"the newest frame of device {device_id} is {age_s:.1f} s old: the device has stopped, "
            "or the server does not keep up"
        )
        return self.status_bytes(StatusCode.TIME_OUT, "NoFrames", text)

    def status_bytes(self, code: StatusCode, name: str, text: str, device: str = SERVER) -> bytes:
        """Return a STATUS."""
        return write_message(self.status(code, name, text, device))

    def status(self, code: StatusCode, name: str, text: str, device: str = SERVER) -> Message:
        """Return a STATUS as a message."""
        content = write_status(code, name, text)
        return Message("STATUS", device, content, version=self.version)

    def pose_status(self, snapshot: Snapshot, name: str) -> Message | None:
        """Return the STATUS of one tool, now; None: there is no tool of the name."""
        pose = snapshot.find(name)
        if pose is None:
            return None
        text = pose.reason or ("" if pose.valid else pose.status.value)
        return self.status(_CODES[pose.status], pose.status.value, text, pose.name.short)

    def _statuses(self, snapshot: Snapshot) -> list[Message]:
        """Return STATUS messages for what has changed since the client was told last."""
        messages = []
        if self._stale:
            self._stale = False
            messages.append(self.status(StatusCode.OK, "OK", "frames come again"))
        if snapshot.naming.refused != self._refused:
            self._refused = dict(snapshot.naming.refused)
            messages += [
                self.status(StatusCode.CONFIGURATION_ERROR, "NotSent", f"tool {tool}: {why}")
                for tool, why in self._refused.items()
            ]
        if self._landmarks is not None and self._landmarks != _in_force(snapshot):
            self._landmarks = None
            text = (
                "another calibration or correction table is active than when landmarks were "
                "asked for: those do not hold any more; ask again"
            )
            messages.append(self.status(StatusCode.UNKNOWN_ERROR, "INVALID", text, LANDMARKS))
        now = {}
        for pose in snapshot.poses:
            name, status = pose.name.short, pose.status
            now[name] = status
            before = self._last_statuses.get(name, PoseStatus.OK)
            if status is not before:
                text = pose.reason or ("tracked again" if pose.valid else status.value)
                messages.append(self.status(_CODES[status], status.value, text, name))
        messages += [
            self.status(StatusCode.NOT_FOUND, "NotSent", f"{name} is not sent any more", name)
            for name in self._last_statuses
            if name not in now
        ]
        self._last_statuses = now
        return messages


def _in_force(snapshot: Snapshot) -> tuple[str, str | None, str | None]:
    entry = snapshot.entry
    return entry.device_id, entry.calibration_id, entry.table_id
