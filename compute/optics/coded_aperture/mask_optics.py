"""Light that coded windows let through to the pixels of placed line sensors."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.optics.coded_aperture.coded_window import CodedWindow
from compute.optics.coded_aperture.fresnel_shadow import DiffractedShadow
from compute.optics.coded_aperture.geometric_shadow import GeometricShadow, Shadow
from compute.optics.coded_aperture.window_refraction import ray_tangent_in_air, trace_window
from compute.optics.pixel_solid_angles import PixelSolidAngles
from compute.optics.sensor_placement import PlacedSensor
from compute.parameter_checks import require

Array = NDArray[np.float64]

_PIXELS_AT_ONCE = 1 << 16


class MaskOptics:
    """One coded window before each of S placed sensors.

    A sensor's frame (compute/camera) has its origin in the middle of the code; the principal
    point of its model is the pixel opposite, and its principal distance is the window's gap.
    The light of a point reaches a pixel along the exact rays of ``trace_window``; its shadow
    is averaged over the pixel's width and the emitter's penumbra, with Fresnel diffraction at
    the bars unless there is no wavelength. A pixel counts as small along the bars, against the
    distance of the point: an error of (height / distance)^2 / 24.

    At a gap of 10 mm and 0.9 um the fringes are no detail: bars of 60 um throw a shadow that
    differs from the geometric one by 0.38 RMS of the full light, bars of 300 um by 0.16
    (printed by tests/compute/optics/coded_aperture/test_mask_optics.py).

    Args:
        window: the window, the same before all sensors.
        sensors: the placed sensors, in the device's order.
        pixel_height_mm: height of a pixel, along the bars [mm].
        emitter_width_mm: width of the emitter along the sensor's x [mm], evenly bright; 0: a
            point.
        wavelength_nm: central wavelength [nm]; None: geometric shadows.
        spectral_width_nm: full width of the spectrum at half maximum [nm].

    Raises:
        InvalidParameter: a size, wavelength or spectral width out of its range; a sensor whose
            principal distance is not the gap.
    """

    def __init__(
        self,
        window: CodedWindow,
        sensors: Sequence[PlacedSensor],
        *,
        pixel_height_mm: float,
        emitter_width_mm: float = 0.0,
        wavelength_nm: float | None = None,
        spectral_width_nm: float = 0.0,
    ) -> None:
        require(0.0 < pixel_height_mm < np.inf, "be positive", pixel_height_mm=pixel_height_mm)
        valid = 0.0 <= emitter_width_mm < np.inf
        require(valid, "be zero or positive", emitter_width_mm=emitter_width_mm)
        for sensor in sensors:
            distance = sensor.model.principal_distance_px * sensor.pitch_um * 1e-3
            if abs(distance - window.gap_mm) > 1e-6 * window.gap_mm:
                raise InvalidParameter(
                    f"sensor {sensor.model.name} has the principal distance {distance:.9g} mm; "
                    f"behind this window it must be its gap, {window.gap_mm} mm",
                    principal_distance_mm=distance,
                )
        self._window = window
        self._sensors = tuple(sensors)
        self._pixels = max((sensor.model.pixels for sensor in sensors), default=0)
        self._height_mm = pixel_height_mm
        self._emitter_mm = emitter_width_mm
        self._shadow: Shadow
        if wavelength_nm is None:
            self._shadow = GeometricShadow(window)
        else:
            self._shadow = DiffractedShadow(
                window,
                wavelength_nm=wavelength_nm,
                spectral_width_nm=spectral_width_nm,
                finest_mm=min((sensor.pitch_um * 1e-3 for sensor in sensors), default=1.0),
            )

    def solid_angles(self, points_mm: Array) -> PixelSolidAngles:
        """Return the solid angles of points (N, 3) in the world [mm], in windows of all pixels.

        A point that is not in front of the plate, or not finite, gives no light; beyond the
        code is opaque frame.
        """
        points = len(points_mm)
        light = np.zeros((points, len(self._sensors), self._pixels))
        chunk = max(1, _PIXELS_AT_ONCE // max(1, self._pixels))
        for number, sensor in enumerate(self._sensors):
            local = _to_sensor_frame(sensor, points_mm)
            visible = np.flatnonzero(self._in_front(local))
            for start in range(0, len(visible), chunk):
                part = visible[start : start + chunk]
                light[part, number, : sensor.model.pixels] = self._line(sensor, local[part])
        return PixelSolidAngles(np.zeros(light.shape[:2], dtype=np.int64), light)

    def readings(self, points_mm: Array) -> Array:
        """Return the positions of the shadow of the code's middle, shape (N, S) [px].

        By the exact rays through the plate; NaN for points that are not in front of it. The
        middle's shadow may lie beyond the ends of the line.
        """
        window = self._window
        reading = np.full((len(points_mm), len(self._sensors)), np.nan)
        for number, sensor in enumerate(self._sensors):
            local = _to_sensor_frame(sensor, points_mm)
            visible = self._in_front(local)
            x, y, z = local[visible].T
            lateral = np.hypot(x, y)
            thickness, index = window.plate_thickness_mm, window.plate_index
            slope = ray_tangent_in_air(lateral, z - thickness, thickness, index)
            with np.errstate(invalid="ignore"):
                along = np.where(lateral > 0.0, x / lateral, 0.0)
            shift = window.gap_mm * slope * along / (sensor.pitch_um * 1e-3)
            reading[visible, number] = sensor.model.principal_point_px + shift
        return reading

    def _in_front(self, local: Array) -> NDArray[np.bool_]:
        front: NDArray[np.bool_] = local[:, 2] > self._window.plate_thickness_mm
        return front & np.isfinite(local).all(axis=1)

    def _line(self, sensor: PlacedSensor, local: Array) -> Array:
        """Return the solid angles of all pixels for points in the sensor's frame."""
        pitch = sensor.pitch_um * 1e-3
        x, y, z = local.T[:, :, None]
        edge = (np.arange(sensor.model.pixels + 1) - 0.5 - sensor.model.principal_point_px) * pitch
        # The pixels' edges lie at -edge in x; on the mask, along the readings, at:
        paths = trace_window(self._window, x + edge, y, z)
        on_mask = edge - paths.mask_fraction * (x + edge)
        share = _midpoints(paths.mask_fraction)
        passed = self._shadow.mean_transmission(
            _midpoints(on_mask),
            np.diff(on_mask, axis=1),
            share * self._emitter_mm,
            _midpoints(paths.phase_curvature_per_mm),
        )
        area = pitch * self._height_mm * self._lit_share(share, y)
        return np.asarray(
            _midpoints(paths.density_sr_per_mm2) * _midpoints(paths.transmittance) * area * passed
        )

    def _lit_share(self, share: Array, y: Array) -> Array:
        """Return the part of the pixels' height that is not shaded by the ends of the bars."""
        half = self._window.height_mm / 2.0
        centre, reach = share * y, (1.0 - share) * self._height_mm / 2.0
        lit = np.minimum(centre + reach, half) - np.maximum(centre - reach, -half)
        return np.asarray(np.maximum(lit, 0.0) / (2.0 * reach))


def _to_sensor_frame(sensor: PlacedSensor, points_mm: Array) -> Array:
    """Return points in the sensor's frame, shape (N, 3) [mm]; y from the window's middle."""
    model = sensor.model
    # An infinite point is nowhere, as one that is not a number; only that one passes silently.
    points = np.where(np.isfinite(points_mm), points_mm, np.nan)
    local = np.einsum("ij,nj->ni", model.rotation, points)
    y = np.einsum("j,nj->n", model.rotation[1], points - np.asarray(sensor.lens_position_mm))
    return np.column_stack([local[:, 0] + model.offset_x_mm, y, local[:, 2] + model.offset_z_mm])


def _midpoints(values: Array) -> Array:
    """Return the means of neighbours along the line."""
    return np.asarray(0.5 * (values[:, 1:] + values[:, :-1]))
