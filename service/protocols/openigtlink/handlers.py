"""MessageHandlers: the answer to each type of message."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import LumilineError
from service.pipeline.transform_names import frame_name
from service.protocols.openigtlink.bodies import (
    Command,
    Point,
    StatusCode,
    read_command,
    read_start,
    read_string,
    write_capability,
    write_command,
    write_points,
    write_result,
    write_string,
)
from service.protocols.openigtlink.commands import (
    CommandReply,
    CommandRequest,
    Commands,
    read_command_request,
    reply_metadata,
    write_reply,
)
from service.protocols.openigtlink.counters import Counters
from service.protocols.openigtlink.host import Host, Landmark, WireTool
from service.protocols.openigtlink.message import BadMessage, CommandRefused, Message
from service.protocols.openigtlink.session import LANDMARKS, SERVER, Kind, Session, Subscription
from service.protocols.openigtlink.snapshot import Snapshot, WirePose

Array = NDArray[np.float64]

_MARKER = (255, 255, 0, 255)
_TIP = (255, 0, 0, 255)
_LANDMARK = (0, 255, 0, 255)


def find_points(
    name: str,
    snapshot: Snapshot,
    tools: Sequence[WireTool],
    landmarks: Sequence[Landmark],
) -> tuple[list[Point], list[str], bool]:
    """Return the points of a name, in the frame that poses of their tool are given in.

    Args:
        name: of a tool, its transform, ``Landmarks``, ``Markers``; empty: all.
        snapshot: the newest poses; markers of tools that are not seen have no place.
        tools: of the device.
        landmarks: likewise; those that were measured with what is not active are withheld.

    Returns:
        The points; why landmarks are withheld, each registration once; and whether there are
        landmarks that hold only as long as nothing else is active.
    """
    points: list[Point] = []
    by_id = {tool.id: tool for tool in tools}
    for pose in snapshot.poses:
        tool = by_id.get(pose.source.tool)
        names = (pose.name.short, pose.name.full, pose.source.tool, "Markers", "")
        if tool is not None and pose.valid and pose.placed is not None and name in names:
            points += _of_tool(tool, pose, pose.placed)
    active = snapshot.entry.calibration_id, snapshot.entry.table_id
    withheld: dict[str, None] = {}
    has_landmarks = False
    for one in landmarks:
        if name not in ("", "Landmarks", one.owner, one.name):
            continue
        why = None if one.provenance is None else one.provenance.invalid_reason(*active)
        if why is not None:
            withheld[why] = None
            continue
        has_landmarks = has_landmarks or one.provenance is not None
        points.append(Point(one.name, "Landmark", one.position_mm, _LANDMARK, owner=one.owner))
    return points, list(withheld), has_landmarks


def _of_tool(tool: WireTool, pose: WirePose, placed: tuple[Array, Array]) -> Iterable[Point]:
    owner = frame_name(pose.name.frame)
    if tool.markers_mm is not None:
        for number, marker in enumerate(tool.markers_mm):
            position = _transform(placed, marker)
            yield Point(f"{tool.id} marker {number}", "Marker", position, _MARKER, owner=owner)
    if tool.tip_mm is not None:
        yield Point(f"{tool.id} tip", "Tip", _transform(placed, tool.tip_mm), _TIP, owner=owner)


def _transform(placed: tuple[Array, Array], point_mm: Array) -> tuple[float, float, float]:
    rotation, translation = placed
    x, y, z = rotation @ point_mm + translation
    return float(x), float(y), float(z)


_KINDS: Final[dict[str, Kind]] = {
    "TRANS": "TRANSFORM",
    # What is left of GET_TRANSFORM in a field of 12 bytes.
    "TRANSFOR": "TRANSFORM",
    "POSITION": "POSITION",
    "TDATA": "TDATA",
    "QTDATA": "QTDATA",
}
_REQUESTS: Final = ("GET_STATUS", "GET_CAPABIL", "GET_POINT", "STRING", "COMMAND", "STATUS")
KNOWN: Final = frozenset(
    (*_REQUESTS, *(f"{prefix}_{kind}" for prefix in ("GET", "STT", "STP") for kind in _KINDS))
)
"""Types that are read; others are skipped."""
_OLD_COMMAND: Final = "CMD_"
_OLD_REPLY: Final = "ACK_"
_MAX_WITHHELD_NAMED: Final = 5
"""Registrations whose landmarks are withheld that are told of by name."""


class MessageHandlers:
    """Answers messages; what takes its time is awaited."""

    def __init__(
        self,
        host: Host,
        newest: Callable[[], Snapshot | None],
        tools: Callable[[], Sequence[WireTool]],
        counters: Counters,
        holds: Callable[[Session, str], Message | None],
        *,
        invalid: bool,
        changes: bool,
    ) -> None:
        self._host = host
        self._newest = newest
        self._tools = tools
        self._counters = counters
        self._holds = holds
        self._invalid = invalid
        self._commands = Commands(host, newest, changes=changes)

    def handle(self, session: Session, message: Message) -> Sequence[Message] | None:
        """Return the answers to a message; None: ``later`` has them.

        Raises:
            BadMessage: its content is none of its type.
        """
        prefix, _, rest = message.type.partition("_")
        kind = _KINDS.get(rest)
        if message.type in ("COMMAND", "GET_POINT") or _is_command(message):
            return None
        if message.type == "GET_STATUS":
            return [self._status(session, message)]
        if message.type == "GET_CAPABIL":
            content = write_capability(sorted(KNOWN))
            return [_answer(session, message, "CAPABILITY", content)]
        if kind is None:
            return []  # STATUS keeps a connection alive; a STRING is none of our business
        if prefix == "GET":
            return self._current(session, message, kind)
        return self._stream(session, message, kind, rest, begin=prefix == "STT")

    async def handle_slow(self, session: Session, message: Message) -> Sequence[Message]:
        """Return the answers to a message that take their time.

        Raises:
            BadMessage: its content is none of its type.
        """
        if message.type == "GET_POINT":
            return await self._points(session, message)
        if message.type == "STRING":
            reply = await self._run(session, "", read_string(message.content))
            device = f"{_OLD_REPLY}{message.device[len(_OLD_COMMAND) :]}"[:20]
            answer = _answer(session, message, "STRING", write_string(write_reply(None, reply)))
            return [replace(answer, device=device)]
        command = read_command(message.content)
        reply = await self._run(session, command.name, command.text)
        text = write_reply(command.name, reply)
        answer = _answer(
            session,
            message,
            "RTS_COMMAND",
            write_command(Command(command.number, command.name, text)),
        )
        return [replace(answer, metadata=reply_metadata(reply) if session.version > 1 else {})]

    async def _run(self, session: Session, name: str, text: str) -> CommandReply:
        try:
            request: CommandRequest = read_command_request(name, text)
            reply = await self._commands.run(request, session.address)
        except CommandRefused as error:
            reply = CommandReply(done=False, message=error.detail)
        if not reply.done:
            self._counters.commands_refused += 1
        return reply

    def _status(self, session: Session, message: Message) -> Message:
        hold = self._holds(session, message.device)
        if hold is not None:
            return hold
        snapshot = self._newest()
        if snapshot is None:
            text = "no device with tools runs now"
            return session.status(StatusCode.NOT_READY, "NotReady", text, message.device or SERVER)
        status = session.pose_status(snapshot, message.device)
        if status is not None:
            return status
        if message.device not in ("", SERVER, snapshot.entry.device_id):
            names = ", ".join(pose.name.short for pose in snapshot.poses) or "none"
            text = f'there is no transform "{message.device}"; there are: {names}'
            return session.status(StatusCode.NOT_FOUND, "NotFound", text, message.device)
        visible = sum(pose.valid for pose in snapshot.poses)
        text = (
            f"device {snapshot.entry.device_id}: {visible} of {len(snapshot.poses)} tools are seen "
            f"in frame {snapshot.entry.sequence}"
        )
        return session.status(StatusCode.OK, "OK", text, message.device or SERVER)

    def _current(self, session: Session, message: Message, kind: Kind) -> Sequence[Message]:
        """Return the newest poses; an empty body if there is none, as the protocol says."""
        snapshot = self._newest()
        nothing = [_answer(session, message, kind, b"")]
        if snapshot is None:
            return nothing
        if kind in ("TDATA", "QTDATA"):
            return [snapshot.tracking(kind, session.version, message.device or SERVER, "")]
        poses = snapshot.poses
        if message.device:
            pose = snapshot.find(message.device)
            poses = () if pose is None else (pose,)
        messages = snapshot.messages(kind, session.version, invalid=self._invalid, poses=poses)
        return messages or nothing

    def _stream(
        self, session: Session, message: Message, kind: Kind, rest: str, *, begin: bool
    ) -> Sequence[Message]:
        """Begin or stop sending a kind, and say whether that was done."""
        answers: list[Message] = []
        success = True
        if begin:
            start = read_start(message.type, message.content)
            snapshot = self._newest()
            try:
                if start.frame and kind in ("TRANSFORM", "POSITION"):
                    raise BadMessage(f"{kind} is sent in each tool's own coordinate system")
                if start.frame and snapshot is not None:
                    snapshot.poses_in(start.frame)
                device = message.device or SERVER
                session.subscriptions[kind] = Subscription(
                    start.resolution_ms / 1e3, device, start.frame
                )
            except BadMessage as error:
                success = False
                answers.append(session.status(StatusCode.NOT_FOUND, "NoFrame", error.detail))
        else:
            session.subscriptions.pop(kind, None)
        result = _answer(session, message, f"RTS_{rest}", write_result(done=success))
        return [result, *answers]

    async def _points(self, session: Session, message: Message) -> Sequence[Message]:
        """Return POINT, and a STATUS where landmarks are withheld."""
        snapshot = self._newest()
        if snapshot is None:
            return [_answer(session, message, "POINT", write_points(()))]
        device = snapshot.entry.device_id
        try:
            landmarks = await self._host.landmarks(device)
        except LumilineError as error:
            return [session.status(StatusCode.UNKNOWN_ERROR, "NoPoints", error.detail)]
        # What became active while they were read counts.
        snapshot = self._newest() or snapshot
        tools = [tool for tool in self._tools() if tool.device_id == device]
        points, withheld, has_landmarks = find_points(message.device, snapshot, tools, landmarks)
        answers = [_answer(session, message, "POINT", write_points(points))]
        if has_landmarks:
            session.landmarks_sent(snapshot)
        if withheld:
            more = len(withheld) - _MAX_WITHHELD_NAMED
            reasons = withheld[:_MAX_WITHHELD_NAMED] + [f"and {more} more"] * (more > 0)
            text = f"landmarks are withheld: {'; '.join(reasons)}"
            answers.append(session.status(StatusCode.UNKNOWN_ERROR, "INVALID", text, LANDMARKS))
        return answers


def _is_command(message: Message) -> bool:
    return message.type == "STRING" and message.device.upper().startswith(_OLD_COMMAND)


def _answer(session: Session, message: Message, kind: str, content: bytes) -> Message:
    """Return an answer: of the same name and number as what it answers."""
    return Message(
        kind,
        # What was cut, or broken, in the field of the question is not longer in that of the answer.
        message.device.encode()[:20].decode(errors="ignore"),
        content,
        version=session.version,
        number=message.number,
    )
