"""Requests as values: what is sent, and how the answer is read; the same for both clients."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Generic, TypeVar
from urllib.parse import quote

from pydantic import BaseModel, ValidationError

from lumiline.client import documents as d
from lumiline.client.errors import UnreadableMessage

T = TypeVar("T")
Model = TypeVar("Model", bound=BaseModel)
Vector3 = tuple[float, float, float]
Readings = Mapping[str, float | tuple[float, float]]
"""By sensor: a position [px], or it and its standard deviation."""

API: Final = "/api/v1"
PAGE: Final = 200


@dataclass(frozen=True)
class Call(Generic[T]):
    """One request, and the type of its answer.

    Args:
        method: of HTTP.
        path: from the server's root.
        kind: the model that the answer is read as.
        query: parameters; those that are None are left out.
        body: sent as JSON; None: nothing.
        inside: member of the answer that is wanted; None: all of it.
    """

    method: str
    path: str
    kind: type[Any]
    query: Mapping[str, Any] = field(default_factory=dict)
    body: Mapping[str, Any] | None = None
    inside: str | None = None

    @property
    def parameters(self) -> dict[str, Any]:
        """The query without what is not given."""
        return {name: value for name, value in self.query.items() if value is not None}

    def read(self, answer: Any) -> T:
        """Return what the server answered, typed.

        Raises:
            UnreadableMessage: it is something else.
        """
        found: T = _read(self.kind, answer if self.inside is None else answer[self.inside])
        return found

    def items(self, page: Any) -> tuple[list[T], int]:
        """Return the items of a page of a list, and how many there are on all pages."""
        if not isinstance(page, dict) or not isinstance(page.get("items"), list):
            raise UnreadableMessage(f"{self.path} did not answer a list")
        return [_read(self.kind, one) for one in page["items"]], int(page["total"])


def _read(kind: type[Any], answer: Any) -> Any:
    try:
        return kind.model_validate(answer)
    except ValidationError as error:
        raise UnreadableMessage(
            f"the server's answer is no {kind.__name__}: {error.errors()[0]['msg']} at "
            f"{error.errors()[0]['loc']}"
        ) from error


def _get(kind: type[Model], *path: str, inside: str | None = None, **query: Any) -> Call[Model]:
    return Call("GET", _path(*path), kind, query, inside=inside)


def _post(
    kind: type[Model], *path: str, body: Mapping[str, Any] | None = None, **query: Any
) -> Call[Model]:
    return Call("POST", _path(*path), kind, query, body)


def _path(*parts: str) -> str:
    # Names of recordings have slashes, which are part of their path.
    return "/".join([API, *(quote(part) for part in parts)])


def devices() -> Call[d.Device]:
    """All devices."""
    return _get(d.Device, "devices")


def device(device_id: str) -> Call[d.Device]:
    """One device."""
    return _get(d.Device, "devices", device_id)


def device_status(device_id: str) -> Call[d.DeviceStatus]:
    """What a device is doing."""
    return _get(d.DeviceStatus, "devices", device_id, "status", inside="status")


def start_device(device_id: str) -> Call[d.StatusAnswer]:
    """Start a device."""
    return _post(d.StatusAnswer, "devices", device_id, "start")


def stop_device(device_id: str) -> Call[d.StatusAnswer]:
    """Stop a device."""
    return _post(d.StatusAnswer, "devices", device_id, "stop")


def calibrations(device_id: str | None, state: str | None) -> Call[d.Calibration]:
    """Calibrations, newest first."""
    return _get(d.Calibration, "calibrations", device=device_id, state=state)


def calibration(calibration_id: str) -> Call[d.Calibration]:
    """One calibration."""
    return _get(d.Calibration, "calibrations", calibration_id)


def activate(calibration_id: str, expected: str | None) -> Call[d.Calibration]:
    """Make a calibration the active one."""
    return _post(d.Calibration, "calibrations", calibration_id, "activate", expected=expected)


def roll_back(device_id: str, expected: str | None) -> Call[d.Device]:
    """Go back to what was active before."""
    return _post(d.Device, "devices", device_id, "roll-back", expected=expected)


def tools(device_id: str | None) -> Call[d.Tool]:
    """Tools."""
    return _get(d.Tool, "tools", device=device_id)


def tool(tool_id: str) -> Call[d.Tool]:
    """One tool."""
    return _get(d.Tool, "tools", tool_id)


def create_tool(
    tool_id: str, device_id: str, markers_mm: Sequence[Vector3], members: Mapping[str, Any]
) -> Call[d.Tool]:
    """Make a tool of known geometry."""
    markers = [list(map(float, marker)) for marker in markers_mm]
    body = {"title": tool_id, **members, "id": tool_id, "device": device_id, "markers_mm": markers}
    return _post(d.Tool, "tools", body=body)


def tool_pose(tool_id: str, frame: str | None) -> Call[d.Pose]:
    """The newest pose of a tool."""
    return _get(d.Pose, "tools", tool_id, "pose", frame=frame)


def calibrate_tool(
    tool_id: str, kind: str, seconds: float, *, apply: bool
) -> Call[d.ToolCalibration]:
    """Pivot or spin calibration."""
    body = {"seconds": seconds, "apply": apply}
    return _post(d.ToolCalibration, "tools", tool_id, f"{kind}-calibrations", body=body)


def registrations(device_id: str | None) -> Call[d.Registration]:
    """Registrations, newest first."""
    return _get(d.Registration, "registrations", device=device_id)


def registration(registration_id: str) -> Call[d.Registration]:
    """One registration."""
    return _get(d.Registration, "registrations", registration_id)


def register(
    registration_id: str,
    device_id: str,
    pairs: Mapping[str, tuple[Sequence[float], Sequence[float] | d.MeasuredPoint]],
    targets: Mapping[str, Sequence[float]],
    members: Mapping[str, Any],
) -> Call[d.Registration]:
    """Find where a frame lies from paired points."""
    body = {
        **members,
        "id": registration_id,
        "device": device_id,
        "fiducials": [
            {"name": name, "frame_mm": list(map(float, frame)), **_measured(measured)}
            for name, (frame, measured) in pairs.items()
        ],
        "targets": [
            {"name": name, "frame_mm": list(map(float, place))} for name, place in targets.items()
        ],
    }
    return _post(d.Registration, "registrations", body=body)


def holds(device_id: str | None) -> Call[d.Hold]:
    """Beam holds."""
    return _get(d.Hold, "holds", device=device_id)


def hold(hold_id: str) -> Call[d.Hold]:
    """One beam hold."""
    return _get(d.Hold, "holds", hold_id)


def create_hold(
    hold_id: str,
    device_id: str,
    watch: Mapping[str, Any],
    limits: Mapping[str, Any],
    members: Mapping[str, Any],
) -> Call[d.Hold]:
    """Make a beam hold."""
    own = {"id": hold_id, "device": device_id, "watch": dict(watch), "limits": dict(limits)}
    return _post(d.Hold, "holds", body={"title": hold_id, **members, **own})


def change_hold(hold_id: str, members: Mapping[str, Any]) -> Call[d.Hold]:
    """Change a beam hold."""
    return Call("PATCH", _path("holds", hold_id), d.Hold, body=dict(members))


def hold_state(hold_id: str) -> Call[d.HoldState]:
    """Whether a beam is held now."""
    return _get(d.HoldState, "holds", hold_id, "state")


def set_hold_reference(
    hold_id: str, frames: int, timeout_s: float, given: Mapping[str, Any] | None
) -> Call[d.Hold]:
    """Measure a hold's reference, or give it."""
    body = {
        "frames": frames,
        "timeout_s": timeout_s,
        "given": None if given is None else dict(given),
    }
    return _post(d.Hold, "holds", hold_id, "reference", body=body)


def remove_hold_reference(hold_id: str) -> Call[d.Hold]:
    """Take a hold's reference away."""
    return Call("DELETE", _path("holds", hold_id, "reference"), d.Hold)


def acknowledge_hold(hold_id: str) -> Call[d.HoldState]:
    """Acknowledge a latched hold."""
    return _post(d.HoldState, "holds", hold_id, "acknowledge")


def _measured(given: Sequence[float] | d.MeasuredPoint) -> dict[str, Any]:
    if isinstance(given, d.MeasuredPoint):
        covariance = given.covariance_mm2
        return {"measured_mm": given.position_mm, "measured_covariance_mm2": covariance}
    return {"measured_mm": list(map(float, given))}


def register_markers(
    registration_id: str, device_id: str, members: Mapping[str, Any]
) -> Call[d.Registration]:
    """Find where the frame of three markers lies."""
    body = {**members, "kind": "three-markers", "id": registration_id, "device": device_id}
    return _post(d.Registration, "registrations", body=body)


def register_surface(
    registration_id: str,
    device_id: str,
    parent_id: str,
    points_mm: Sequence[Sequence[float]],
    surface: Mapping[str, Any],
    members: Mapping[str, Any],
) -> Call[d.Registration]:
    """Refine a registration by points on a surface."""
    body = {
        **members,
        "kind": "surface",
        "id": registration_id,
        "device": device_id,
        "parent": parent_id,
        "points_mm": _rows(points_mm),
        "surface": surface,
    }
    return _post(d.Registration, "registrations", body=body)


def mesh(
    vertices_mm: Sequence[Sequence[float]], triangles: Sequence[Sequence[int]] | None
) -> dict[str, Any]:
    """Return a surface as the server takes it."""
    if triangles is None:
        return {"kind": "points", "points_mm": _rows(vertices_mm)}
    faces = [[int(corner) for corner in one] for one in triangles]
    return {"kind": "mesh", "vertices_mm": _rows(vertices_mm), "triangles": faces}


def _rows(points: Sequence[Sequence[float]]) -> list[list[float]]:
    return [list(map(float, one)) for one in points]


def measure_point(
    tool_id: str, frame: str | None, name: str | None, timeout_s: float, members: Mapping[str, Any]
) -> Call[d.MeasuredPoint]:
    """Where a tool's tip is held still."""
    body = {**members, "frame": frame, "name": name, "timeout_s": timeout_s}
    return _post(d.MeasuredPoint, "tools", tool_id, "points", body=body)


def frames(device_id: str) -> Call[d.Frames]:
    """A device's frames."""
    return _get(d.Frames, "devices", device_id, "frames")


def transform(device_id: str, frame: str, to: str) -> Call[d.FrameTransform]:
    """The transform between two of them."""
    return _get(d.FrameTransform, "devices", device_id, "frames", frame, to=to)


def reconstructions(device_id: str | None) -> Call[d.Answer]:
    """Reconstructions without their points."""
    return _get(d.Answer, "reconstructions", device=device_id)


def reconstruct(
    device_id: str, points: Mapping[str, Readings], calibration_id: str | None
) -> Call[d.Reconstruction]:
    """Compute points from readings."""
    body = {
        "device": device_id,
        "calibration": calibration_id,
        "points": [
            {"name": name, "readings": {one: _reading(given) for one, given in readings.items()}}
            for name, readings in points.items()
        ],
    }
    return _post(d.Reconstruction, "reconstructions", body=body)


def _reading(given: float | tuple[float, float]) -> float | dict[str, float]:
    if isinstance(given, tuple):
        return {"position_px": float(given[0]), "sigma_px": float(given[1])}
    return float(given)


def recordings(device_id: str | None) -> Call[d.Recording]:
    """Recordings, the newest first."""
    return _get(d.Recording, "recordings", device=device_id)


def recording(name: str) -> Call[d.Recording]:
    """One recording."""
    return _get(d.Recording, "recordings", name)


def start_recording(device_id: str, name: str | None, seconds: float | None) -> Call[d.Recording]:
    """Record a running device."""
    body = {"name": name, "seconds": seconds}
    return _post(d.Recording, "devices", device_id, "recordings", body=body)


def stop_recording(name: str) -> Call[d.Recording]:
    """End a recording."""
    return _post(d.Recording, "recordings", name, "stop")


def recording_file(name: str) -> str:
    """Return the path of a recording's file."""
    return _path("recordings", name, "file")


def start_export(
    recording: str, device_id: str, file_format: str, members: Mapping[str, Any]
) -> Call[d.Run]:
    """Write what is in a recording to a file on the server."""
    body = {**members, "recording": recording, "device": device_id, "format": file_format}
    return _post(d.Run, "export-runs", body=body)


def run(run_id: str) -> Call[d.Run]:
    """How far a run is."""
    return _get(d.Run, "runs", run_id)


def cancel_run(run_id: str) -> Call[d.Run]:
    """End a run."""
    return _post(d.Run, "runs", run_id, "cancel")


def exports() -> Call[d.Export]:
    """All exports."""
    return _get(d.Export, "exports")


def export(export_id: str) -> Call[d.Export]:
    """One export."""
    return _get(d.Export, "exports", export_id)


def export_file(export_id: str) -> str:
    """Return the path of an export's file."""
    return _path("exports", export_id, "file")
