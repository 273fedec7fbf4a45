"""Scenes of the thesis's Tests 4.1 and 4.2: retro-reflective targets, an LED, a background.

Said in section 4.4: a source of 100 LEDs LD275; 22 flat targets, in Test 4.1 also 2 spherical
ones and one active LED of the same type; 2 m from the camera; a cylindrical lens before a
rectangular sensor, of which one line is read; 8 bits; a high background in Test 4.2. Table 4.5
has the peaks that were found: 9 and 6.

Assumed, as the thesis does not say it, or only in a figure that is lost:

- where the targets were. 22 or 24 targets made 8 or 6 passive peaks: so several stood in one
  column, and their light adds up. The columns are those of the centroids of Table 4.5, a peak's
  targets stand one over the other, as many in each as divides evenly;
- which peak of Test 4.1 is the active one: the third;
- the line: 512 pixels (Figures 4.2 and 4.6) of 12.5 um and as high, the lens 25 mm before it
  and 4 mm wide, which draws a point out into a line with a standard deviation of 1 pixel;
- the LED: 950 nm, 20 mW/sr on its axis, half of it at 18 degrees, as is usual for its kind;
- the targets: discs of 6 mm and spheres of 7 mm, 6 and 7 pixels wide on the line (of 10 mm the
  two peaks of Test 4.2 that are 5 pixels apart would be one), with 1000 cd/(lx m^2), half of it
  at an observation angle of 0.5 degrees; the source 30 mm beside the lens;
- an exposure of 0.8 ms, a quantum efficiency of 0.15, a full well of 60 000 electrons at full
  scale, and the shape and level of the backgrounds.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.optics.detector import Detector
from compute.optics.light.emission import CosinePower
from compute.optics.light.led import Led
from compute.optics.light.light_source import LightSource
from compute.optics.light.retroreflector import Illuminator, RetroDisc, RetroSheet
from compute.optics.sensor_placement import PlacedSensor, place_sensor
from validation.signal_chain.background import (
    Background,
    BumpBackground,
    ConstantBackground,
    PolynomialBackground,
    SumBackground,
)
from validation.signal_chain.retro_sphere import RetroSphere
from validation.signal_chain.spectrum import QuantumEfficiency, photoelectrons_per_sr

Array = NDArray[np.float64]

PEAK_MAXIMA_PX: Final = {
    "4.1": (152, 213, 281, 302, 332, 360, 410, 458, 501),
    "4.2": (103, 108, 237, 259, 368, 407),
}
"""Table 4.5: where the peaks of Tests 4.1 and 4.2 have their maxima [px]."""

PEAK_CENTROIDS_PX: Final = {
    "4.1": (151.32, 212.94, 281.11, 301.90, 332.20, 359.48, 409.09, 457.31, 501.13),
    "4.2": (104.45, 109.02, 236.81, 258.28, 367.67, 407.52),
}
"""Table 4.5: the centroids of these peaks [px]."""

ACTIVE_PEAK: Final = 2
"""The peak of Test 4.1 that is taken to be the active marker's."""

PIXELS: Final = 512
_PITCH_MM = 0.0125
_PRINCIPAL_DISTANCE_MM = 25.0
_LENS_WIDTH_MM = 4.0
_DISTANCE_MM = 2000.0
_EXPOSURE_S = 0.8e-3
_EFFICIENCY = QuantumEfficiency((900.0, 1000.0), (0.15, 0.15))
_LED = Led(0.020, 950.0, CosinePower(np.deg2rad(18.0)), 55.0, 0.4)
_LAMP = Illuminator(
    (0.0, 30.0, 0.0),
    (0.0, -30.0, _DISTANCE_MM),
    100 * _LED.radiant_intensity_w_per_sr,
    _LED.emission,
    _LED.wavelength_nm,
    _LED.spectral_width_nm,
)
_SHEET = RetroSheet(1000.0, np.deg2rad(0.5), np.deg2rad(40.0))
_FLAT = RetroDisc(6.0, _SHEET, _LAMP)
_SPHERE = RetroSphere(7.0, _SHEET, _LAMP)


@dataclass(frozen=True, eq=False)
class SceneMarkers:
    """Markers of one kind.

    Args:
        source: their light.
        points_mm: shape (N, 3) [mm].
        peaks: the peak of Table 4.5 to which each belongs, from 0, int64, shape (N,).
    """

    source: LightSource
    points_mm: Array
    peaks: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class TargetScene:
    """Markers before one line of a camera with a cylindrical lens.

    Args:
        sensor: the line.
        markers: by kinds.
        background: ambient light along the line.
        detector: its pixels.
        exposure_s: length of an exposure [s].
        blur_sigma_px: standard deviation of the line that the lens makes of a point [px].
    """

    sensor: PlacedSensor
    markers: tuple[SceneMarkers, ...]
    background: Background
    detector: Detector
    exposure_s: float
    blur_sigma_px: float

    def photoelectrons_per_sr(self) -> tuple[Array, Array]:
        """Return the points of all markers (N, 3) [mm], and their light (N, 1) [1/sr].

        The markers face the lens.
        """
        lens = np.array([self.sensor.lens_position_mm])
        light = [
            photoelectrons_per_sr(
                kind.source, kind.points_mm, None, lens, self.exposure_s, efficiency=_EFFICIENCY
            )
            for kind in self.markers
        ]
        return np.concatenate([kind.points_mm for kind in self.markers]), np.concatenate(light)

    def spot_sigma_px(self) -> Array:
        """Return the standard deviations of the light lines of all markers, shape (N,) [px].

        That of the lens with that of the marker's image: a round one, evenly bright and as wide
        as its source says, has a quarter of its width.
        """
        widths = [kind.source.width_mm / self._depth_mm(kind.points_mm) for kind in self.markers]
        per_tangent = _PRINCIPAL_DISTANCE_MM / _PITCH_MM
        image_px = per_tangent * np.concatenate(widths)
        return np.asarray(np.hypot(self.blur_sigma_px, image_px / 4.0))

    def solid_angle_sr(self, points_mm: Array) -> Array:
        """Return the solid angle through which the line collects light of points, shape (N,) [sr].

        A cylindrical lens gathers light over its width; along its axis it does nothing, and the
        light that meets a row of pixels is what goes through a strip as high as the row, seen
        from the row's distance: ``(width / d) (pitch / (d + c))``, losses left out. This is the
        loss beside a spherical lens that section 3.6 measures.
        """
        depth = self._depth_mm(points_mm)
        angle = _LENS_WIDTH_MM * _PITCH_MM / (depth * (depth + _PRINCIPAL_DISTANCE_MM))
        return np.asarray(angle)

    def _depth_mm(self, points_mm: Array) -> Array:
        return np.asarray(points_mm[:, 2] - self.sensor.lens_position_mm[2])


def scene_of_test_4_1() -> TargetScene:
    """Return the scene of Test 4.1: 22 flat and 2 spherical targets, one active LED."""
    passive = [peak for peak in range(9) if peak != ACTIVE_PEAK]
    flat = _columns("4.1", 22, passive)
    spheres = _columns("4.1", 2, passive[-2:])
    active = _columns("4.1", 1, [ACTIVE_PEAK])
    background = SumBackground(
        (ConstantBackground(3000.0), PolynomialBackground((1000.0, 300.0, -800.0)))
    )
    return _scene(
        background,
        SceneMarkers(_FLAT, *flat),
        SceneMarkers(_SPHERE, *spheres),
        SceneMarkers(_LED, *active),
    )


def scene_of_test_4_2() -> TargetScene:
    """Return the scene of Test 4.2: 22 flat targets before a bright, uneven background."""
    background = SumBackground(
        (
            PolynomialBackground((18_000.0, 4000.0, -6000.0, 1500.0)),
            BumpBackground(330.0, 60.0, 9000.0),
        )
    )
    return _scene(background, SceneMarkers(_FLAT, *_columns("4.2", 22, list(range(6)))))


def _scene(background: Background, *markers: SceneMarkers) -> TargetScene:
    detector = Detector(
        bits=8,
        electrons_per_count=60_000.0 / 255.0,
        offset_counts=2.0,
        read_noise_electrons=60.0,
        full_well_electrons=60_000.0,
        ambient_electrons=0.0,
    )
    return TargetScene(_sensor(), markers, background, detector, _EXPOSURE_S, 1.0)


def _sensor() -> PlacedSensor:
    return place_sensor(
        "line",
        lens_position_mm=(0.0, 0.0, 0.0),
        aim_mm=(0.0, 0.0, _DISTANCE_MM),
        measured_direction=(1.0, 0.0, 0.0),
        principal_distance_mm=_PRINCIPAL_DISTANCE_MM,
        pixels=PIXELS,
        pitch_um=1e3 * _PITCH_MM,
    )


def _columns(test: str, number: int, peaks: list[int]) -> tuple[Array, NDArray[np.int64]]:
    """Return places (N, 3) of markers dealt out to peaks in turn, 40 mm over one another."""
    peak = np.array(peaks)[np.arange(number) % len(peaks)]
    row = np.arange(number) // len(peaks)
    centroid = np.array(PEAK_CENTROIDS_PX[test])[peak]
    x = (centroid - (PIXELS - 1) / 2) * (_PITCH_MM * _DISTANCE_MM / _PRINCIPAL_DISTANCE_MM)
    y = 40.0 * (row - row.max() / 2)
    return np.stack([x, y, np.full(number, _DISTANCE_MM)], axis=1), peak
