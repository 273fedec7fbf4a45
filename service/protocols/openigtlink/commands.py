"""Commands of clients as PLUS defines them, in XML: versions, names, recordings, transforms."""

import logging
import re
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from typing import Final
from xml.etree.ElementTree import ParseError
from xml.sax.saxutils import quoteattr

import numpy as np
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring
from numpy.typing import NDArray

from compute.errors import LumilineError
from service.protocols.openigtlink.host import Host, Outcome
from service.protocols.openigtlink.message import CommandRefused
from service.protocols.openigtlink.snapshot import Snapshot
from service.protocols.openigtlink.transforms import (
    NamedTransform,
    Transforms,
    read_date,
    read_error,
    read_matrix,
    read_name,
    write_matrix,
)
from service.version import package_version

_MAX_CHARACTERS: Final = 200
_NOT_XML: Final = re.compile("[^\t\n\r -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


@dataclass(frozen=True)
class CommandRequest:
    """A command."""

    name: str
    attributes: Mapping[str, str]


@dataclass(frozen=True)
class CommandReply:
    """The answer to a command."""

    done: bool
    message: str
    values: Mapping[str, str] = field(default_factory=dict)


def read_command_request(name: str, text: str) -> CommandRequest:
    """Return the command that a text is.

    Args:
        name: what is to be done, where the message says so; else the element's ``Name`` does.
        text: ``<Command Name="..." .../>``; empty: no attributes.

    Raises:
        CommandRefused: it is no XML, declares entities or a document type, or is another element.
    """
    if not text.strip("\0 \t\r\n"):
        if not name:
            raise CommandRefused("a command without a name")
        return CommandRequest(name, {})
    try:
        element = fromstring(text.rstrip("\0"), forbid_dtd=True)
    except (ParseError, DefusedXmlException, ValueError) as error:
        raise CommandRefused(
            f"the command is not XML that is read here: {error}"[:_MAX_CHARACTERS]
        ) from None
    if element.tag.lower() != "command":
        raise CommandRefused(
            f"the element is <{element.tag[:_MAX_CHARACTERS]}>; it must be <Command>"
        )
    attributes = {str(key): str(value) for key, value in element.attrib.items()}
    command = name or attributes.get("Name", "")
    if not command:
        raise CommandRefused("a command without a name; give <Command Name=...>")
    return CommandRequest(command, attributes)


def write_reply(name: str | None, reply: CommandReply) -> str:
    """Return the answer as PLUS writes it."""
    text = _clean(reply.message)
    parts = ["<CommandReply"]
    if name is not None:
        parts.append(f" Name={quoteattr(_clean(name))}")
    parts.append(f' Status="{"SUCCESS" if reply.done else "FAIL"}"')
    if name is not None and not reply.done:
        parts.append(f" Error={quoteattr(text)}")
    parts.append(f" Message={quoteattr(text)}")
    parts.append("></CommandReply>" if name is not None else " />")
    return "".join(parts)


def reply_metadata(reply: CommandReply) -> dict[str, str]:
    """Return what PLUS says of an answer in metadata, too."""
    attributes = {"Status": "SUCCESS" if reply.done else "FAIL", "Message": reply.message}
    if not reply.done:
        attributes["Error"] = reply.message
    return attributes | dict(reply.values)


def _clean(text: str) -> str:
    """Return a text without what XML cannot have."""
    return _NOT_XML.sub("?", text)


_log = logging.getLogger(__name__)

_PROTOCOL: Final = "3"
_NOT_ALLOWED: Final = (
    "commands that change something are refused: there is no telling who sends them; the setting "
    "openigtlink_changes allows them"
)
_ID_CHARACTERS: Final = 63
_FILE: Final = re.compile(r"[^A-Za-z0-9_-]+")
Array = NDArray[np.float64]
_Do = Callable[[CommandRequest], Awaitable[CommandReply]]


class Commands:
    """Runs commands, one at a time for each client."""

    def __init__(self, host: Host, newest: Callable[[], Snapshot | None], *, changes: bool) -> None:
        self._host = host
        self._newest = newest
        self._changes = changes
        self._transforms = Transforms()
        self._reading: dict[str, _Do] = {
            "version": self._version,
            "requestchannelids": self._channels,
            "requestdeviceids": self._devices,
            "requestdevicechannelids": self._channels,
            "gettransform": self._get_transform,
            "getconfiguration": self._configuration,
            "saveconfig": self._save_configuration,
        }
        self._changing: dict[str, tuple[str, _Do]] = {
            "startrecording": ("openigtlink-start-recording", self._start_recording),
            "stoprecording": ("openigtlink-stop-recording", self._stop_recording),
            "updatetransform": ("openigtlink-set-transform", self._set_transform),
        }

    async def run(self, request: CommandRequest, address: str) -> CommandReply:
        """Execute a command, and write changes and refusals into the audit log; never raises."""
        name = request.name.lower()
        reading = self._reading.get(name)
        if reading is not None:
            return await _tried(reading, request)
        changing = self._changing.get(name)
        if changing is None:
            return CommandReply(
                done=False,
                message=f'there is no command "{request.name[:100]}"; there are Version, '
                "RequestChannelIds, RequestDeviceIds, GetTransform, GetConfiguration, SaveConfig, "
                "StartRecording, StopRecording and UpdateTransform",
            )
        operation, do = changing
        if not self._changes:
            await self._host.audit(operation, address, "refused", _NOT_ALLOWED)
            return CommandReply(done=False, message=_NOT_ALLOWED)
        reply = await _tried(do, request)
        outcome: Outcome = "done" if reply.done else "refused"
        await self._host.audit(operation, address, outcome, reply.message)
        return reply

    async def _version(self, _: CommandRequest) -> CommandReply:
        version = f"Lumiline {package_version()}"
        values = {
            # PLUS's own name for it, too: its clients ask by it.
            "PlusVersion": version,
            "Version": version,
            "IGTLProtocolVersion": _PROTOCOL,
            "IGTLHeaderVersion": "2",
        }
        return CommandReply(done=True, message=version, values=values)

    async def _channels(self, _: CommandRequest) -> CommandReply:
        device = self._device()
        return CommandReply(done=True, message=device, values={device: device})

    async def _devices(self, _: CommandRequest) -> CommandReply:
        devices = list(await self._host.devices())
        return CommandReply(
            done=True, message=",".join(devices), values={one: one for one in devices}
        )

    async def _get_transform(self, request: CommandRequest) -> CommandReply:
        name = read_name(_required(request, "TransformName"))
        tracked = self._tracked(name)
        if tracked is not None:
            return CommandReply(
                done=True,
                message=f"GetTransform ({name}): {write_matrix(tracked)}",
                values={name: write_matrix(tracked), "persistent": "false"},
            )
        transform = self._transforms.find(name)
        if transform is None:
            raise CommandRefused(f"GetTransform ({name}): no such transform, or it is not seen now")
        values = {name: write_matrix(transform.matrix), "persistent": "false"}
        if transform.error is not None:
            values["error"] = f"{transform.error:g}"
        if transform.date is not None:
            values["date"] = transform.date
        text = f"GetTransform ({name}): {write_matrix(transform.matrix)}"
        return CommandReply(done=True, message=text, values=values)

    def _tracked(self, name: str) -> Array | None:
        """Return the matrix of a tracked transform, or of the inverse of one, if it is seen."""
        snapshot = self._newest()
        if snapshot is None:
            return None
        for pose, inverted in ((snapshot.find(name), False), (snapshot.find_inverse(name), True)):
            if pose is not None and pose.valid and pose.placed is not None:
                matrix = np.eye(4)
                matrix[:3, :3], matrix[:3, 3] = pose.placed
                return np.linalg.inv(matrix).astype(np.float64) if inverted else matrix
        return None

    async def _configuration(self, _: CommandRequest) -> CommandReply:
        snapshot = self._newest()
        values = {"Version": f"Lumiline {package_version()}"}
        if snapshot is not None:
            entry = snapshot.entry
            values["Device"] = entry.device_id
            values["Calibration"] = entry.calibration_id or ""
            values["FrameRateHz"] = f"{entry.frame_rate_hz:g}"
            names = (name.full for name in snapshot.naming.names.values())
            values["Transforms"] = ",".join(names)
        text = "; ".join(f"{name}={value}" for name, value in values.items())
        return CommandReply(done=True, message=text, values=values)

    async def _save_configuration(self, request: CommandRequest) -> CommandReply:
        if request.attributes.get("Filename"):
            raise CommandRefused("SaveConfig: this server writes no files for clients")
        return CommandReply(
            done=True, message="every change is kept when it is made; nothing to save"
        )

    async def _start_recording(self, request: CommandRequest) -> CommandReply:
        file_requested = request.attributes.get("OutputFilename")
        name = None if not file_requested else file_name(file_requested)
        begun = await self._host.start_recording(self._recorded_device(request), name)
        text = f"StartRecording successful: {begun}"
        return CommandReply(done=True, message=text, values={"OutputFilename": begun})

    async def _stop_recording(self, request: CommandRequest) -> CommandReply:
        stopped = await self._host.stop_recording(self._recorded_device(request))
        return CommandReply(done=True, message=f"StopRecording successful: {stopped}")

    async def _set_transform(self, request: CommandRequest) -> CommandReply:
        name = read_name(_required(request, "TransformName"))
        snapshot = self._newest()
        if snapshot is not None and (snapshot.find(name) or snapshot.find_inverse(name)):
            raise CommandRefused(f"UpdateTransform ({name}): it is tracked, and cannot be set")
        transform = NamedTransform(
            read_matrix(_required(request, "TransformValue")),
            read_error(request.attributes.get("TransformError")),
            read_date(request.attributes.get("TransformDate")),
        )
        self._transforms.set(name, transform)
        warning = ""
        if request.attributes.get("TransformPersistent", "TRUE").upper() != "FALSE":
            warning = " WARNING: it is kept until the server ends."
        text = f"UpdateTransform ({name}) completed successfully{warning}"
        return CommandReply(done=True, message=text)

    def _recorded_device(self, request: CommandRequest) -> str:
        """Return the device that is asked for, by whichever of PLUS's names; else the one."""
        device = request.attributes.get("CaptureDeviceId") or request.attributes.get("ChannelId")
        if device is not None and len(device) > _ID_CHARACTERS:
            raise CommandRefused(f"a device's id has at most {_ID_CHARACTERS} characters")
        return device or self._device()

    def _device(self) -> str:
        snapshot = self._newest()
        if snapshot is None:
            raise CommandRefused("no device with tools runs now")
        return snapshot.entry.device_id


def file_name(name: str) -> str:
    """Return the name of a recording for what a client calls it: no folders, and our suffix."""
    last = name.replace("\\", "/").rpartition("/")[2]
    stem = last.rpartition(".")[0] or last
    cleaned = _FILE.sub("-", stem).strip("-_")[:90]
    if not cleaned:
        raise CommandRefused(f'OutputFilename "{name[:100]}" has no letter or digit in it')
    return f"{cleaned}.h5"


def _required(request: CommandRequest, name: str) -> str:
    value = request.attributes.get(name)
    if not value:
        raise CommandRefused(f"{request.name} needs the attribute {name}")
    return value


async def _tried(do: _Do, request: CommandRequest) -> CommandReply:
    try:
        return await do(request)
    except LumilineError as error:
        return CommandReply(done=False, message=error.detail)
    except Exception:  # noqa: BLE001 - a fault of one command ends no connection
        _log.exception("OpenIGTLink command %s failed", request.name[:100])
        return CommandReply(
            done=False, message=f"{request.name[:100]} failed; the server's log says why"
        )
