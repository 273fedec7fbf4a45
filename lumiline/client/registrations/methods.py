"""Client's methods for registrations, and the transforms between frames."""

from collections.abc import Mapping, Sequence
from typing import Any

from lumiline.client.connection import Connection
from lumiline.client.registrations import models as d
from lumiline.client.registrations import requests
from lumiline.client.tools.models import MeasuredPoint


class RegistrationMethods(Connection):
    """Registrations, and the transforms between frames."""

    def registrations(self, device_id: str | None = None) -> list[d.Registration]:
        """Registrations, of a device, newest first."""
        return self._all(requests.registrations(device_id))

    def registration(self, registration_id: str) -> d.Registration:
        """One registration."""
        return self._one(requests.registration(registration_id))

    def register(
        self,
        registration_id: str,
        device_id: str,
        pairs: Mapping[str, tuple[Sequence[float], Sequence[float] | MeasuredPoint]],
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
        return self._one(
            requests.register(registration_id, device_id, pairs, targets or {}, members)
        )

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
        call = requests.register_markers(registration_id, device_id, members)
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
        surface = requests.mesh(surface_mm, triangles)
        call = requests.register_surface(
            registration_id, device_id, parent_id, points_mm, surface, members
        )
        return self._one(call, 60.0)

    def frames(self, device_id: str) -> d.Frames:
        """A device's frames, and whether they are connected now."""
        return self._one(requests.frames(device_id))

    def transform(self, device_id: str, frame: str, to: str = "tracker") -> d.FrameTransform:
        """The transform from one frame to another now, or why there is none."""
        return self._one(requests.transform(device_id, frame, to))
