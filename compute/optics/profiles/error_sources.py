"""Error sources of a device besides its noise: the section of a profile, and typical values."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from compute.parameter_checks import check_finite, check_not_negative, check_positive, require

PixelCorrection = Literal["uncorrected", "flat-fielded"]
DistortionCorrection = Literal["uncorrected", "terms", "map"]

MIN_CONTROL_POINTS: Final = 14
MAX_CONTROL_POINTS: Final = 1000


@dataclass(frozen=True)
class ErrorSources:
    """Systematic error sources of a device; None: the typical value, called assumed.

    All uncertainties are standard uncertainties (GUM, JCGM 100).

    Args:
        pixels: whether the pixels' fixed pattern is corrected.
        flat_field_residual: share of the fixed pattern that a flat field leaves.
        reading_step_px: step to which readings are rounded; 0: none [px].
        control_points: of the calibration, spread over the volume.
        control_position_sigma_mm: of each of their coordinates [mm].
        distortion: how it is corrected: not, by terms of the camera model, by a table after them.
        uncorrected_distortion_px: what a camera without terms leaves, one value for each sensor
            [px]; None: the traced lens's.
        terms_residual_px: what terms leave of the line shape and of a real lens's deviations from
            its design, RMS [px].
        map_residual_px: the same of a table of corrections [px].
        optical_centre_depth_mm: distance along the marker's axis from where its centre is taken
            to be to where it appears to be [mm].
        marker_tilt_rad: angle between the marker's axis and the line of sight [rad].
        expansion_per_k: coefficient of thermal expansion of the bar [1/K].
        focus_expansion_per_k: relative change of the principal distance, in pixels [1/K].
        temperature_change_k: of the whole device since its calibration [K].
        bar_gradient_k: change of the difference between the bar's front and back [K].
        bar_depth_mm: from its front to its back [mm].
        timing_s: of an exposure's time stamp, strobes included [s].
        speed_mm_per_s: of the markers [mm/s].

    Raises:
        InvalidParameter: a value is out of range.
    """

    pixels: PixelCorrection | None = None
    flat_field_residual: float | None = None
    reading_step_px: float | None = None
    control_points: int | None = None
    control_position_sigma_mm: float | None = None
    distortion: DistortionCorrection | None = None
    uncorrected_distortion_px: tuple[float, ...] | None = None
    terms_residual_px: float | None = None
    map_residual_px: float | None = None
    optical_centre_depth_mm: float | None = None
    marker_tilt_rad: float | None = None
    expansion_per_k: float | None = None
    focus_expansion_per_k: float | None = None
    temperature_change_k: float | None = None
    bar_gradient_k: float | None = None
    bar_depth_mm: float | None = None
    timing_s: float | None = None
    speed_mm_per_s: float | None = None

    def __post_init__(self) -> None:
        numbers = {name for name, value in vars(self).items() if isinstance(value, int | float)} - {
            "focus_expansion_per_k",
            "bar_depth_mm",
            "control_points",
        }
        check_not_negative(self, *sorted(numbers))
        if self.focus_expansion_per_k is not None:
            check_finite(self, "focus_expansion_per_k")
        if self.bar_depth_mm is not None:
            check_positive(self, "bar_depth_mm")
        share = self.flat_field_residual
        require(share is None or share <= 1.0, "be 0 to 1", flat_field_residual=share)
        count = self.control_points
        require(
            count is None or MIN_CONTROL_POINTS <= count <= MAX_CONTROL_POINTS,
            f"be {MIN_CONTROL_POINTS} to {MAX_CONTROL_POINTS}",
            control_points=count,
        )
        tilt = self.marker_tilt_rad
        right = "be below pi/2 (90 deg)"
        require(tilt is None or tilt < np.pi / 2.0, right, marker_tilt_rad=tilt)
        each = self.uncorrected_distortion_px
        right = "be one value, 0 or more, for each sensor"
        valid = each is None or (len(each) > 0 and min(each) >= 0.0 and max(each) < np.inf)
        require(valid, right, uncorrected_distortion_px=each)


@dataclass(frozen=True)
class TypicalValue:
    """Typical value of an error source, assumed where none is given.

    Args:
        value: in the unit of the field's name.
        source: where it is from, or the argument for it.
    """

    value: float | str
    source: str


_ALUMINIUM: Final = "aluminium 6061, 23.6e-6 1/K (ASM Handbook, volume 2)"

TYPICAL: Final[Mapping[str, TypicalValue]] = {
    "pixels": TypicalValue("uncorrected", "as pixels come"),
    "flat_field_residual": TypicalValue(
        0.1,
        "100 averaged exposures at half the full well leave 0.03 % of response by photon noise "
        "(EMVA 1288), of 1 % before; three times that for temperature and the light's angle",
    ),
    "reading_step_px": TypicalValue(0.0, "readings by a fit are not rounded"),
    "control_points": TypicalValue(
        60,
        "a frame of some 20 markers (20: Bianchi et al., 1990; 19: thesis, Test 5.4), "
        "at three places",
    ),
    "control_position_sigma_mm": TypicalValue(
        0.05, "a frame measured to 0.01 to 0.02 mm, and the seats of its markers"
    ),
    "distortion": TypicalValue("terms", "what a calibration fits"),
    "terms_residual_px": TypicalValue(
        0.05,
        "fits of traced stripes are off by 0.015 to 0.04 px (docs, device profiles); real lenses "
        "have as much again",
    ),
    "map_residual_px": TypicalValue(
        0.02, "the least of these errors of the line shape, which change with the place"
    ),
    "marker_tilt_rad": TypicalValue(
        float(np.radians(30.0)), "markers are used up to 60 deg off their axis; half of it"
    ),
    "expansion_per_k": TypicalValue(23.6e-6, _ALUMINIUM),
    "focus_expansion_per_k": TypicalValue(
        21e-6, f"a mount of {_ALUMINIUM}, less the sensor's silicon, 2.6e-6 1/K"
    ),
    "temperature_change_k": TypicalValue(2.0, "a room held to 3.5 K (rectangular distribution)"),
    "bar_gradient_k": TypicalValue(
        0.1,
        "q h / k: 100 W/m^2 of the electronics' heat through 0.1 m of aluminium, 200 W/(m K), "
        "make 0.05 K; twice that for a hollow bar",
    ),
    "bar_depth_mm": TypicalValue(100.0, "the housings of commercial devices"),
    "timing_s": TypicalValue(36e-6, "a USB microframe of 125 us (rectangular distribution)"),
    "speed_mm_per_s": TypicalValue(100.0, "a tool moved slowly by hand"),
}
"""By field; ``uncorrected_distortion_px`` has none, its default is the traced lens's."""

LED_DEPTH: Final = TypicalValue(
    0.1,
    "refraction in a flat window 1 mm over the chip (n = 1.5) shifts an LED by 0.065 mm at 40 deg",
)
RETRO_DEPTH: Final = TypicalValue(
    0.05,
    "retro-reflective targets shift by 0.03 mm at 40 deg (Zumbrunn, 1995, doi 10.1117/12.201812)",
)
"""``optical_centre_depth_mm``, by the kind of marker."""
