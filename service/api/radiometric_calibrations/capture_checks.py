"""Checks of a dark or flat capture the moment it is taken."""

from collections.abc import Sequence
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from compute.signal.radiometric_calibration import MIN_CAPTURES
from service.api.radiometric_calibrations.frame_statistics import FrameStatistics
from service.problems.errors import UnusableRadiometricCapture

Kind = Literal["dark", "flat"]

_MAX_SATURATED_FRACTION: Final = 0.02
"""Of a sensor's pixels: more than the hot and stuck ones of any sensor that is in use."""
_MAX_DARK_FRACTION: Final = 0.05
"""Of full scale above the stated offset: dark signal is less, light through a gap may be more."""
_MIN_FLAT_FRACTION: Final = 0.02
"""Of full scale above the dark capture."""
_MIN_EVENNESS: Final = 0.4
"""Darkest over brightest part of a sensor. What is smooth is removed, but not without limits."""
_PARTS: Final = 16
_MAX_FLICKER: Final = 0.03
_STRIPE_PIXELS: Final = 3
"""Neighbours that are brighter than the rest together: a light; a hot pixel stands alone."""
_STRIPE_SIGMA: Final = 8.0
_STRIPE_FRACTION: Final = 0.002
"""Of full scale: less is no light that matters, however well it is seen."""


def check_frame_count(frames: int, wanted: int, where: str) -> None:
    """Raise UnusableRadiometricCapture where fewer frames came than are needed."""
    if frames < max(MIN_CAPTURES, wanted):
        raise UnusableRadiometricCapture(
            f"{where}: {frames} of {wanted} frames came; {MIN_CAPTURES} at least are needed, and "
            "all that were asked for: raise timeout_s, ask for fewer frames, or record longer",
            frames=frames,
        )


def check_dark(
    found: FrameStatistics, sensors: Sequence[str], offset_counts: float, full_scale: int
) -> None:
    """Check frames of covered sensors.

    Args:
        found: their statistics.
        sensors: the sensors' names.
        offset_counts: the count without light, as the device states it.
        full_scale: the largest count.

    Raises:
        UnusableRadiometricCapture: a sensor saw light.
    """
    for sensor, pixels in zip(sensors, found.sensors, strict=True):
        mean = pixels.mean
        level = float(np.median(mean))
        limit = offset_counts + _MAX_DARK_FRACTION * full_scale
        if level > limit:
            raise UnusableRadiometricCapture(
                f"light in the dark: sensor {sensor} reads {level:.0f} counts, and covered at most "
                f"{limit:.0f} (its offset is {offset_counts:.0f}); cover the sensors and switch "
                "off markers and room light",
                sensor=sensor,
                counts=level,
            )
        stripe = _bright_stripe(mean, full_scale)
        if stripe is not None:
            raise UnusableRadiometricCapture(
                f"light in the dark: sensor {sensor} sees a stripe of light at pixel {stripe}; "
                "cover the sensors and switch the markers off",
                sensor=sensor,
                pixel=stripe,
            )


def check_flat(
    found: FrameStatistics, sensors: Sequence[str], dark: FrameStatistics, full_scale: int
) -> None:
    """Check frames of evenly lit sensors.

    Args:
        found: their statistics.
        sensors: the sensors' names.
        dark: the statistics of the covered sensors.
        full_scale: the largest count.

    Raises:
        UnusableRadiometricCapture: a sensor is saturated, too dark or unevenly lit, or the light
            flickers.
    """
    for number, sensor in enumerate(sensors):
        pixels = found.sensors[number]
        light = pixels.mean - dark.sensors[number].mean
        level = float(np.median(light))
        saturated = int(np.count_nonzero(pixels.maximum >= full_scale))
        if saturated > max(1, int(_MAX_SATURATED_FRACTION * light.size)):
            raise UnusableRadiometricCapture(
                f"saturated: {saturated} of {light.size} pixels of sensor {sensor} reach full "
                f"scale ({full_scale} counts); use less light or a shorter exposure",
                sensor=sensor,
                saturated=saturated,
            )
        lowest = _MIN_FLAT_FRACTION * full_scale
        if level < lowest:
            raise UnusableRadiometricCapture(
                f"too dark: sensor {sensor} reads {level:.0f} counts above the dark capture; a "
                f"flat capture needs at least {lowest:.0f}: uncover the sensors, use more light",
                sensor=sensor,
                counts=level,
            )
        parts = [float(np.median(part)) for part in np.array_split(light, min(_PARTS, light.size))]
        evenness = min(parts) / max(parts)
        if evenness < _MIN_EVENNESS:
            raise UnusableRadiometricCapture(
                f"uneven: the darkest part of sensor {sensor} gets {evenness:.0%} of the light of "
                f"the brightest; it must get {_MIN_EVENNESS:.0%}: put a diffuser before the "
                "sensors, move the light away",
                sensor=sensor,
                evenness=evenness,
            )
        flicker = float(found.flicker[number])
        if flicker > _MAX_FLICKER:
            raise UnusableRadiometricCapture(
                f"unsteady: the light on sensor {sensor} varies by {flicker:.1%} from frame to "
                f"frame; {_MAX_FLICKER:.0%} are allowed: use a direct-current source and let it "
                "warm up",
                sensor=sensor,
                flicker=flicker,
            )


def _bright_stripe(mean: NDArray[np.float64], full_scale: int) -> int | None:
    """Return the first of several neighbours that are brighter than the rest; None: none are."""
    above = mean - np.median(mean)
    sigma = 1.4826 * float(np.median(np.abs(above)))
    bright = above > max(_STRIPE_SIGMA * sigma, _STRIPE_FRACTION * full_scale)
    window = np.ones(_STRIPE_PIXELS, dtype=np.intp)
    runs = np.flatnonzero(np.convolve(bright, window, mode="valid") == _STRIPE_PIXELS)
    return int(runs[0]) if len(runs) else None
