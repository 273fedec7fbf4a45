"""Spectra, band-pass filter and quantum efficiency: photoelectrons of the light."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.optics.light.light_source import LightSource
from compute.parameter_checks import check_not_negative, check_positive

Array = NDArray[np.float64]

_REACH_FWHM: Final = 2.5  # of a Gaussian, 4e-9 lie farther out


@dataclass(frozen=True)
class LineSpectrum:
    """Gaussian spectrum of an LED.

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
class BandpassFilter:
    """Interference filter with a flat top.

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
    """Quantum efficiency by wavelength, linear between its nodes and zero outside.

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
    spectrum: LineSpectrum, efficiency: QuantumEfficiency, bandpass: BandpassFilter | None = None
) -> float:
    """Return the mean number of electrons per photon of a spectrum behind a filter.

    Args:
        spectrum: of the light.
        efficiency: of the sensor.
        bandpass: filter before it; None: none.
    """
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
    """Return the photoelectrons per steradian of markers in an exposure.

    Times the effective solid angle of a pixel, it is the mean of the pixel's electrons.

    Args:
        source: the markers' light.
        points_mm: positions of N markers, shape (N, 3) [mm].
        facing: directions in which they face, shape (N, 3); None: towards each lens.
        lens_positions_mm: centres of S lenses, shape (S, 3) [mm].
        exposure_s: length of the exposure [s].
        efficiency: of the sensor.
        bandpass: the filter before it; None: none.

    Returns:
        Shape (N, S) [1/sr].
    """
    spectrum = LineSpectrum(source.wavelength_nm, source.spectral_width_nm)
    light = source.photons_per_sr(points_mm, facing, lens_positions_mm, exposure_s)
    return light * electrons_per_photon(spectrum, efficiency, bandpass)
