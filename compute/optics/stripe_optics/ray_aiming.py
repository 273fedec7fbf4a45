"""Ray aiming: rays from points through the optics to heights on a row of pixels.

A cylindrical lens draws a point out into a line, and the row of pixels meets that line at one
point only. Of all rays of a point, those that end on the row form a fan, one ray for each position
in the pupil along x; its partner in y is found by aiming. Integrating over this fan instead of
over the whole pupil wastes no ray on what passes beside the row.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.optics.stripe_optics.guide_rays import (
    GUIDES,
    NODES,
    GuideSeries,
    RayTargets,
    fit_series,
    hits_row,
    pupil_reach_mm,
)
from compute.optics.tracing.assembly import Assembly
from compute.optics.tracing.reference_tracer import RayStatus, TracedRays, trace_rays
from compute.optics.tracing.surfaces import SurfaceStack

Array = NDArray[np.float64]

_COARSE: Final = 33  # places in the pupil looked at to find the fan's ends, at least
_MAX_COARSE: Final = 1025
_AIM_ITERATIONS: Final = 8
_AIM_TOLERANCE_MM: Final = 1e-9
_BISECTIONS: Final = 22  # of a 33rd of the pupil: to 1e-8 of its width


@dataclass(frozen=True, eq=False)
class RayFans:
    """Fans of M rays from N points to T heights on a row of pixels.

    Args:
        pupil_mm: where the rays pass the plane of the first element, shape (N, T, M) [mm], evenly
            spaced from one end of the fan to the other.
        position_mm: where they meet the row, x in the sensor's frame, shape (N, T, M) [mm].
        solid_angle_sr_per_mm2: solid angle at the point, losses included, per mm of pupil and
            per mm of height on the row, shape (N, T, M); zero for a ray that is lost.
        sine: x component of their directions at the row, shape (N, T, M).
        lit: whether any light of the point reaches the row at that height, shape (N, T).
    """

    pupil_mm: Array
    position_mm: Array
    solid_angle_sr_per_mm2: Array
    sine: Array
    lit: NDArray[np.bool_]

    def of_points(self, which: NDArray[np.bool_]) -> "RayFans":
        """Return the fans of some of the points."""
        return RayFans(*(values[which] for values in vars(self).values()))


class RayAimer:
    """Aims rays from points at a row of pixels behind an assembly.

    Args:
        assembly: the optics.

    Raises:
        InvalidParameter: the first element is infinitely wide, so that it has no pupil.
    """

    def __init__(self, assembly: Assembly) -> None:
        first = assembly.elements[0]
        if not np.isfinite(first.aperture.width_mm):
            raise InvalidParameter(
                "width_mm of the first element is infinite; give it the size of its opening",
                width_mm=first.aperture.width_mm,
            )
        self._stack = assembly.stack()
        # Aiming goes on behind the edges of lenses and stops, where the last trace will not.
        self._open = replace(
            self._stack,
            surfaces=tuple(replace(surface, aperture=None) for surface in self._stack.surfaces),
        )
        self._sensor_z_mm = assembly.sensor_z_mm
        self._plane_z_mm = assembly.front_z_mm
        self._centre_mm = first.alignment.decentre_mm[0]
        self._reach_mm = pupil_reach_mm(assembly)
        # Fine enough to meet the narrowest opening, wherever it is.
        narrowest = min(element.aperture.width_mm for element in assembly.elements)
        steps = np.ceil(
            (_COARSE - 1) * self._reach_mm / min(first.aperture.width_mm, narrowest * 4)
        )
        self._coarse = int(np.clip(2 * steps + 1, _COARSE, _MAX_COARSE))

    def fans(self, points_mm: Array, heights_mm: Array, samples: int) -> RayFans:
        """Return the ray fans of points in the optics' frame.

        Args:
            points_mm: shape (N, 3) [mm].
            heights_mm: heights on the row of pixels, shape (T,) [mm].
            samples: M, the rays of each fan.
        """
        shape = (len(points_mm), len(heights_mm), samples)
        source = np.repeat(points_mm, len(heights_mm), axis=0)
        height = np.tile(heights_mm, len(points_mm))
        guide = self._guide(source, height)
        first, last, lit = self._ends(source, height, guide)
        share = np.linspace(0.0, 1.0, samples)
        pupil = first[:, None] + (last - first)[:, None] * share
        aim = RayTargets.of(source, height, pupil)
        y, slope = (values.ravel() for values in guide.at(pupil))
        y, slope = self._aim_rays(aim, y, slope)
        # Where a ray would end is known behind the edge of a lens as well; whether it does is not.
        rays = self._through(aim, y, self._open)
        status = self._through(aim, y, self._stack).status
        arrived = ((status == RayStatus.ARRIVED) & hits_row(rays, aim)).reshape(shape)
        # The ends lie on an edge, and the rounding decides to which side.
        arrived[..., 0], arrived[..., -1] = arrived[..., 1], arrived[..., -2]
        light = self._density(aim, y, slope) * rays.transmittance.mean(axis=1)
        light = np.where(arrived, light.reshape(shape), 0.0)
        return RayFans(
            pupil.reshape(shape),
            rays.position_mm[:, 0].reshape(shape),
            light,
            rays.direction[:, 0].reshape(shape),
            lit.reshape(shape[:2]) & (light > 0.0).any(axis=2),
        )

    def row_positions_mm(self, points_mm: Array, pupil_mm: Array) -> Array:
        """Return the positions at which single rays meet the middle of the row, shape (N,) [mm].

        Edges are not heeded; NaN for a ray that misses a surface.

        Args:
            points_mm: where they start, in the optics' frame, shape (N, 3) [mm].
            pupil_mm: where they pass the plane of the first element, shape (N,) [mm].
        """
        aim = RayTargets(points_mm, np.zeros(len(points_mm)), pupil_mm)
        y, _ = self._aim_rays(aim)
        return self._through(aim, y, self._open).position_mm[:, 0]

    def _guide(self, source_mm: Array, height_mm: Array) -> GuideSeries:
        """Aim a few rays of each fan, to start all others from."""
        pupil = np.broadcast_to(self._centre_mm + self._reach_mm * NODES, (len(source_mm), GUIDES))
        aim = RayTargets.of(source_mm, height_mm, pupil)
        y, slope = self._aim_rays(aim)
        hits = hits_row(self._through(aim, y, self._open), aim)
        hits &= np.isfinite(y) & np.isfinite(slope) & (slope != 0.0)
        by_fan = hits.reshape(pupil.shape)
        return GuideSeries(
            self._centre_mm,
            self._reach_mm,
            fit_series(y.reshape(pupil.shape), by_fan, 0.0),
            fit_series(slope.reshape(pupil.shape), by_fan, 1.0),
            ~np.asarray(by_fan.all(axis=1)),
        )

    def _ends(
        self, source_mm: Array, height_mm: Array, guide: GuideSeries
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Find the ends of each fan in the pupil, shape (R,), and whether there is one."""

        def passes(pupil: Array) -> NDArray[np.bool_]:
            y, slope = (values.ravel() for values in guide.at(pupil))
            aim = RayTargets.of(source_mm, height_mm, pupil)
            if guide.unreliable.any():
                unreliable = np.repeat(guide.unreliable, pupil.shape[1])
                y[unreliable], _ = self._aim_rays(
                    aim.part(unreliable), y[unreliable], slope[unreliable]
                )
            rays = self._through(aim, y, self._stack)
            good = rays.status == RayStatus.ARRIVED
            if guide.unreliable.any():
                # The search may end beside a fold of the optics, where no ray meets the row.
                good &= ~unreliable | hits_row(rays, aim)
            return np.asarray(good).reshape(pupil.shape)

        count = self._coarse
        coarse = self._centre_mm + self._reach_mm * np.linspace(-1.0, 1.0, count)
        passing = passes(np.broadcast_to(coarse, (len(source_mm), count)))
        lit = np.asarray(passing.any(axis=1))
        low = passing.argmax(axis=1)
        high = count - 1 - passing[:, ::-1].argmax(axis=1)
        # Inside and outside of the two ends; at the ends of the pupil both are the end.
        inside = np.stack([coarse[low], coarse[high]], axis=1)
        beyond = np.stack(
            [coarse[np.maximum(low - 1, 0)], coarse[np.minimum(high + 1, count - 1)]], axis=1
        )
        for _ in range(_BISECTIONS):
            midpoint = 0.5 * (inside + beyond)
            good = passes(midpoint)
            inside = np.where(good, midpoint, inside)
            beyond = np.where(good, beyond, midpoint)
        return inside[:, 0], inside[:, 1], lit

    def _aim_rays(
        self, aim: RayTargets, y_mm: Array | None = None, slope: Array | None = None
    ) -> tuple[Array, Array]:
        """Find where rays must pass the pupil along y to meet the row at their heights.

        Args:
            aim: the rays.
            y_mm: where to start the search, shape (R,) [mm]; None: as if nothing stood in the way.
            slope: height on the row by y in the pupil there, shape (R,).

        Returns:
            y and slope, both (R,).
        """
        if y_mm is None:
            depth = self._plane_z_mm - aim.source_mm[:, 2]
            share = depth / (self._sensor_z_mm - aim.source_mm[:, 2])
            y_mm = aim.source_mm[:, 1] + share * (aim.height_mm - aim.source_mm[:, 1])
        y = y_mm.copy()
        miss = self._miss(aim, y)
        if slope is None:
            step = 1e-3 * (1.0 + np.abs(aim.height_mm - y))
            slope = (self._miss(aim, y + step) - miss) / step
        for _ in range(_AIM_ITERATIONS):
            with np.errstate(invalid="ignore", divide="ignore"):
                change = -miss / slope
            change[~np.isfinite(change)] = 0.0
            y += change
            if not (np.abs(change) > _AIM_TOLERANCE_MM).any():
                break
            before, miss = miss, self._miss(aim, y)
            with np.errstate(invalid="ignore", divide="ignore"):
                secant = (miss - before) / change
            # A secant over a tiny step is all rounding: keep the slope then.
            slope = np.where(np.abs(change) > 1e-4, secant, slope)
        return y, slope

    def _miss(self, aim: RayTargets, y_mm: Array) -> Array:
        return self._through(aim, y_mm, self._open).position_mm[:, 1] - aim.height_mm

    def _towards(self, aim: RayTargets, y_mm: Array) -> Array:
        """Return the vectors from the sources to the points in the pupil, shape (R, 3) [mm]."""
        plane_z_mm = np.full_like(y_mm, self._plane_z_mm)
        return np.stack([aim.pupil_mm, y_mm, plane_z_mm], axis=1) - aim.source_mm

    def _through(self, aim: RayTargets, y_mm: Array, stack: SurfaceStack) -> TracedRays:
        return trace_rays(stack, aim.source_mm, self._towards(aim, y_mm))

    def _density(self, aim: RayTargets, y_mm: Array, slope: Array) -> Array:
        """Return the solid angle per mm of pupil and mm of height, without losses, shape (R,)."""
        x, y, depth = self._towards(aim, y_mm).T
        with np.errstate(invalid="ignore", divide="ignore"):
            density: Array = np.abs(depth) / (x**2 + y**2 + depth**2) ** 1.5 / np.abs(slope)
        return np.asarray(np.nan_to_num(density))
