"""Optics of placed sensors by exact ray traces."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.optics.pixel_row import PixelRow
from compute.optics.pixel_solid_angles import PixelSolidAngles
from compute.optics.sensor_placement import OpticalSensor, to_optics_frame
from compute.optics.stripe_optics.ray_aiming import RayAimer
from compute.optics.stripe_optics.stripe_profile import (
    Blur,
    StripeProfiles,
    merge_profiles,
    spline_error_px,
    stripe_profiles,
)
from compute.optics.tracing.assembly import Assembly
from compute.parameter_checks import require

Array = NDArray[np.float64]

NEAREST_MM: Final = 1.0
"""A point closer to the front of the optics than this is not imaged."""

_STEP: Final = 1e-4  # of the distance: the shift that measures a line's displacement
_PITCHES_BY_NODE: Final = 8.0  # height of a pixel for which one more node is needed


@dataclass(frozen=True)
class RaySampling:
    """Sampling of a stripe by rays.

    Args:
        rays: rays of a fan to begin with, odd and at least 9; more are traced, four times as
            many at a time, until the line has settled.
        max_rays: rays of a fan at most.
        tolerance_px: how far a spline through the rays may be off [px].
    """

    rays: int = 17
    max_rays: int = 1025
    tolerance_px: float = 1e-3

    def __post_init__(self) -> None:
        valid = self.rays >= 9 and self.rays % 2 == 1
        require(valid, "be odd, and at least 9", rays=self.rays)
        valid = self.max_rays >= self.rays and self.max_rays % 2 == 1
        right = f"be odd, and at least {self.rays}, the rays to begin with"
        require(valid, right, max_rays=self.max_rays)
        require(self.tolerance_px > 0.0, "be positive", tolerance_px=self.tolerance_px)


class TracedStripes:
    """Traced stripes of one kind of sensor, for points in its own frame.

    Args:
        assembly: the optics.
        row: the pixels.
        blur: emitter and wavelength.
        sampling: how finely to trace.
    """

    def __init__(
        self, assembly: Assembly, row: PixelRow, blur: Blur, sampling: RaySampling | None = None
    ) -> None:
        self.assembly = assembly
        self.row = row
        self.blur = blur
        self._sampling = sampling or RaySampling()
        self._front_mm = -assembly.front_z_mm + NEAREST_MM
        self._aim = RayAimer(assembly)
        # Gauss's nodes over a pixel's height, across which the line leans and bends.
        count = min(5, 2 + int(row.height_um / (_PITCHES_BY_NODE * row.pitch_um)))
        nodes, weights = np.polynomial.legendre.leggauss(count)
        self._heights_mm = nodes * row.height_mm / 2.0
        self._weights_mm = weights * row.height_mm / 2.0

    def shapes(self, points_mm: Array) -> StripeProfiles:
        """Return the stripes of points (N, 3) in the sensor's frame [mm]; dark where not seen.

        Raises:
            InvalidParameter: a point inside a lens.
        """
        self.assembly.check_source(to_optics_frame(points_mm))
        # Points behind the optics are moved in front to be traced, then darkened.
        before = points_mm[:, 2] >= self._front_mm
        points = np.where(before[:, None], points_mm, [0.0, 0.0, self._front_mm + 1000.0])
        parts, unsettled, samples = [], np.arange(len(points)), self._sampling.rays
        while len(unsettled):
            rays = self._aim.fans(to_optics_frame(points[unsettled]), self._heights_mm, samples)
            settled = spline_error_px(rays, self.row) <= self._sampling.tolerance_px
            if samples >= self._sampling.max_rays:
                settled[:] = True
            if settled.any():
                part = unsettled[settled]
                fans = rays.of_points(settled)
                centre = fans.pupil_mm[:, len(self._heights_mm) // 2].mean(axis=1)
                scale = self._scale(points[part], centre)
                profiles = stripe_profiles(fans, self._weights_mm, self.row, self.blur, scale)
                parts.append((part, profiles))
            unsettled, samples = unsettled[~settled], min(4 * samples - 3, self._sampling.max_rays)
        lines = merge_profiles(parts, len(points))
        lines.cell_sr[~before] = 0.0
        return lines

    def chief_px(self, points_mm: Array) -> Array:
        """Return the readings of the rays through the middle of each fan, shape (N,) [px].

        NaN for a point whose light does not reach the row.
        """
        rays = self._aim.fans(to_optics_frame(points_mm), np.zeros(1), 3)
        reading = self.row.centre_px - rays.position_mm[:, 0, 1] / self.row.pitch_mm
        return np.where(rays.lit[:, 0] & (points_mm[:, 2] >= self._front_mm), reading, np.nan)

    def _scale(self, points: Array, pupil_mm: Array) -> Array:
        """Return by how much a line moves with its point along x, shape (N,) [px/mm]."""
        step = _STEP * points[:, 2]
        shifted = points + np.stack([step, np.zeros_like(step), np.zeros_like(step)], axis=1)
        row_positions_mm = self._aim.row_positions_mm(
            to_optics_frame(np.concatenate([points, shifted])), np.tile(pupil_mm, 2)
        )
        change = row_positions_mm[len(points) :] - row_positions_mm[: len(points)]
        return np.nan_to_num(-change / self.row.pitch_mm / step)


class ExactOptics:
    """Optics of S sensors, every ray of every point traced: slow and exact.

    Args:
        sensors: the sensors, in the device's order.
        blur: emitter and wavelength.
    """

    def __init__(self, sensors: Sequence[OpticalSensor], blur: Blur) -> None:
        self._sensors = tuple(sensors)
        kinds = {(sensor.assembly, sensor.row) for sensor in self._sensors}
        self._lines = {kind: TracedStripes(*kind, blur) for kind in kinds}

    def solid_angles(self, points_mm: Array) -> PixelSolidAngles:
        """Return the solid angles of points (N, 3) in the world frame [mm]."""
        stripes = [
            self._lines[sensor.assembly, sensor.row].shapes(sensor.to_sensor_frame(points_mm))
            for sensor in self._sensors
        ]
        by_pixel = [stripe.pixels_sr for stripe in stripes]
        width = max(pixels.shape[1] for pixels in by_pixel)
        padded = [np.pad(pixels, ((0, 0), (0, width - pixels.shape[1]))) for pixels in by_pixel]
        first_px = np.stack([stripe.first_px for stripe in stripes], axis=1)
        return PixelSolidAngles(first_px, np.stack(padded, axis=1))
