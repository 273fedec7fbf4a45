"""Requests about registrations, and the transforms between frames, for both clients."""

from collections.abc import Mapping, Sequence
from typing import Any

from lumiline.client.api_request import ApiRequest, get, post
from lumiline.client.registrations import models as d
from lumiline.client.tools.models import MeasuredPoint


def registrations(device_id: str | None) -> ApiRequest[d.Registration]:
    """Registrations, newest first."""
    return get(d.Registration, "registrations", device=device_id)


def registration(registration_id: str) -> ApiRequest[d.Registration]:
    """One registration."""
    return get(d.Registration, "registrations", registration_id)


def register(
    registration_id: str,
    device_id: str,
    pairs: Mapping[str, tuple[Sequence[float], Sequence[float] | MeasuredPoint]],
    targets: Mapping[str, Sequence[float]],
    members: Mapping[str, Any],
) -> ApiRequest[d.Registration]:
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
    return post(d.Registration, "registrations", body=body)


def register_markers(
    registration_id: str, device_id: str, members: Mapping[str, Any]
) -> ApiRequest[d.Registration]:
    """Find where the frame of three markers lies."""
    body = {**members, "kind": "three-markers", "id": registration_id, "device": device_id}
    return post(d.Registration, "registrations", body=body)


def register_surface(
    registration_id: str,
    device_id: str,
    parent_id: str,
    points_mm: Sequence[Sequence[float]],
    surface: Mapping[str, Any],
    members: Mapping[str, Any],
) -> ApiRequest[d.Registration]:
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
    return post(d.Registration, "registrations", body=body)


def mesh(
    vertices_mm: Sequence[Sequence[float]], triangles: Sequence[Sequence[int]] | None
) -> dict[str, Any]:
    """Return a surface as the server takes it."""
    if triangles is None:
        return {"kind": "points", "points_mm": _rows(vertices_mm)}
    faces = [[int(corner) for corner in one] for one in triangles]
    return {"kind": "mesh", "vertices_mm": _rows(vertices_mm), "triangles": faces}


def frames(device_id: str) -> ApiRequest[d.Frames]:
    """A device's frames."""
    return get(d.Frames, "devices", device_id, "frames")


def transform(device_id: str, frame: str, to: str) -> ApiRequest[d.FrameTransform]:
    """The transform between two of them."""
    return get(d.FrameTransform, "devices", device_id, "frames", frame, to=to)


def _measured(given: Sequence[float] | MeasuredPoint) -> dict[str, Any]:
    if isinstance(given, MeasuredPoint):
        covariance = given.covariance_mm2
        return {"measured_mm": given.position_mm, "measured_covariance_mm2": covariance}
    return {"measured_mm": list(map(float, given))}


def _rows(points: Sequence[Sequence[float]]) -> list[list[float]]:
    return [list(map(float, one)) for one in points]
