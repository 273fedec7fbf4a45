"""Fans of rays in the plane of the pixels, traced through a profile's lenses."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.optics.tracing.assembly import Assembly, Stop
from compute.optics.tracing.reference_tracer import RayStatus, trace_rays

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Fan:
    """Where a fan through the stop met the sensor's plane, along the pixels [mm], and how many
    of its rays did."""

    position_mm: Array
    slope: Array
    arrived: float

    def width_mm(self, shift_mm: float = 0.0) -> float:
        """RMS width on the sensor, or on a plane ``shift_mm`` behind it."""
        return float(np.std(self.position_mm + shift_mm * self.slope))

    @property
    def middle_mm(self) -> float:
        return float(self.position_mm.mean())


def stop_of(assembly: Assembly) -> Stop:
    (stop,) = [element for element in assembly.elements if isinstance(element, Stop)]
    return stop


def fan(assembly: Assembly, angle_rad: float, distance_mm: float, rays: int = 41) -> Fan:
    """Trace rays of one point, ``distance_mm`` in front of the origin, that fill the stop."""
    stop = stop_of(assembly)
    origin = np.array([distance_mm * np.tan(angle_rad), 0.0, -distance_mm])
    places = (np.arange(rays) + 0.5) / rays - 0.5
    through = np.column_stack(
        [places * stop.aperture.width_mm, np.zeros(rays), np.full(rays, stop.z_mm)]
    )
    directions = through - origin
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    traced = trace_rays(assembly.stack(), np.tile(origin, (rays, 1)), directions)
    arrived = traced.status == RayStatus.ARRIVED
    direction = traced.direction[arrived]
    return Fan(
        traced.position_mm[arrived, 0], direction[:, 0] / direction[:, 2], float(arrived.mean())
    )


def field_of_view_rad(assembly: Assembly, length_mm: float, distance_mm: float) -> float:
    """Full angle whose light falls on a line of this length."""
    inside, outside = 0.0, 1.2
    for _ in range(24):
        angle = (inside + outside) / 2.0
        seen = fan(assembly, angle, distance_mm, rays=11)
        on_line = seen.arrived > 0.0 and abs(seen.middle_mm) <= length_mm / 2.0
        inside, outside = (angle, outside) if on_line else (inside, angle)
    return 2.0 * inside
