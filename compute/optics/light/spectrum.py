"""Spectra, filter and quantum efficiency: what of the light makes electrons."""

from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.constants import c, h, k

from compute.errors import InvalidParameter
from compute.optics.light.light_source import LightSource
from compute.optics.parameter_checks import check_not_negative, check_positive

Array = NDArray[np.float64]

_REACH_FWHM: Final = 2.5  # of a Gaussian, 4e-9 lie farther out


class Spectrum(Protocol):
    """How photons are distributed over the wavelengths."""

    def nodes(self) -> tuple[Array, Array]:
        """Return wavelengths [nm] and shares of the photons, adding up to 1, shape (K,)."""
        ...


@dataclass(frozen=True)
class LineSpectrum:
    """The Gaussian spectrum of an LED.

    Args:
        wavelength_nm: its mean [nm].
        width_nm: full width at half maximum [nm]; zero: a single wavelength.

    Raises:
        InvalidParameter: a wavelength that is not positive, a negative width.
    """

    wavelength_nm: float
    width_nm: float

    def __post_init__(self) -> None:
        check_positive(self, "wavelength_nm")
        check_not_negative(self, "width_nm")

    def nodes(self) -> tuple[Array, Array]:
        """Return wavelengths [nm] and shares of the photons, adding up to 1, shape (K,)."""
        offset = np.linspace(-_REACH_FWHM, _REACH_FWHM, 501)
        share = np.exp2(-((2.0 * offset) ** 2))
        return self.wavelength_nm + self.width_nm * offset, share / share.sum()


@dataclass(frozen=True)
class BlackBodySpectrum:
    """Ambient light of a glowing body (daylight is near 5800 K, a lamp near 2800 K).

    Args:
        temperature_k: of the body [K].
        from_nm: shortest wavelength that reaches the sensor [nm].
        to_nm: longest wavelength that counts [nm]; silicon ends near 1100.

    Raises:
        InvalidParameter: a value that is not positive, or wavelengths in the wrong order.
    """

    temperature_k: float
    from_nm: float = 350.0
    to_nm: float = 1150.0

    def __post_init__(self) -> None:
        check_positive(self, "temperature_k", "from_nm", "to_nm")
        if not self.from_nm < self.to_nm:
            raise InvalidParameter(
                f"to_nm is {self.to_nm}; it must be above from_nm, {self.from_nm}",
                to_nm=self.to_nm,
            )

    def nodes(self) -> tuple[Array, Array]:
        """Return wavelengths [nm] and shares of the photons, adding up to 1, shape (K,).

        Planck's law divided by the energy of a photon, as 1/wavelength^4.
        """
        wavelength = np.linspace(self.from_nm, self.to_nm, 2001)
        exponent = h * c / (wavelength * 1e-9 * k * self.temperature_k)
        # By logarithms, against the overflow of a cold body; the largest share is 1.
        log = -4.0 * np.log(wavelength) - exponent - np.log(-np.expm1(-exponent))
        share = np.exp(log - log.max())
        return wavelength, share / share.sum()


@dataclass(frozen=True)
class BandpassFilter:
    """An interference filter with a flat top.

    ``T = blocking + (peak - blocking) 2^-(2 (wavelength - centre) / width)^4``, the fourth power
    as of two cavities. Its shift with the angle of the light is left out.

    Args:
        centre_nm: centre of the band [nm].
        width_nm: width of the band at half its height [nm].
        peak: transmission at the centre, above 0, at most 1.
        blocking: transmission far from it, 0 to the peak.

    Raises:
        InvalidParameter: a value outside of this.
    """

    centre_nm: float
    width_nm: float
    peak: float = 0.9
    blocking: float = 1e-4

    def __post_init__(self) -> None:
        check_positive(self, "centre_nm", "width_nm", "peak")
        if self.peak > 1.0:
            raise InvalidParameter(f"peak is {self.peak}; it must be at most 1", peak=self.peak)
        if not 0.0 <= self.blocking <= self.peak:
            raise InvalidParameter(
                f"blocking is {self.blocking}; it must be from 0 to the peak, {self.peak}",
                blocking=self.blocking,
            )

    def transmission(self, wavelength_nm: Array) -> Array:
        """Return the transmission at wavelengths, any shape."""
        offset = 2.0 * (wavelength_nm - self.centre_nm) / self.width_nm
        band = np.exp2(-(offset**4))
        return np.asarray(self.blocking + (self.peak - self.blocking) * band)


@dataclass(frozen=True)
class QuantumEfficiency:
    """Electrons per photon by wavelength, linear between the given ones and zero outside.

    Args:
        wavelengths_nm: ascending, two or more [nm].
        efficiencies: at these wavelengths, 0 to 1.

    Raises:
        InvalidParameter: wavelengths out of order, efficiencies out of range or number.
    """

    wavelengths_nm: tuple[float, ...]
    efficiencies: tuple[float, ...]

    def __post_init__(self) -> None:
        wavelength, efficiency = np.array(self.wavelengths_nm), np.array(self.efficiencies)
        if len(wavelength) < 2 or not (np.diff(wavelength) > 0.0).all() or not wavelength[0] > 0:
            raise InvalidParameter(
                f"wavelengths_nm is {self.wavelengths_nm}; it must have two or more, positive "
                "and ascending",
                wavelengths_nm=self.wavelengths_nm,
            )
        in_range = bool(((efficiency >= 0.0) & (efficiency <= 1.0)).all())
        if len(efficiency) != len(wavelength) or not in_range:
            raise InvalidParameter(
                f"efficiencies is {self.efficiencies}; it must have a value from 0 to 1 for each "
                "wavelength",
                efficiencies=self.efficiencies,
            )

    def at(self, wavelength_nm: Array) -> Array:
        """Return electrons per photon at wavelengths, any shape."""
        return np.asarray(
            np.interp(wavelength_nm, self.wavelengths_nm, self.efficiencies, left=0.0, right=0.0)
        )


def electrons_per_photon(
    spectrum: Spectrum, efficiency: QuantumEfficiency, bandpass: BandpassFilter | None = None
) -> float:
    """Return the electrons that a photon of a spectrum makes on average behind a filter."""
    wavelength, share = spectrum.nodes()
    passed = share * efficiency.at(wavelength)
    if bandpass is not None:
        passed = passed * bandpass.transmission(wavelength)
    return float(passed.sum())


def photoelectrons_per_sr(
    source: LightSource,
    points_mm: Array,
    facing: Array | None,
    lens_positions_mm: Array,
    exposure_s: float,
    *,
    efficiency: QuantumEfficiency,
    bandpass: BandpassFilter | None = None,
) -> Array:
    """Return the electrons that markers' light can make in an exposure, per steradian.

    Times the effective solid angle of a pixel, it is the mean of the pixel's electrons.

    Args:
        source: the markers' light; points, facing, lenses and exposure as it says.
        efficiency: of the sensor.
        bandpass: the filter before it; None: none.

    Returns:
        Shape (N, S) [1/sr].
    """
    spectrum = LineSpectrum(source.wavelength_nm, source.spectral_width_nm)
    light = source.photons_per_sr(points_mm, facing, lens_positions_mm, exposure_s)
    return light * electrons_per_photon(spectrum, efficiency, bandpass)
