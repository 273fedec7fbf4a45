"""Settings of the centroid peak finder, and the definition of a peak."""

from dataclasses import dataclass
from numbers import Integral
from typing import Final, Literal, get_args

from compute.parameter_checks import require

Weighting = Literal["edge-corrected", "above-threshold", "above-background"]
"""What the centre of gravity weighs; CentroidSettings says what each is."""

LEVEL_UNIT: Final = 64
"""Levels are integers in units of 1/64 count, so that every device takes the same decisions."""

FRACTION_UNIT: Final = 65536
"""The threshold's fraction is an integer in units of 1/65536, for the same reason."""

SAMPLE_GROUPS: Final = 32
"""Groups of pixels that the background is taken from; a line with fewer pixels has fewer."""

GROUP_PIXELS: Final = 8
"""Consecutive pixels in a group."""

MIN_PIXELS: Final = 64
MAX_PIXELS: Final = 65536
"""Lengths of a line: eight groups at least, and 64-bit sums of the first moment at most."""


@dataclass(frozen=True)
class CentroidSettings:
    """Settings of threshold and centre of gravity in a scan, thesis [4.1] and 4.2.2.

    The definition, which the kernel and the reference both implement:

    - *Background.* The scan is sampled in up to 32 groups of 8 pixels, evenly spread; the
      background b is the first quartile of the groups' means. It stands as long as peaks cover
      less than three quarters of the line, and is read in one pass over a few pixels. It lies
      0.25 standard deviations of a pixel below the mean of an empty line.
    - *Noise.* The standard deviation s of a pixel at b by the noise model, or the difference
      between the groups' first quartile and first sixteenth where that is larger: ambient light
      that varies along the line raises the limit and makes no peaks.
    - *Peak.* A pixel m with ``v_m >= b + detection_sigma s`` is a peak's maximum when no pixel
      is higher (and none further left as high) in the run of pixels around it that lie above
      its own threshold ``T = b + threshold_fraction (v_m - b)``. A faint peak beside a bright
      one is found when the signal between them falls below a third of the faint one.
    - *Position.* The centre of gravity over the run. "above-background" weighs ``v - b``: [4.1]
      as it stands. A pixel that crosses the threshold then makes the position jump.
      "above-threshold" weighs ``v - T`` (thesis 4.3 subtracts the threshold): a pixel's weight
      is zero where it enters. "edge-corrected", the default, adds at both ends of the run what
      the sum lacks of the integral, because the run ends between two pixels: the first term of
      Euler and Maclaurin's formula at the interpolated crossing.
    - *Standard deviation.* Two parts, added in squares. Noise: the derivative of the position by
      each pixel's value, through the threshold and the crossings too, with the pixels' variances
      by SensorNoise. And the error that depends on the position within a pixel, which more light
      does not make smaller: the variance, over all positions, of the first term of Euler and
      Maclaurin's formula that the weighting leaves (doubled for "edge-corrected", which finds
      slope and crossing by interpolation). For one width of image it may be half or twice that.
      For Gaussian images of 1 to 3 px this error is at most 0.13, 0.04 and 0.01 px RMS with the
      weightings in the order above. Left out is the noise of the background's level.

    Args:
        threshold_fraction: a peak's threshold as a fraction of its maximum above background.
        detection_sigma: minimum height above background in standard deviations of the noise.
        min_width_px: minimum number of pixels above a peak's own threshold; 2 omits hot pixels.
        weighting: what the centre of gravity weighs.
        max_peaks: room for peaks of one line; the brightest are kept.

    Raises:
        InvalidParameter: a value outside its range.
    """

    threshold_fraction: float = 1.0 / 3.0
    detection_sigma: float = 6.0
    min_width_px: int = 2
    weighting: Weighting = "edge-corrected"
    max_peaks: int = 16

    def __post_init__(self) -> None:
        require_between("threshold_fraction", self.threshold_fraction, 0.05, 0.95)
        require_between("detection_sigma", self.detection_sigma, 3.0, 1000.0)
        require_integer("min_width_px", self.min_width_px, 1, MAX_PIXELS)
        require_choice("weighting", self.weighting, get_args(Weighting))
        require_integer("max_peaks", self.max_peaks, 1, 1024)

    @property
    def fraction_units(self) -> int:
        """threshold_fraction as an integer in units of 1/FRACTION_UNIT."""
        return round(self.threshold_fraction * FRACTION_UNIT)


def require_integer(name: str, value: int, minimum: int, maximum: int) -> None:
    """Raise InvalidParameter unless a number is whole and in its range; arrays are sized by it.

    Args:
        name: name of the parameter.
        value: the number.
        minimum: smallest valid value.
        maximum: largest valid value.
    """
    is_integer = isinstance(value, Integral) and not isinstance(value, bool)
    valid = is_integer and minimum <= value <= maximum
    require(valid, f"be a whole number in {minimum} .. {maximum}", **{name: value})


def require_between(name: str, value: float, minimum: float, maximum: float) -> None:
    """Raise InvalidParameter unless a number is in its range.

    Args:
        name: name of the parameter.
        value: the number.
        minimum: smallest valid value.
        maximum: largest valid value.
    """
    require(minimum <= value <= maximum, f"lie in {minimum:g} .. {maximum:g}", **{name: value})


def require_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    """Raise InvalidParameter unless a value is one of the choices.

    Args:
        name: name of the parameter.
        value: the value.
        choices: the valid values.
    """
    require(value in choices, f"be one of {choices}", **{name: value})


def sample_starts(pixels: int) -> tuple[int, ...]:
    """Return the first pixel of each group of pixels that the background is estimated from."""
    groups = min(SAMPLE_GROUPS, pixels // GROUP_PIXELS)
    step = (pixels - GROUP_PIXELS) // (groups - 1)
    # A multiple of 8 pixels keeps the groups on the boundaries of 16-byte loads.
    return tuple(g * step // GROUP_PIXELS * GROUP_PIXELS for g in range(groups))
