"""Client: a server's resources and streams, for programs that wait."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

import httpx

from lumiline.client import calls
from lumiline.client import documents as d
from lumiline.client.calls import PAGE, Call, Readings, Vector3
from lumiline.client.errors import NotReached, UnreadableMessage, problem_of
from lumiline.client.server import KeyBy, Server
from lumiline.client.stream import Stream
from lumiline.client.stream_state import Content, Mode, StreamWish, begun

T = TypeVar("T")


class Client:
    """A connection to a server; a context manager that closes it.

    ``ServerProblem`` is raised where the server refuses, with its reason, ``NotReached`` where it
    does not answer.
    """

    def __init__(
        self,
        url: str = "http://127.0.0.1:8000",
        key: str | None = None,
        *,
        key_by: KeyBy = "header",
        timeout_s: float = 30.0,
    ) -> None:
        """Make a client; nothing is sent yet.

        Args:
            url: of the server.
            key: an API key, or a token; None: none is needed.
            key_by: how a stream carries the key: ``header``, or ``subprotocol`` as browsers do.
            timeout_s: how long an answer is waited for [s]; calibrations from live poses take
                their own time besides.
        """
        self._server = Server(url, key, key_by)
        self._timeout_s = timeout_s
        self._http = httpx.Client(
            base_url=self._server.url, headers=self._server.headers, timeout=timeout_s
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections; streams have their own."""
        self._http.close()

    def request(
        self,
        method: str,
        path: str,
        *,
        query: Mapping[str, Any] | None = None,
        body: Any = None,
        timeout_s: float | None = None,
    ) -> Any:
        """Return the JSON that the server answers to any request of its interface.

        Raises:
            ServerProblem: it refused.
            NotReached: it did not answer.
            UnreadableMessage: what it answered is no JSON.
        """
        try:
            answer = self._http.request(
                method,
                path,
                params=None if query is None else dict(query),
                json=body,
                timeout=self._timeout_s if timeout_s is None else timeout_s,
            )
        except httpx.TransportError as error:
            raise NotReached(f"{method} {path}: {error or type(error).__name__}") from error
        if not answer.is_success:
            retry_after = answer.headers.get("Retry-After")
            raise problem_of(answer.status_code, answer.content, retry_after)
        if not answer.content:
            return None
        try:
            return answer.json()
        except ValueError as error:
            raise UnreadableMessage(f"{method} {path} did not answer JSON") from error

    def _one(self, call: Call[T], longer_s: float = 0.0) -> T:
        answer = self.request(
            call.method,
            call.path,
            query=call.parameters,
            body=call.body,
            timeout_s=self._timeout_s + longer_s,
        )
        return call.read(answer)

    def _all(self, call: Call[T]) -> list[T]:
        found: list[T] = []
        while True:
            query = {**call.parameters, "limit": PAGE, "offset": len(found)}
            items, total = call.items(self.request("GET", call.path, query=query))
            found += items
            if not items or len(found) >= total:
                return found

    def devices(self) -> list[d.Device]:
        """All devices."""
        return self._all(calls.devices())

    def device(self, device_id: str) -> d.Device:
        """One device."""
        return self._one(calls.device(device_id))

    def device_status(self, device_id: str) -> d.DeviceStatus:
        """What a device is doing."""
        return self._one(calls.device_status(device_id))

    def start_device(self, device_id: str) -> d.DeviceStatus:
        """Start a device."""
        return (self._one(calls.start_device(device_id))).status

    def stop_device(self, device_id: str) -> d.DeviceStatus:
        """Stop a device."""
        return (self._one(calls.stop_device(device_id))).status

    def calibrations(
        self, device_id: str | None = None, state: str | None = None
    ) -> list[d.Calibration]:
        """Calibrations, of a device, in a state, newest first."""
        return self._all(calls.calibrations(device_id, state))

    def calibration(self, calibration_id: str) -> d.Calibration:
        """One calibration."""
        return self._one(calls.calibration(calibration_id))

    def activate(self, calibration_id: str, expected: str | None = None) -> d.Calibration:
        """Make a calibration the active one; only if ``expected`` is active, where it is given."""
        return self._one(calls.activate(calibration_id, expected))

    def roll_back(self, device_id: str, expected: str | None = None) -> d.Device:
        """Go back to the calibration and table that were active before."""
        return self._one(calls.roll_back(device_id, expected))

    def tools(self, device_id: str | None = None) -> list[d.Tool]:
        """Tools, of a device."""
        return self._all(calls.tools(device_id))

    def tool(self, tool_id: str) -> d.Tool:
        """One tool."""
        return self._one(calls.tool(tool_id))

    def create_tool(
        self, tool_id: str, device_id: str, markers_mm: Sequence[Vector3], **members: Any
    ) -> d.Tool:
        """Make a tool of known geometry; ``members`` as in the body of POST /api/v1/tools."""
        return self._one(calls.create_tool(tool_id, device_id, markers_mm, members))

    def delete_tool(self, tool_id: str) -> None:
        """Delete a tool."""
        self.request("DELETE", calls.tool(tool_id).path)

    def tool_pose(self, tool_id: str, frame: str | None = None) -> d.Pose:
        """The newest pose of a tool, in its reference's frame or another."""
        return self._one(calls.tool_pose(tool_id, frame))

    def calibrate_pivot(
        self, tool_id: str, seconds: float = 10.0, *, apply: bool = True
    ) -> d.ToolCalibration:
        """Find a tool's tip, from its poses of the next seconds about a fixed point."""
        call = calls.calibrate_tool(tool_id, "pivot", seconds, apply=apply)
        return self._one(call, seconds)

    def calibrate_spin(
        self, tool_id: str, seconds: float = 10.0, *, apply: bool = True
    ) -> d.ToolCalibration:
        """Find a tool's axis, from its poses of the next seconds about it."""
        call = calls.calibrate_tool(tool_id, "spin", seconds, apply=apply)
        return self._one(call, seconds)

    def registrations(self, device_id: str | None = None) -> list[d.Registration]:
        """Registrations, of a device, newest first."""
        return self._all(calls.registrations(device_id))

    def registration(self, registration_id: str) -> d.Registration:
        """One registration."""
        return self._one(calls.registration(registration_id))

    def register(
        self,
        registration_id: str,
        device_id: str,
        pairs: Mapping[str, tuple[Sequence[float], Sequence[float] | d.MeasuredPoint]],
        targets: Mapping[str, Sequence[float]] | None = None,
        **members: Any,
    ) -> d.Registration:
        """Find where a frame lies.

        Args:
            registration_id: the frame's name.
            device_id: the device.
            pairs: by name: a point's place in the frame, and where it was measured [mm], which
                ``measure_point`` tells with its covariance.
            targets: by name: places in the frame at which the error is asked for [mm].
            members: others of the body of POST /api/v1/registrations.
        """
        return self._one(calls.register(registration_id, device_id, pairs, targets or {}, members))

    def register_markers(
        self, registration_id: str, device_id: str, **members: Any
    ) -> d.Registration:
        """Find where the frame of three markers lies: M1 its origin, M2 on x, M3 at positive y.

        Args:
            registration_id: the frame's name.
            device_id: the device.
            members: others of the body of POST /api/v1/registrations: ``measured_mm`` and
                ``measured_sigma_mm``, or ``strobe_markers`` that are held still now.
        """
        call = calls.register_markers(registration_id, device_id, members)
        return self._one(call, float(members.get("seconds", 1.0)))

    def register_surface(
        self,
        registration_id: str,
        device_id: str,
        parent_id: str,
        points_mm: Sequence[Sequence[float]],
        surface_mm: Sequence[Sequence[float]],
        triangles: Sequence[Sequence[int]] | None = None,
        **members: Any,
    ) -> d.Registration:
        """Refine a registration by points measured on a surface.

        Args:
            registration_id: the new frame's name.
            device_id: the device.
            parent_id: the registration that is refined.
            points_mm: where the points were measured [mm].
            surface_mm: vertices of the surface in the frame, or points of it [mm].
            triangles: numbers of three vertices each; None: the surface is given as points.
            members: others of the body of POST /api/v1/registrations.
        """
        surface = calls.mesh(surface_mm, triangles)
        call = calls.register_surface(
            registration_id, device_id, parent_id, points_mm, surface, members
        )
        return self._one(call, 60.0)

    def measure_point(
        self,
        tool_id: str,
        *,
        frame: str | None = None,
        name: str | None = None,
        timeout_s: float = 30.0,
        **members: Any,
    ) -> d.MeasuredPoint:
        """Wait until a tool's tip is held still; return where, to be ``measured`` in ``register``.

        Args:
            tool_id: the tool.
            frame: ``tracker``, a tool, or a registration; None: the tool's reference.
            name: of the point, for the answer.
            timeout_s: how long is waited [s].
            members: others of the body of POST /api/v1/tools/ID/points.
        """
        call = calls.measure_point(tool_id, frame, name, timeout_s, members)
        return self._one(call, timeout_s)

    def frames(self, device_id: str) -> d.Frames:
        """A device's frames, and whether they are connected now."""
        return self._one(calls.frames(device_id))

    def transform(self, device_id: str, frame: str, to: str = "tracker") -> d.FrameTransform:
        """The transform from one frame to another now, or why there is none."""
        return self._one(calls.transform(device_id, frame, to))

    def holds(self, device_id: str | None = None) -> list[d.Hold]:
        """Beam holds, of a device."""
        return self._all(calls.holds(device_id))

    def hold(self, hold_id: str) -> d.Hold:
        """One beam hold."""
        return self._one(calls.hold(hold_id))

    def create_hold(
        self,
        hold_id: str,
        device_id: str,
        watch: Mapping[str, Any],
        limits: Mapping[str, Any],
        **members: Any,
    ) -> d.Hold:
        """Make a beam hold; ``members`` as in the body of POST /api/v1/holds."""
        return self._one(calls.create_hold(hold_id, device_id, watch, limits, members))

    def change_hold(self, hold_id: str, **members: Any) -> d.Hold:
        """Change a beam hold; ``members`` as in the body of PATCH /api/v1/holds/ID."""
        return self._one(calls.change_hold(hold_id, members))

    def delete_hold(self, hold_id: str) -> None:
        """Delete a beam hold."""
        self.request("DELETE", calls.hold(hold_id).path)

    def hold_state(self, hold_id: str) -> d.HoldState:
        """Whether a beam is held now; to act on it, take the stream's content ``holds``."""
        return self._one(calls.hold_state(hold_id))

    def set_hold_reference(
        self,
        hold_id: str,
        frames: int = 100,
        timeout_s: float = 10.0,
        given: Mapping[str, Any] | None = None,
    ) -> d.Hold:
        """Say that all is where it is to be: the mean of the next frames, or what is given."""
        call = calls.set_hold_reference(hold_id, frames, timeout_s, given)
        return self._one(call, timeout_s)

    def remove_hold_reference(self, hold_id: str) -> d.Hold:
        """Hold the beam until there is another reference."""
        return self._one(calls.remove_hold_reference(hold_id))

    def acknowledge_hold(self, hold_id: str) -> d.HoldState:
        """Let a latched hold end, once all is back."""
        return self._one(calls.acknowledge_hold(hold_id))

    def reconstruct(
        self, device_id: str, points: Mapping[str, Readings], calibration_id: str | None = None
    ) -> d.Reconstruction:
        """Compute points from readings, by name and sensor."""
        return self._one(calls.reconstruct(device_id, points, calibration_id))

    def reconstructions(self, device_id: str | None = None) -> list[d.Answer]:
        """Reconstructions without their points, newest first."""
        return self._all(calls.reconstructions(device_id))

    def recordings(self, device_id: str | None = None) -> list[d.Recording]:
        """Recordings, of a device, the newest first."""
        return self._all(calls.recordings(device_id))

    def recording(self, name: str) -> d.Recording:
        """One recording."""
        return self._one(calls.recording(name))

    def start_recording(
        self, device_id: str, name: str | None = None, seconds: float | None = None
    ) -> d.Recording:
        """Record a running device from its next frame on."""
        return self._one(calls.start_recording(device_id, name, seconds))

    def stop_recording(self, name: str) -> d.Recording:
        """End a recording."""
        return self._one(calls.stop_recording(name))

    def download_recording(self, name: str, path: Path | str) -> Path:
        """Write a recording that is complete to a file, which is there only when it is whole.

        Raises:
            ServerProblem: there is no such recording, or it is still written.
            NotReached: the connection was lost before the end.
        """
        return self._download(calls.recording_file(name), path, f"recording {name}")

    def start_export(
        self, recording: str, device_id: str, file_format: str, **members: Any
    ) -> d.Run:
        """Have points, tracks and tool poses of a recording written to a file on the server.

        Args:
            recording: its name.
            device_id: whose tools are followed, as its settings of tracking say.
            file_format: ``c3d``, ``trc``, ``csv``, ``parquet`` or ``igs.mha``.
            members: others of the request, such as ``result_id``, ``tools``, ``calibration``.

        Returns:
            The run, for ``wait_for_run``; its ``result_id`` is then the export's id.
        """
        return self._one(calls.start_export(recording, device_id, file_format, members))

    def run(self, run_id: str) -> d.Run:
        """How far a run is: of an export, a calibration or a map."""
        return self._one(calls.run(run_id))

    def wait_for_run(self, run_id: str, timeout_s: float = 600.0, every_s: float = 0.2) -> d.Run:
        """Return a run when it has ended, in whatever way, or as it is after so long."""
        end = time.monotonic() + timeout_s
        while not (found := self.run(run_id)).ended and time.monotonic() < end:
            time.sleep(every_s)
        return found

    def cancel_run(self, run_id: str) -> d.Run:
        """End a run that waits or is computed."""
        return self._one(calls.cancel_run(run_id))

    def exports(self) -> list[d.Export]:
        """Files that export runs have made."""
        return self._all(calls.exports())

    def export(self, export_id: str) -> d.Export:
        """One of them."""
        return self._one(calls.export(export_id))

    def download_export(self, export_id: str, path: Path | str) -> Path:
        """Write an export to a file, which is there only when it is whole.

        Raises:
            ServerProblem: there is no such export.
            NotReached: the connection was lost before the end.
        """
        return self._download(calls.export_file(export_id), path, f"export {export_id}")

    def delete_export(self, export_id: str) -> None:
        """Delete a file that an export run has made."""
        self.request("DELETE", calls.export(export_id).path)

    def _download(self, source: str, path: Path | str, what: str) -> Path:
        path = Path(path)
        part = path.with_name(f"{path.name}.part")
        try:
            with self._http.stream("GET", source) as answer:
                if not answer.is_success:
                    raise problem_of(answer.status_code, answer.read())
                with part.open("wb") as file:
                    for piece in answer.iter_bytes():
                        file.write(piece)
            part.replace(path)
        except httpx.TransportError as error:
            raise NotReached(f"{what}: {error or type(error).__name__}") from error
        finally:
            part.unlink(missing_ok=True)
        return path

    def stream(
        self,
        device_id: str,
        content: Sequence[Content] = ("points",),
        *,
        mode: Mode = "live",
        rate_hz: float | None = None,
        bundle_ms: float | None = None,
        resume: tuple[str, int] | None = None,
        reconnect_s: float = 30.0,
    ) -> Stream:
        """Return what a device measures, as it comes.

        Args:
            device_id: the device.
            content: what frames hold: ``points``, ``peaks``, ``tracks``, ``tools``,
                ``holds``; ``status``: no frames.
            mode: ``live``: what is new; ``lossless``: every message, also over lost connections.
            rate_hz: at most so many frames a second.
            bundle_ms: frames of so many ms sent together.
            resume: with ``lossless``: the stream's id, of ``hello``, and the number of the last
                message that the program has, to go on after it.
            reconnect_s: how long a lost connection is tried again [s].
        """
        wish = StreamWish(device_id, tuple(content), mode, rate_hz, bundle_ms)
        return Stream(begun(self._server, wish, resume, reconnect_s), self._timeout_s)
