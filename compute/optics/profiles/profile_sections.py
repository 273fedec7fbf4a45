"""Sections of a profile: detector, markers, rates, volume, published figures."""

from dataclasses import dataclass, fields
from typing import Final, Literal

import numpy as np

from compute.camera.model import Vector3
from compute.errors import InvalidParameter
from compute.optics.detector import Detector
from compute.parameter_checks import check_not_negative, check_positive, require

Illumination = Literal["strobed", "simultaneous"]
Quantity = Literal["resolution", "accuracy", "max error"]
Axis = Literal["x", "y", "z", "lateral", "depth", "3d"]


_DETECTOR_FIELDS: Final = frozenset(field.name for field in fields(Detector))


@dataclass(frozen=True)
class DetectorProfile:
    """Detector parameters of a profile.

    Args:
        bits: resolution of the conversion, 8 to 16.
        full_well_electrons: what a pixel holds at most.
        read_noise_electrons: standard deviation of the amplifier's noise.
        dark_current_electrons_per_s: mean, of each pixel.
        electrons_per_count: gain of the conversion.
        offset_counts: the count without light and noise.
        quantum_efficiency: at the markers' wavelength, losses in a filter included, 0 to 1.
        response_nonuniformity: standard deviation of the pixels' response, relative.
        dark_nonuniformity: standard deviation of the pixels' dark current, relative.
        blooming: share of the charge above the full well that goes to the neighbouring pixels;
            0 with an antiblooming drain, 1 without.
        ambient_electrons_per_s: ambient light in each pixel, converted to electrons.
        offset_nonuniformity_counts: standard deviation of the pixels' offsets.

    Raises:
        InvalidParameter: a value is outside of its range.
    """

    bits: int
    full_well_electrons: float
    read_noise_electrons: float
    dark_current_electrons_per_s: float
    electrons_per_count: float
    offset_counts: float
    quantum_efficiency: float
    response_nonuniformity: float
    dark_nonuniformity: float
    blooming: float
    ambient_electrons_per_s: float
    offset_nonuniformity_counts: float = 0.0

    def __post_init__(self) -> None:
        check_not_negative(self, "dark_current_electrons_per_s", "ambient_electrons_per_s")
        self.detector(exposure_s=0.0)  # which checks the others
        valid = 0.0 < self.quantum_efficiency <= 1.0
        require(valid, "be above 0, at most 1", quantum_efficiency=self.quantum_efficiency)

    def detector(self, exposure_s: float) -> Detector:
        """Return the detector for exposures of this length [s]."""
        common = {name: value for name, value in vars(self).items() if name in _DETECTOR_FIELDS}
        return Detector(
            ambient_electrons=self.ambient_electrons_per_s * exposure_s,
            dark_electrons=self.dark_current_electrons_per_s * exposure_s,
            **common,
        )


@dataclass(frozen=True)
class LedMarkers:
    """Active markers.

    Args:
        radiant_intensity_w_per_sr: on the axis of the LED [W/sr].
        wavelength_nm: middle of the spectrum [nm].
        spectral_width_nm: its full width at half maximum [nm].
        half_angle_rad: angle off the axis at which the intensity is half [rad].
        emitter_width_mm: apparent size of the emitter [mm].
        max_markers: how many the device drives.
        illumination: "strobed", one in each exposure, or "simultaneous", all in each.

    Raises:
        InvalidParameter: a value is outside of its range.
    """

    radiant_intensity_w_per_sr: float
    wavelength_nm: float
    spectral_width_nm: float
    half_angle_rad: float
    emitter_width_mm: float
    max_markers: int
    illumination: Illumination

    def __post_init__(self) -> None:
        check_positive(self, "radiant_intensity_w_per_sr", "wavelength_nm", "emitter_width_mm")
        check_positive(self, "max_markers")
        check_not_negative(self, "spectral_width_nm")
        _check_acute(self, "half_angle_rad")


@dataclass(frozen=True)
class RetroMarkers:
    """Retro-reflective markers with one illuminator; all are lit at once.

    Args:
        illuminator_intensity_w_per_sr: radiant intensity towards the markers [W/sr].
        illuminator_position_mm: in the world frame [mm].
        wavelength_nm: middle of the spectrum [nm].
        spectral_width_nm: its full width at half maximum [nm].
        retroreflection_per_sr: coefficient of retroreflection R_A of the sheet,
            cd per lx and m2 [1/sr].
        observation_half_angle_rad: angle between illuminator and sensor, seen from the marker,
            at which R_A has fallen to half [rad].
        half_angle_rad: angle off the marker's axis at which R_A is half of that on the axis, the
            cosine of the area included: below pi/3, where the cosine alone halves it [rad].
        diameter_mm: of the marker [mm].
        max_markers: how many may be seen at once.

    Raises:
        InvalidParameter: a value is outside of its range.
    """

    illuminator_intensity_w_per_sr: float
    illuminator_position_mm: Vector3
    wavelength_nm: float
    spectral_width_nm: float
    retroreflection_per_sr: float
    observation_half_angle_rad: float
    half_angle_rad: float
    diameter_mm: float
    max_markers: int

    def __post_init__(self) -> None:
        check_positive(self, "illuminator_intensity_w_per_sr", "wavelength_nm")
        check_positive(self, "retroreflection_per_sr", "diameter_mm", "max_markers")
        check_not_negative(self, "spectral_width_nm")
        _check_acute(self, "observation_half_angle_rad")
        _check_acute(self, "half_angle_rad")
        right = (
            "be below pi/3 (60 deg), where the cosine of a flat marker's area alone halves what it "
            "sends back"
        )
        require(self.half_angle_rad < np.pi / 3.0, right, half_angle_rad=self.half_angle_rad)

    @property
    def illumination(self) -> Illumination:
        """Retroreflectors cannot be strobed one by one (section 4.3)."""
        return "simultaneous"


Markers = LedMarkers | RetroMarkers


@dataclass(frozen=True)
class Rates:
    """Line rate and exposure time.

    Args:
        line_rate_hz: lines of each sensor per second [Hz].
        exposure_s: of one line [s], not longer than a line takes.

    Raises:
        InvalidParameter: a value is not positive, or the exposure too long.
    """

    line_rate_hz: float
    exposure_s: float

    def __post_init__(self) -> None:
        check_positive(self, "line_rate_hz", "exposure_s")
        longest = 1.0 / self.line_rate_hz
        if self.exposure_s > longest * (1.0 + 1e-9):  # "200 us" at "5 kHz" is a whole line period
            raise InvalidParameter(
                f"exposure_s is {self.exposure_s}; at {self.line_rate_hz} lines per second it must "
                f"be at most {longest:.6g}",
                exposure_s=self.exposure_s,
            )


@dataclass(frozen=True)
class Volume:
    """Working volume, a box along the axes of the world.

    Args:
        centre_mm: its middle [mm].
        size_mm: its sides [mm].

    Raises:
        InvalidParameter: a side that is not positive.
    """

    centre_mm: Vector3
    size_mm: Vector3

    def __post_init__(self) -> None:
        require(min(self.size_mm) > 0.0, "have three positive sides", size_mm=self.size_mm)


@dataclass(frozen=True)
class PublishedFigure:
    """One published figure of a device.

    Args:
        quantity: what it says: "resolution", "accuracy" (a mean error), "max error".
        axis: "x", "y", "z" of the world, "lateral" (x and y alike), "depth" (z), "3d" (all, or
            not said).
        value_mm: the figure [mm].
        source: where it is printed.
        distance_mm: distance from the device at which it holds; None where not said [mm].
        note: what else must be known of it.

    Raises:
        InvalidParameter: a figure or a distance that is not positive.
    """

    quantity: Quantity
    axis: Axis
    value_mm: float
    source: str
    distance_mm: float | None = None
    note: str = ""

    def __post_init__(self) -> None:
        check_positive(self, "value_mm")
        if self.distance_mm is not None:
            check_positive(self, "distance_mm")


def _check_acute(part: object, name: str) -> None:
    value = getattr(part, name)
    require(0.0 < value < np.pi / 2.0, "be above 0 and below pi/2 (90 deg)", **{name: value})
