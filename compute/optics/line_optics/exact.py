"""ExactOptics: the light lines of points on real sensors, every ray traced."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.optics.footprints import Footprints
from compute.optics.line_optics.line_shape import (
    Blur,
    LineShapes,
    line_shapes,
    merged_lines,
    unsettled_px,
)
from compute.optics.line_optics.row_rays import RowAim, RowRays, Tracer
from compute.optics.line_optics.sensor import OpticalSensor, in_optics_frame
from compute.optics.pixel_row import PixelRow
from compute.optics.tracing.assembly import Assembly
from compute.optics.tracing.trace import trace_rays

Array = NDArray[np.float64]

NEAREST_MM: Final = 1.0
"""A point closer to the front of the optics than this is not imaged."""

_STEP: Final = 1e-4  # of the distance: the shift that measures a line's displacement
_PITCHES_BY_NODE: Final = 8.0  # height of a pixel for which one more node is needed


@dataclass(frozen=True)
class Fineness:
    """How finely a line is traced.

    Args:
        rays: rays of a fan to begin with, odd and at least 9; more are traced, four times as
            many at a time, until the line has settled.
        most: rays of a fan at most.
        settled_px: how far a spline through the rays may be off [px].
    """

    rays: int = 17
    most: int = 1025
    settled_px: float = 1e-3

    def __post_init__(self) -> None:
        if self.rays < 9 or self.rays % 2 == 0:
            raise InvalidParameter(
                f"rays is {self.rays}; it must be odd, and at least 9", rays=self.rays
            )
        if self.most < self.rays or self.most % 2 == 0:
            raise InvalidParameter(
                f"most is {self.most}; it must be odd, and at least {self.rays}, the rays to "
                "begin with",
                most=self.most,
            )
        if not self.settled_px > 0.0:
            raise InvalidParameter(
                f"settled_px is {self.settled_px}; it must be positive", settled_px=self.settled_px
            )


class TracedLines:
    """The light lines of one kind of sensor, for points in its own frame.

    Args:
        assembly: the optics.
        row: the pixels.
        blur: emitter and wavelength.
        fineness: how finely to trace.
        tracer: what traces; NumPy's by default.
    """

    def __init__(
        self,
        assembly: Assembly,
        row: PixelRow,
        blur: Blur,
        fineness: Fineness | None = None,
        tracer: Tracer = trace_rays,
    ) -> None:
        self.assembly = assembly
        self.row = row
        self.blur = blur
        self._fineness = fineness or Fineness()
        self._aim = RowAim(assembly, tracer)
        # Gauss's nodes over a pixel's height, across which the line leans and bends.
        count = min(5, 2 + int(row.height_um / (_PITCHES_BY_NODE * row.pitch_um)))
        nodes, weights = np.polynomial.legendre.leggauss(count)
        self._heights_mm = nodes * row.height_mm / 2.0
        self._weights_mm = weights * row.height_mm / 2.0

    def shapes(self, seen_mm: Array) -> LineShapes:
        """Return the lines of points (N, 3) in the sensor's frame [mm]; dark where none is seen.

        Raises:
            InvalidParameter: a point inside a lens.
        """
        self.assembly.check_source(in_optics_frame(seen_mm))
        front = -self.assembly.front_z_mm + NEAREST_MM
        # Points behind the optics are moved in front to be traced, then darkened.
        before = seen_mm[:, 2] >= front
        points = np.where(before[:, None], seen_mm, [0.0, 0.0, front + 1000.0])
        parts, left, samples = [], np.arange(len(points)), self._fineness.rays
        while len(left):
            rays = self._aim.fans(in_optics_frame(points[left]), self._heights_mm, samples)
            settled = unsettled_px(rays, self.row) <= self._fineness.settled_px
            if samples >= self._fineness.most:
                settled[:] = True
            if settled.any():
                part = left[settled]
                parts.append((part, self._gather(rays.of_points(settled), points[part])))
            left, samples = left[~settled], min(4 * samples - 3, self._fineness.most)
        lines = merged_lines(parts, len(points))
        lines.cell_sr[~before] = 0.0
        return lines

    def _gather(self, rays: RowRays, points: Array) -> LineShapes:
        middle = rays.pupil_mm[:, len(self._heights_mm) // 2].mean(axis=1)
        return line_shapes(rays, self._weights_mm, self.row, self.blur, self._scale(points, middle))

    def chief_px(self, seen_mm: Array) -> Array:
        """Return the readings of the rays through the middle of each fan, shape (N,) [px].

        NaN for a point whose light does not reach the row.
        """
        rays = self._aim.fans(in_optics_frame(seen_mm), np.zeros(1), 3)
        reading = self.row.middle_px - rays.position_mm[:, 0, 1] / self.row.pitch_mm
        front = -self.assembly.front_z_mm + NEAREST_MM
        return np.where(rays.lit[:, 0] & (seen_mm[:, 2] >= front), reading, np.nan)

    def _scale(self, points: Array, pupil_mm: Array) -> Array:
        """Return by how much a line moves with its point along x, shape (N,) [px/mm]."""
        step = _STEP * points[:, 2]
        shifted = points + np.stack([step, np.zeros_like(step), np.zeros_like(step)], axis=1)
        places = self._aim.places(
            in_optics_frame(np.concatenate([points, shifted])), np.tile(pupil_mm, 2)
        )
        change = places[len(points) :] - places[: len(points)]
        return np.nan_to_num(-change / self.row.pitch_mm / step)


class ExactOptics:
    """The optics of S sensors, every ray of every point traced: slow, and as exact as rays are.

    Args:
        sensors: the sensors, in the device's order.
        blur: emitter and wavelength.
        fineness: how finely to trace.
        tracer: what traces; NumPy's by default.
    """

    def __init__(
        self,
        sensors: Sequence[OpticalSensor],
        blur: Blur,
        fineness: Fineness | None = None,
        tracer: Tracer = trace_rays,
    ) -> None:
        self._sensors = tuple(sensors)
        kinds = {(sensor.assembly, sensor.row) for sensor in self._sensors}
        self._lines = {kind: TracedLines(*kind, blur, fineness, tracer) for kind in kinds}

    def footprints(self, points_mm: Array) -> Footprints:
        """Return the footprints of points (N, 3) in the world frame [mm]."""
        return gather_footprints(
            [
                self._lines[sensor.assembly, sensor.row].shapes(sensor.in_sensor_frame(points_mm))
                for sensor in self._sensors
            ]
        )


def gather_footprints(lines: Sequence[LineShapes]) -> Footprints:
    """Put the lines of N points on each of S sensors into windows of one width."""
    by_pixel = [line.pixels_sr for line in lines]
    width = max(pixels.shape[1] for pixels in by_pixel)
    window = np.zeros((len(by_pixel[0]), len(lines), width))
    for sensor, pixels in enumerate(by_pixel):
        window[:, sensor, : pixels.shape[1]] = pixels
    return Footprints(np.stack([line.first_px for line in lines], axis=1), window)
