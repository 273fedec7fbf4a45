"""PlanningDevice: a profile's sensors with optics, light and noise for planning."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.calibrate import calibrate
from compute.camera.model import SensorGeometry
from compute.camera.stack import CameraStack
from compute.errors import DegeneratePoints, InvalidParameter, TooFewPoints
from compute.optics.coded_aperture.mask_optics import MaskOptics
from compute.optics.light.light_source import LightSource
from compute.optics.pixel_solid_angles import PixelSolidAngles
from compute.optics.profiles.device_profile import DeviceProfile
from compute.optics.profiles.profile_optics import (
    gray_plate,
    lens_sensors,
    light_source,
    mask_optics,
    pixel_row,
)
from compute.optics.sensor_placement import OpticalSensor
from compute.optics.stripe_optics.stripe_profile import Blur
from compute.optics.stripe_optics.traced_stripes import RaySampling, TracedStripes
from compute.planning.cramer_rao import (
    PixelNoise,
    Stripes,
    centroids,
    displaced_stripes,
    shifted_stripes,
)
from compute.planning.fixed_pattern_noise import PixelNonuniformity

Array = NDArray[np.float64]

RAYS_PER_FAN: Final = 17
"""Rays of a fan: the bound is within 0.5 % of that with 65 (bar and Optotrak, 27 points)."""


@dataclass(frozen=True, eq=False)
class ImagedPoints:
    """Noiseless images of N points on S sensors.

    Args:
        points_mm: shape (N, 3) [mm].
        readings_px: without noise, shape (N, S) [px]; NaN without light.
        light_sr: on the pixels, shape (N, S) [sr].
        footprints: where lines must be displaced for their derivative.
        lines: where their derivative is known already.
    """

    points_mm: Array
    readings_px: Array
    light_sr: Array
    solid_angles: PixelSolidAngles | None
    lines: Stripes | None


@dataclass(frozen=True, eq=False)
class PlanningDevice:
    """The sensors of a device, all of one kind.

    Args:
        names: of the S sensors.
        pixels: of a line; for a plate with tracks, the steps of its resolution.
        positions_mm: where the optics are, shape (S, 3) [mm].
        lenses: what forms lines of light, for each sensor; empty: none does.
        mask: what throws shadows of a mask, where there are no lenses.
        source: the markers' light.
        exposure_s: of a line [s].
        quantum_efficiency: filter included.
        noise: of a pixel.
        pattern: how pixels differ.
        quantisation_px: standard deviation of the rounding of readings, where they are numbers
            from the start (a Gray plate); None: readings come from lines of pixels.
        full_electrons: at which a pixel saturates, ambient light and dark signal included.
    """

    names: tuple[str, ...]
    pixels: int
    positions_mm: Array
    lenses: tuple[tuple[OpticalSensor, TracedStripes], ...]
    mask: MaskOptics | None
    source: LightSource
    exposure_s: float
    quantum_efficiency: float
    noise: PixelNoise
    pattern: PixelNonuniformity
    quantisation_px: float | None
    full_electrons: float

    def electrons_per_sr(self, points_mm: Array) -> Array:
        """Return photoelectrons per steradian, shape (N, S); markers face every sensor."""
        light = self.source.photons_per_sr(points_mm, None, self.positions_mm, self.exposure_s)
        return light * self.quantum_efficiency

    def image_points(self, points_mm: Array) -> "ImagedPoints":
        """Return the noiseless images of points (N, 3) [mm]."""
        if self.mask is not None:
            here = self.mask.solid_angles(points_mm)
            light = centroids(here, self.pixels)[1]
            position = np.where(light > 0.0, self.mask.readings(points_mm), np.nan)
            return ImagedPoints(points_mm, position, light, here, None)
        shapes = [lines.shapes(sensor.to_sensor_frame(points_mm)) for sensor, lines in self.lenses]
        lines = shifted_stripes(shapes, self.pixels)
        position = np.stack([shape.centroid_px for shape in shapes], axis=1)
        return ImagedPoints(points_mm, position, lines.mean_sr.sum(axis=2), None, lines)

    def lines(self, image_points: "ImagedPoints", cameras: CameraStack) -> Stripes:
        """Return the stripes of imaged points with their derivatives.

        Args:
            image_points: the images of N points.
            cameras: S cameras, for the derivatives of mask shadows.
        """
        if image_points.lines is not None:
            return image_points.lines
        assert self.mask is not None
        return displaced_stripes(
            self.mask, cameras, image_points.points_mm, self.pixels, image_points.solid_angles
        )

    def cameras(
        self, points_mm: Array, readings_px: Array, visible: NDArray[np.bool_]
    ) -> tuple[CameraStack, Array]:
        """Calibrate perspective cameras from noiseless readings.

        Args:
            points_mm: shape (N, 3) [mm].
            readings_px: shape (N, S) [px].
            visible: which of them are there, shape (N, S).

        Returns:
            The cameras, and what of the distortion they leave, RMS [px], shape (S,).

        Raises:
            InvalidParameter: a sensor sees too little of the points.
        """
        visible_readings = np.where(visible, readings_px, np.nan)
        geometry = [SensorGeometry(name, self.pixels) for name in self.names]
        try:
            calibration = calibrate(points_mm, visible_readings, geometry)
        except (TooFewPoints, DegeneratePoints) as error:
            raise InvalidParameter(
                f"the volume is not seen well enough to plan in it: {error.detail}; give a finer "
                "grid, or another volume",
                **error.context,
            ) from None
        return CameraStack.of(calibration.models), np.array(
            [fit.rms_px for fit in calibration.sensors]
        )


def planning_device(profile: DeviceProfile) -> PlanningDevice:
    """Build the planning device of a profile.

    A Gray plate (``PlateOptics``) is read as a row of steps as long as its code; its readings
    have the deviation of their rounding, 1/sqrt(12) of a step, and light enough is assumed.

    Args:
        profile: with optics of one kind: lenses, coded windows or plates.

    Raises:
        InvalidParameter: optics of several kinds.
    """
    kinds = {type(one) for one in profile.optics.values()}
    if len(kinds) != 1:
        raise InvalidParameter(
            f"profile {profile.name} has optics of {len(kinds)} kinds; a plan is made for "
            "sensors with lenses, with coded windows or with plates",
            optics=sorted(profile.optics),
        )
    source = light_source(profile)
    blur = Blur(source.wavelength_nm, source.width_mm)
    detector = profile.detector.detector(profile.rates.exposure_s)
    row, mask = pixel_row(profile), mask_optics(profile, source)
    lenses: tuple[tuple[OpticalSensor, TracedStripes], ...] = ()
    if mask is None:
        sensors = lens_sensors(profile, row)
        traced = {
            assembly: TracedStripes(assembly, row, blur, RaySampling(RAYS_PER_FAN))
            for assembly in {sensor.assembly for sensor in sensors}
        }
        lenses = tuple((sensor, traced[sensor.assembly]) for sensor in sensors)
    return PlanningDevice(
        tuple(sensor.name for sensor in profile.sensors),
        row.count,
        np.array([sensor.position_mm for sensor in profile.sensors]),
        lenses,
        mask,
        source,
        profile.rates.exposure_s,
        profile.detector.quantum_efficiency,
        PixelNoise.of(detector),
        PixelNonuniformity.of(detector),
        None if gray_plate(profile) is None else 12.0**-0.5,
        min(
            detector.full_well_electrons,
            (detector.full_scale - detector.offset_counts) * detector.electrons_per_count,
        ),
    )
