"""Radiometric calibration of a sensor from dark and flat captures, in the terms of EMVA 1288."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from enum import IntFlag
from typing import Any, Final

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.stats import chi2

from compute.errors import InvalidParameter
from compute.parameter_checks import require
from compute.robust_statistics import MAD_TO_SIGMA, biweight
from compute.signal.capture_statistics import CaptureStatistics
from compute.signal.centroid_settings import MIN_PIXELS
from compute.signal.measured_line_spread import MeasuredLineSpread

Array = NDArray[np.float64]

MIN_CAPTURES: Final = 16
"""Captures of a scene: the variance of 2048 pixels is then known to 1 %, that of one to 44 %."""
MIN_FLATS: Final = 2
MIN_LINEARITY_FLATS: Final = 4
"""Levels of light from which two coefficients of nonlinearity are estimated."""
ILLUMINATION_DEGREE: Final = 4
"""Degree of the polynomial along the sensor that counts as uneven light."""
MAX_ILLUMINATION_RANGE: Final = 0.8
"""Largest range of the light along the sensor, as a part of its mean."""
MAX_BAD_SHARE: Final = 0.2
MIN_RESPONSE: Final = 0.5
"""Response below which a pixel is dead; one above 1 / MIN_RESPONSE is, too: neither is like the
others enough to be corrected."""
HOT_SIGMA: Final = 8.0
"""Dark excess of a hot pixel, in standard deviations of the other pixels' offsets."""
NOISY_FACTOR: Final = 2.0
"""Standard deviation of a noisy pixel beside that of the others."""
NONLINEAR_PART: Final = 0.02
"""Deviation of a pixel's response at one level of light from its mean."""
_FALSE_RATE: Final = 1e-7
_MAX_SATURATED: Final = 0.02


class BadPixel(IntFlag):
    """Why a pixel is left out of every measurement."""

    GOOD = 0
    DEAD = 1
    """It hardly responds to light, or far more than the others."""
    HOT = 2
    """Its dark signal is far above that of the others, and changes with the temperature."""
    STUCK = 4
    """Its count never changes."""
    NOISY = 8
    """Its temporal noise is far above that of the others."""
    NONLINEAR = 16
    """Its response depends on the light in another way than that of the others."""


@dataclass(frozen=True, eq=False)
class RadiometricCalibration:
    """Offset, response, noise and bad pixels of one sensor with N pixels.

    With the count v of pixel i, ``y = v - dark_offset[i]`` and
    ``z = y (1 + linearity[0] y + linearity[1] y^2)``, the corrected signal is ``z / response[i]``
    [counts of a mean pixel]. Terms are those of EMVA 1288 release 4.0.

    *Response is relative to the neighbourhood.* The light of flat captures is even only as far as
    the lamp is: a lamp that is brighter at one end looks the same as a sensor whose pixels respond
    more there. So a smooth variation along the sensor (a polynomial of ``illumination_degree``) is
    taken for the lamp's, and removed. A line's position depends on the pixels about it alone, where
    this variation is next to nothing: half of a percent over a line would move it by less than a
    thousandth of its width.

    Args:
        dark_offset: count without light, shape (N,).
        response: response to light beside the mean of the good pixels, shape (N,).
        gain_electrons_per_count: electrons per count, by the photon transfer curve.
        read_noise_counts: temporal noise without light, quantisation included: root of the good
            pixels' median variance.
        saturation_counts: count at which a pixel is saturated.
        linearity: two coefficients; zeros where the light's ratios were not given.
        bad_pixels: BadPixel flags, uint8, shape (N,).
        captures: number of captures, dark ones and those of all levels.
        dsnu_counts: standard deviation of the good pixels' dark offsets.
        prnu: standard deviation of the good pixels' responses.
        response_sigma: standard error of a pixel's response.
        linearity_error: mean deviation from a straight line before the correction, as a part of the
            signal (EMVA 1288, section 6.7); None: the light's ratios were not given.
        illumination_range: range of the smooth variation that was removed, as a part of its mean.
        illumination_degree: degree of its polynomial.
        dark_current_counts_per_s: dark signal per time, shape (N,); None: one exposure only.
        exposure_s: exposure time of the dark captures; None: not known.
        temperature_c: of the sensor; None: not known.
        line_shape: shape of its lines by position; None: not measured, they are taken for
            Gaussians.
    """

    dark_offset: Array
    response: Array
    gain_electrons_per_count: float
    read_noise_counts: float
    saturation_counts: int
    linearity: tuple[float, float]
    bad_pixels: NDArray[np.uint8]
    captures: int
    dsnu_counts: float
    prnu: float
    response_sigma: float
    linearity_error: float | None = None
    illumination_range: float = 0.0
    illumination_degree: int = ILLUMINATION_DEGREE
    dark_current_counts_per_s: Array | None = None
    exposure_s: float | None = None
    temperature_c: float | None = None
    line_shape: MeasuredLineSpread | None = None

    def __post_init__(self) -> None:
        shape = self.dark_offset.shape
        if len(shape) != 1 or self.response.shape != shape or self.bad_pixels.shape != shape:
            raise InvalidParameter(
                f"dark_offset has the shape {shape}, response {self.response.shape} and bad_pixels "
                f"{self.bad_pixels.shape}; they must be (N,) for the sensor's N pixels"
            )
        good = self.good
        require(bool(good.any()), "leave a good pixel", bad_pixels=int((~good).sum()))
        require(
            bool(np.isfinite(self.dark_offset[good]).all()),
            "be finite where the pixel is good",
            dark_offset="not finite",
        )
        lowest = float(np.min(self.response[good]))
        require(
            bool(np.isfinite(self.response[good]).all()) and lowest > 0.0,
            "be positive where the pixel is good",
            response=lowest,
        )
        gain = self.gain_electrons_per_count
        require(0.0 < gain < np.inf, "be positive", gain_electrons_per_count=gain)
        noise = self.read_noise_counts
        require(0.0 <= noise < np.inf, "be zero or positive", read_noise_counts=noise)
        full = self.saturation_counts
        require(1 <= full <= 65535, "be in 1 .. 65535", saturation_counts=full)

    @property
    def pixels(self) -> int:
        """N."""
        return len(self.dark_offset)

    @property
    def good(self) -> NDArray[np.bool_]:
        """Pixels that are used, shape (N,)."""
        return np.asarray(self.bad_pixels == 0)

    @property
    def mean_offset_counts(self) -> float:
        """Mean count of the good pixels without light."""
        return float(np.mean(self.dark_offset[self.good]))

    @property
    def read_noise_electrons(self) -> float:
        """Read noise without quantisation [electrons]."""
        variance = max(self.read_noise_counts**2 - 1.0 / 12.0, 0.0)
        return float(np.sqrt(variance)) * self.gain_electrons_per_count

    def with_bad_pixels(self, bad_pixels: NDArray[np.uint8]) -> "RadiometricCalibration":
        """Return it with further BadPixel flags, uint8, shape (N,)."""
        return replace(self, bad_pixels=self.bad_pixels | bad_pixels)

    def to_document(self) -> dict[str, Any]:
        """Return it as a JSON object."""
        document: dict[str, Any] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            document[field.name] = (
                value.tolist()
                if isinstance(value, np.ndarray)
                else list(value)
                if isinstance(value, tuple)
                else value.to_document()
                if isinstance(value, MeasuredLineSpread)
                else value
            )
        return document

    @classmethod
    def from_document(cls, document: dict[str, Any]) -> "RadiometricCalibration":
        """Return the calibration of a JSON object.

        Raises:
            InvalidParameter: a field is missing, unknown, or of a wrong shape or value.
        """
        names = {field.name for field in fields(cls)}
        members = set(document)
        if members != names:
            raise InvalidParameter(
                f"the document has the fields {sorted(members)}; it must have {sorted(names)}"
            )
        content = dict(document)
        try:
            for name in ("dark_offset", "response", "dark_current_counts_per_s"):
                if content[name] is not None:
                    content[name] = np.array(content[name], dtype=np.float64)
            if content["line_shape"] is not None:
                content["line_shape"] = MeasuredLineSpread.from_document(content["line_shape"])
            content["bad_pixels"] = np.array(content["bad_pixels"], dtype=np.uint8)
            first, second = content["linearity"]
            content["linearity"] = (float(first), float(second))
            return cls(**content)
        except (TypeError, ValueError, OverflowError) as error:
            raise InvalidParameter(
                f"the document holds a value of another type: {error}"
            ) from error

    def content_hash(self) -> str:
        """Return SHA-256 of the document's canonical JSON, in hexadecimal."""
        text = json.dumps(
            self.to_document(), sort_keys=True, separators=(",", ":"), allow_nan=False
        )
        return hashlib.sha256(text.encode()).hexdigest()


def estimate(
    dark: CaptureStatistics,
    flats: Sequence[CaptureStatistics],
    *,
    full_scale_counts: int = 65535,
    relative_light: Sequence[float] | None = None,
    exposure_s: float | None = None,
    other_dark: CaptureStatistics | None = None,
    other_exposure_s: float | None = None,
    temperature_c: float | None = None,
) -> RadiometricCalibration:
    """Estimate a sensor's radiometric calibration.

    The gain is the slope of the photon transfer curve: temporal variance against mean, both less
    those of the dark captures. Levels above 70 % of the brightest that is not saturated do not
    count, as EMVA 1288 section 6.6 has it, unless there is no other.

    Args:
        dark: captures without light.
        flats: captures under even light, one for each level.
        full_scale_counts: largest count of the converter, or the saturation if it is known lower.
        relative_light: light of each level in any unit (lamp or exposure time), without which
            nothing can be said of the linearity.
        exposure_s: exposure time of the dark captures.
        other_dark: dark captures of another exposure time, for the dark current.
        other_exposure_s: their exposure time.
        temperature_c: of the sensor.

    Raises:
        InvalidParameter: too few captures or levels, other pixel numbers, saturated or dark flats,
            light in the dark captures, uneven light, or too many bad pixels.
    """
    _check_captures(dark, flats, full_scale_counts)
    offset, pixels = dark.mean, len(dark.mean)
    stuck = _find_stuck(dark, flats)
    hot = ~stuck & _is_hot(dark)
    noisy = ~stuck & ~hot & _is_noisy(dark)
    usable = ~(stuck | hot | noisy)
    net = np.array([flat.mean - offset for flat in flats])
    level = np.median(net[:, usable], axis=1)
    usable &= net[int(np.argmax(level))] > 0.2 * level.max()
    linearity, linearity_error = _linearity(level, relative_light)
    slope = 1.0 + 2.0 * linearity[0] * net + 3.0 * linearity[1] * net**2
    net = _linearise(net, linearity)
    level = np.median(net[:, usable], axis=1)
    noise_added = np.array([flat.variance - dark.variance for flat in flats]) * slope**2
    gain = _photon_transfer(np.mean(net[:, usable], axis=1), noise_added, usable, flats)
    _check_light_in_the_dark(dark, usable, gain)

    responses, illuminations = [], []
    for counts in net:
        light = _smooth_light(counts, usable)
        illuminations.append(light)
        responses.append(counts / light)
    ranges = [float(np.ptp(light) / np.mean(light)) for light in illuminations]
    if max(ranges) > MAX_ILLUMINATION_RANGE:
        raise InvalidParameter(
            f"the light of level {int(np.argmax(ranges)) + 1} varies by {max(ranges):.0%} along "
            f"the sensor; it must vary by at most {MAX_ILLUMINATION_RANGE:.0%}: put the lamp "
            "farther away, or a diffuser before it"
        )
    relative_variance = np.array(
        [
            np.median((flat.variance / flat.frames + dark.variance / dark.frames)[usable]) / top**2
            for flat, top in zip(flats, level, strict=True)
        ]
    )
    weights = 1.0 / relative_variance
    all_responses = np.array(responses)
    response = np.average(all_responses, axis=0, weights=weights)
    dead = ~stuck & ((response < MIN_RESPONSE) | (response > 1.0 / MIN_RESPONSE))
    misfit = np.abs(all_responses - response) / np.maximum(response, MIN_RESPONSE)
    limit = np.maximum(NONLINEAR_PART, 6.0 * np.sqrt(relative_variance))[:, None]
    nonlinear = ~stuck & ~dead & (misfit > limit).any(axis=0)

    bad = np.zeros(pixels, np.uint8)
    for kind, where in (
        (BadPixel.STUCK, stuck), (BadPixel.HOT, hot), (BadPixel.NOISY, noisy),
        (BadPixel.DEAD, dead), (BadPixel.NONLINEAR, nonlinear),
    ):  # fmt: skip
        bad[where] |= np.uint8(kind)
    good = bad == 0
    share = float(np.mean(~good))
    if share > MAX_BAD_SHARE:
        raise InvalidParameter(
            f"{share:.0%} of the pixels are bad; at most {MAX_BAD_SHARE:.0%} may be: was the scene "
            "still, and the light even and steady?"
        )
    response = response / float(np.mean(response[good]))
    response_sigma = float(np.sqrt(1.0 / weights.sum()))
    prnu2 = float(np.var(response[good])) - response_sigma**2
    dark_variance = float(np.median(dark.variance[good]))
    dsnu2 = float(np.var(offset[good])) - dark_variance / dark.frames
    current = None
    if other_dark is not None:
        current = _dark_current(dark, exposure_s, other_dark, other_exposure_s)
    total = dark.frames + sum(flat.frames for flat in flats)
    return RadiometricCalibration(
        dark_offset=offset.copy(),
        response=np.where(good, response, np.maximum(response, 0.0)),
        gain_electrons_per_count=gain,
        read_noise_counts=float(np.sqrt(np.mean(dark.variance[good]))),
        saturation_counts=int(full_scale_counts),
        linearity=linearity,
        bad_pixels=bad,
        captures=total + (other_dark.frames if other_dark is not None else 0),
        dsnu_counts=float(np.sqrt(max(dsnu2, 0.0))),
        prnu=float(np.sqrt(max(prnu2, 0.0))),
        response_sigma=response_sigma,
        linearity_error=linearity_error,
        illumination_range=max(ranges),
        dark_current_counts_per_s=current,
        exposure_s=exposure_s,
        temperature_c=temperature_c,
    )


def _check_captures(
    dark: CaptureStatistics, flats: Sequence[CaptureStatistics], full_scale: int
) -> None:
    require(1 <= full_scale <= 65535, "be in 1 .. 65535", full_scale_counts=full_scale)
    if len(flats) < MIN_FLATS:
        raise InvalidParameter(
            f"there are {len(flats)} levels of light; there must be {MIN_FLATS} or more, as a dim "
            "and a bright one"
        )
    pixels = len(dark.mean)
    require(pixels >= MIN_PIXELS, f"be {MIN_PIXELS} or more", pixels=pixels)
    median = float(np.median(dark.mean))
    for number, one in enumerate((dark, *flats)):
        name = f"flat captures of level {number}" if number else "dark captures"
        if one.frames < MIN_CAPTURES:
            raise InvalidParameter(
                f"there are {one.frames} {name}; there must be {MIN_CAPTURES} or more"
            )
        if len(one.mean) != pixels:
            raise InvalidParameter(
                f"the {name} have {len(one.mean)} pixels, the dark ones {pixels}; they must be of "
                "one sensor"
            )
        if number == 0:
            continue
        share = float(np.mean(one.maximum >= full_scale))
        if share > _MAX_SATURATED:
            raise InvalidParameter(
                f"{share:.0%} of the pixels reach {full_scale} counts in the {name}; at most "
                f"{_MAX_SATURATED:.0%} may: use less light or a shorter exposure"
            )
        light = float(np.median(one.mean)) - median
        noise = float(np.sqrt(np.median(dark.variance)))
        if light < 10.0 * noise:
            raise InvalidParameter(
                f"the {name} lie {light:.3g} counts above the dark ones; they must lie "
                f"{10.0 * noise:.3g} counts above or more: use more light"
            )


def _find_stuck(dark: CaptureStatistics, flats: Sequence[CaptureStatistics]) -> NDArray[np.bool_]:
    """Return the pixels whose count is the same in all captures, but for one count."""
    lowest = np.min([dark.minimum, *(flat.minimum for flat in flats)], axis=0)
    highest = np.max([dark.maximum, *(flat.maximum for flat in flats)], axis=0)
    return np.asarray(highest - lowest <= 1.0)


def _is_hot(dark: CaptureStatistics) -> NDArray[np.bool_]:
    # By neighbours: a smooth offset along the sensor makes no pixel hot.
    excess = dark.mean - running_median(dark.mean)
    noise = np.median(dark.variance) / dark.frames
    sigma = np.hypot(MAD_TO_SIGMA * np.median(np.abs(excess)), np.sqrt(noise))
    floor = np.sqrt(np.median(dark.variance))
    return np.asarray(excess > max(HOT_SIGMA * float(sigma), float(floor)))


def _is_noisy(dark: CaptureStatistics) -> NDArray[np.bool_]:
    # Successive differences share captures: 2/3 as many degrees of freedom.
    dof = 2.0 / 3.0 * (dark.frames - 1)
    limit = max(float(chi2.isf(_FALSE_RATE, dof)) / dof, NOISY_FACTOR**2)
    return np.asarray(dark.variance > limit * np.median(dark.variance))


def _linearise(net: Array, linearity: tuple[float, float]) -> Array:
    first, second = linearity
    return net * (1.0 + first * net + second * net**2)


def _linearity(
    level: Array, relative_light: Sequence[float] | None
) -> tuple[tuple[float, float], float | None]:
    """Return the coefficients of ``level -> light`` and EMVA's linearity error.

    Raises:
        InvalidParameter: the light's ratios are not one positive number for each level.
    """
    if relative_light is None:
        return (0.0, 0.0), None
    light = np.asarray(relative_light, dtype=np.float64)
    if light.shape != level.shape or not (np.isfinite(light).all() and (light > 0.0).all()):
        raise InvalidParameter(
            f"relative_light is {list(relative_light)}; it must be {len(level)} positive numbers, "
            "one for each level"
        )
    # Relative deviations weigh alike (EMVA 1288 release 4).
    ratio = level / light
    slope = float(ratio.sum() / (ratio**2).sum())
    error = float(np.mean(np.abs(slope * ratio - 1.0)))
    if len(level) < MIN_LINEARITY_FLATS:
        return (0.0, 0.0), error
    # light / level = a (1 + c1 level + c2 level^2)
    unit = float(level.max())
    y = level / unit
    design = np.column_stack([np.ones_like(y), y, y**2])
    target = light / level
    coefficients = np.linalg.lstsq(design / target[:, None], np.ones_like(y), rcond=None)[0]
    first, second = (
        coefficients[1] / coefficients[0] / unit,
        coefficients[2] / coefficients[0] / unit**2,
    )
    return (float(first), float(second)), error


def _photon_transfer(
    level: Array,
    noise_added: Array,
    usable: NDArray[np.bool_],
    flats: Sequence[CaptureStatistics],
) -> float:
    """Return the electrons per count by the photon transfer curve.

    Raises:
        InvalidParameter: the noise does not rise with the light, or falls at one level.
    """
    variance = np.mean(noise_added[:, usable], axis=1)
    factor = variance / level
    typical = float(np.median(factor))
    require(typical > 0.0, "rise with the light", variance=typical)
    low = np.flatnonzero(factor < 0.5 * np.max(factor))
    if low.size:
        number = int(low[0]) + 1
        raise InvalidParameter(
            f"the noise of level {number} is {variance[number - 1]:.3g} counts^2 at "
            f"{level[number - 1]:.4g} counts, half of what the other levels say or less: pixels "
            "are saturated, or the light of another level flickers; use less light, or a steady "
            "lamp"
        )
    counted = level <= 0.7 * level.max()
    if not counted.any():
        counted = np.ones(len(level), bool)
    frames = np.array([flat.frames for flat in flats], dtype=np.float64)
    # The variance of a variance grows with its square.
    weights = np.where(counted, frames / variance**2, 0.0)
    slope = float((weights * level * variance).sum() / (weights * level**2).sum())
    return 1.0 / slope


def _check_light_in_the_dark(
    dark: CaptureStatistics, usable: NDArray[np.bool_], gain: float
) -> None:
    """Refuse dark captures in which mean and variance rise together along the sensor.

    A hot pixel stands alone; light covers several, and brings photon noise.

    Raises:
        InvalidParameter: there is light.
    """
    base = float(np.quantile(dark.mean[usable], 0.25))
    smooth = running_median(dark.mean)
    excess = smooth - base
    noise = float(np.sqrt(np.median(dark.variance)))
    sigma = MAD_TO_SIGMA * float(np.median(np.abs(dark.mean - smooth)[usable]))
    lit = usable & (excess > 5.0 * max(sigma, noise / np.sqrt(dark.frames)) + 1.0)
    if int(lit.sum()) < 3:
        return
    quiet = usable & (excess < float(np.median(excess)) + sigma)
    added = float(np.mean(dark.variance[lit]) - np.mean(dark.variance[quiet]))
    light = float(np.mean(dark.mean[lit]) - np.mean(dark.mean[quiet]))
    error = float(np.mean(dark.variance[lit])) * np.sqrt(3.0 / dark.frames / int(lit.sum()))
    if added > 0.5 * light / gain and added > 4.0 * error:
        first = int(np.flatnonzero(lit)[0])
        raise InvalidParameter(
            f"there is light in the dark captures: {int(lit.sum())} pixels, the first of them "
            f"{first}, lie {light:.3g} counts above the others and have light's noise; cover the "
            "sensor"
        )


def _smooth_light(counts: Array, usable: NDArray[np.bool_]) -> Array:
    """Return the smooth variation of light along the sensor: a robust polynomial.

    Raises:
        InvalidParameter: it falls to nothing.
    """
    x = np.linspace(-1.0, 1.0, len(counts))
    basis = legendre.legvander(x, ILLUMINATION_DEGREE)
    weights = usable.astype(np.float64)
    light = np.full(len(counts), float(np.median(counts[usable])))
    for _ in range(10):
        residual = counts - light
        sigma = MAD_TO_SIGMA * float(np.median(np.abs(residual[usable])))
        weights = usable * biweight(residual / max(sigma, 1e-9 * float(np.max(counts))))
        root = np.sqrt(weights)
        coefficients = np.linalg.lstsq(basis * root[:, None], counts * root, rcond=None)[0]
        light = basis @ coefficients
    lowest = float(light.min())
    if lowest <= 0.0:
        raise InvalidParameter(
            f"the light of a level falls to {lowest:.3g} counts along the sensor; it must reach "
            "all pixels"
        )
    return np.asarray(light)


def running_median(values: Array, half: int = 15) -> Array:
    """Return the median of each pixel's neighbourhood, shape (N,).

    Args:
        values: of the pixels, shape (N,).
        half: pixels to either side.
    """
    return np.asarray(median_filter(values, 2 * half + 1, mode="mirror"))


def _dark_current(
    dark: CaptureStatistics,
    exposure_s: float | None,
    other: CaptureStatistics,
    other_exposure_s: float | None,
) -> Array:
    # As EMVA 1288 section 7.1, by two exposure times.
    if exposure_s is None or other_exposure_s is None or exposure_s == other_exposure_s:
        raise InvalidParameter(
            f"the dark captures have the exposure times {exposure_s} s and {other_exposure_s} s; "
            "for the dark current they must be known and different"
        )
    if other.frames < MIN_CAPTURES or len(other.mean) != len(dark.mean):
        raise InvalidParameter(
            f"there are {other.frames} dark captures of {len(other.mean)} pixels with the other "
            f"exposure time; there must be {MIN_CAPTURES} or more of {len(dark.mean)}"
        )
    return np.asarray((other.mean - dark.mean) / (other_exposure_s - exposure_s))
