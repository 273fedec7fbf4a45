"""Requests about registrations, and the transforms between frames."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from lumiline.client.exchange import ClientMethod, Exchanges, float_rows
from lumiline.client.models import Frames, FrameTransform, MeasuredPoint, Registration

_SURFACE_REGISTRATION_S: Final = 60.0
"""Time that the server needs for a large surface [s], at most."""


class RegistrationMethods(Exchanges):
    """Requests about registrations, and the transforms between frames."""

    @ClientMethod
    async def registrations(self, device_id: str | None = None) -> list[Registration]:
        """Registrations, newest first; of one device."""
        return await self._get_all(Registration, "registrations", device=device_id)

    @ClientMethod
    async def registration(self, registration_id: str) -> Registration:
        """One registration."""
        return await self._get(Registration, "registrations", registration_id)

    @ClientMethod
    async def register(
        self,
        /,
        registration_id: str,
        device_id: str,
        pairs: Mapping[str, tuple[Sequence[float], Sequence[float] | MeasuredPoint]],
        targets: Mapping[str, Sequence[float]] | None = None,
        **members: Any,
    ) -> Registration:
        """Register a frame by paired points.

        Args:
            registration_id: the frame's name.
            device_id: the device.
            pairs: by name: a point's position in the frame, and its measured position [mm], which
                ``measure_point`` returns with its covariance.
            targets: by name: positions in the frame at which the error is predicted [mm].
            members: others of the body of POST /api/v1/registrations.
        """
        body = {
            **members,
            "id": registration_id,
            "device": device_id,
            "fiducials": [
                {"name": name, "frame_mm": list(map(float, frame)), **_measured(measured)}
                for name, (frame, measured) in pairs.items()
            ],
            "targets": [
                {"name": name, "frame_mm": list(map(float, position))}
                for name, position in (targets or {}).items()
            ],
        }
        return await self._send(Registration, "POST", "registrations", body=body)

    @ClientMethod
    async def register_markers(
        self, /, registration_id: str, device_id: str, **members: Any
    ) -> Registration:
        """Register the frame of three markers: M1 its origin, M2 on x, M3 at positive y.

        Args:
            registration_id: the frame's name.
            device_id: the device.
            members: others of the body of POST /api/v1/registrations: ``measured_mm`` and
                ``measured_sigma_mm``, or ``strobe_markers`` that are held still now.
        """
        body = {**members, "kind": "three-markers", "id": registration_id, "device": device_id}
        seconds = float(members.get("seconds", 1.0))
        return await self._send(
            Registration, "POST", "registrations", body=body, extra_timeout_s=seconds
        )

    @ClientMethod
    async def register_surface(
        self,
        /,
        registration_id: str,
        device_id: str,
        parent_id: str,
        points_mm: Sequence[Sequence[float]],
        surface_mm: Sequence[Sequence[float]],
        triangles: Sequence[Sequence[int]] | None = None,
        **members: Any,
    ) -> Registration:
        """Refine a registration by points measured on a surface.

        Args:
            registration_id: the new frame's name.
            device_id: the device.
            parent_id: the registration that is refined.
            points_mm: measured positions of the points [mm].
            surface_mm: vertices of the surface in the frame, or points of it [mm].
            triangles: numbers of three vertices each; None: the surface is given as points.
            members: others of the body of POST /api/v1/registrations.
        """
        vertices = float_rows(surface_mm)
        if triangles is None:
            surface: dict[str, Any] = {"kind": "points", "points_mm": vertices}
        else:
            faces = [[int(corner) for corner in triangle] for triangle in triangles]
            surface = {"kind": "mesh", "vertices_mm": vertices, "triangles": faces}
        body = {
            **members,
            "kind": "surface",
            "id": registration_id,
            "device": device_id,
            "parent": parent_id,
            "points_mm": float_rows(points_mm),
            "surface": surface,
        }
        timeout_s = _SURFACE_REGISTRATION_S
        return await self._send(
            Registration, "POST", "registrations", body=body, extra_timeout_s=timeout_s
        )

    @ClientMethod
    async def frames(self, device_id: str) -> Frames:
        """A device's frames, and whether they are connected now."""
        return await self._get(Frames, "devices", device_id, "frames")

    @ClientMethod
    async def transform(self, device_id: str, frame: str, to: str = "tracker") -> FrameTransform:
        """The transform from one frame to another now, or why there is none."""
        return await self._get(FrameTransform, "devices", device_id, "frames", frame, to=to)


def _measured(position: Sequence[float] | MeasuredPoint) -> dict[str, Any]:
    if isinstance(position, MeasuredPoint):
        covariance = position.covariance_mm2
        return {"measured_mm": position.position_mm, "measured_covariance_mm2": covariance}
    return {"measured_mm": list(map(float, position))}
