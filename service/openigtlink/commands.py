"""What clients may command, in the words of PLUS: versions, names, recordings, transforms."""

import logging
import re
from collections.abc import Awaitable, Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import LumilineError
from service.openigtlink.command_xml import Asked, Reply
from service.openigtlink.errors import CommandRefused
from service.openigtlink.host import Caller, Host
from service.openigtlink.snapshot import Snapshot
from service.openigtlink.transforms import (
    NamedTransform,
    Transforms,
    read_date,
    read_error,
    read_matrix,
    read_name,
    written,
)
from service.version import package_version

_log = logging.getLogger(__name__)

_PROTOCOL: Final = "3"
_NOT_ALLOWED: Final = (
    "commands that change something are refused: there is no telling who sends them; the setting "
    "openigtlink_changes allows them"
)
_ID_CHARACTERS: Final = 63
_FILE: Final = re.compile(r"[^A-Za-z0-9_-]+")
Array = NDArray[np.float64]
_Do = Callable[[Asked], Awaitable[Reply]]


class Commands:
    """Runs commands, one at a time for each client.

    Args:
        host: the application.
        newest: returns the newest poses.
        changes: whether clients may change anything.
    """

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

    async def run(self, asked: Asked, address: str) -> Reply:
        """Do what is asked, and write changes and refusals into the audit log; never raises.

        Args:
            asked: the command.
            address: of the client.
        """
        name = asked.name.lower()
        reading = self._reading.get(name)
        if reading is not None:
            return await _tried(reading, asked)
        changing = self._changing.get(name)
        if changing is None:
            return Reply(
                done=False,
                message=f'there is no command "{asked.name[:100]}"; there are Version, '
                "RequestChannelIds, RequestDeviceIds, GetTransform, GetConfiguration, SaveConfig, "
                "StartRecording, StopRecording and UpdateTransform",
            )
        operation, do = changing
        caller = Caller(address, operation)
        if not self._changes:
            await self._host.audit(caller, "refused", _NOT_ALLOWED)
            return Reply(done=False, message=_NOT_ALLOWED)
        reply = await _tried(do, asked)
        await self._host.audit(caller, "done" if reply.done else "refused", reply.message)
        return reply

    async def _version(self, _: Asked) -> Reply:
        version = f"Lumiline {package_version()}"
        values = {
            # PLUS's own name for it, too: its clients ask by it.
            "PlusVersion": version,
            "Version": version,
            "IGTLProtocolVersion": _PROTOCOL,
            "IGTLHeaderVersion": "2",
        }
        return Reply(done=True, message=version, values=values)

    async def _channels(self, _: Asked) -> Reply:
        device = self._device()
        return Reply(done=True, message=device, values={device: device})

    async def _devices(self, _: Asked) -> Reply:
        found = list(await self._host.devices())
        return Reply(done=True, message=",".join(found), values={one: one for one in found})

    async def _get_transform(self, asked: Asked) -> Reply:
        name = read_name(_required(asked, "TransformName"))
        tracked = self._tracked(name)
        if tracked is not None:
            return Reply(
                done=True,
                message=f"GetTransform ({name}): {written(tracked)}",
                values={name: written(tracked), "persistent": "false"},
            )
        found = self._transforms.find(name)
        if found is None:
            raise CommandRefused(f"GetTransform ({name}): no such transform, or it is not seen now")
        values = {name: written(found.matrix), "persistent": "false"}
        if found.error is not None:
            values["error"] = f"{found.error:g}"
        if found.date is not None:
            values["date"] = found.date
        text = f"GetTransform ({name}): {written(found.matrix)}"
        return Reply(done=True, message=text, values=values)

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

    async def _configuration(self, _: Asked) -> Reply:
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
        return Reply(done=True, message=text, values=values)

    async def _save_configuration(self, asked: Asked) -> Reply:
        if asked.attributes.get("Filename"):
            raise CommandRefused("SaveConfig: this server writes no files for clients")
        return Reply(done=True, message="every change is kept when it is made; nothing to save")

    async def _start_recording(self, asked: Asked) -> Reply:
        wanted = asked.attributes.get("OutputFilename")
        name = None if not wanted else file_name(wanted)
        begun = await self._host.start_recording(self._wanted(asked), name)
        text = f"StartRecording successful: {begun}"
        return Reply(done=True, message=text, values={"OutputFilename": begun})

    async def _stop_recording(self, asked: Asked) -> Reply:
        told = await self._host.stop_recording(self._wanted(asked))
        return Reply(done=True, message=f"StopRecording successful: {told}")

    async def _set_transform(self, asked: Asked) -> Reply:
        name = read_name(_required(asked, "TransformName"))
        snapshot = self._newest()
        if snapshot is not None and (snapshot.find(name) or snapshot.find_inverse(name)):
            raise CommandRefused(f"UpdateTransform ({name}): it is tracked, and cannot be set")
        found = NamedTransform(
            read_matrix(_required(asked, "TransformValue")),
            read_error(asked.attributes.get("TransformError")),
            read_date(asked.attributes.get("TransformDate")),
        )
        self._transforms.set(name, found)
        warning = ""
        if asked.attributes.get("TransformPersistent", "TRUE").upper() != "FALSE":
            warning = " WARNING: it is kept until the server ends."
        text = f"UpdateTransform ({name}) completed successfully{warning}"
        return Reply(done=True, message=text)

    def _wanted(self, asked: Asked) -> str:
        """Return the device that is asked for, by whichever of PLUS's names; else the one."""
        found = asked.attributes.get("CaptureDeviceId") or asked.attributes.get("ChannelId")
        if found is not None and len(found) > _ID_CHARACTERS:
            raise CommandRefused(f"a device's id has at most {_ID_CHARACTERS} characters")
        return found or self._device()

    def _device(self) -> str:
        snapshot = self._newest()
        if snapshot is None:
            raise CommandRefused("no device with tools runs now")
        return snapshot.entry.device_id


def file_name(wanted: str) -> str:
    """Return the name of a recording for what a client calls it: no folders, and our suffix."""
    last = wanted.replace("\\", "/").rpartition("/")[2]
    stem = last.rpartition(".")[0] or last
    cleaned = _FILE.sub("-", stem).strip("-_")[:90]
    if not cleaned:
        raise CommandRefused(f'OutputFilename "{wanted[:100]}" has no letter or digit in it')
    return f"{cleaned}.h5"


def _required(asked: Asked, name: str) -> str:
    found = asked.attributes.get(name)
    if not found:
        raise CommandRefused(f"{asked.name} needs the attribute {name}")
    return found


async def _tried(do: _Do, asked: Asked) -> Reply:
    try:
        return await do(asked)
    except LumilineError as error:
        return Reply(done=False, message=error.detail)
    except Exception:  # noqa: BLE001 - a fault of one command ends no connection
        _log.exception("OpenIGTLink command %s failed", asked.name[:100])
        return Reply(done=False, message=f"{asked.name[:100]} failed; the server's log says why")
