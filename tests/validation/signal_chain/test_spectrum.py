"""Filter and quantum efficiency against spectra."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from compute.optics.light.emission import CosinePower
from compute.optics.light.led import Led
from validation.signal_chain.spectrum import (
    BandpassFilter,
    LineSpectrum,
    QuantumEfficiency,
    electrons_per_photon,
    photoelectrons_per_sr,
)

ALL = QuantumEfficiency((100.0, 3000.0), (1.0, 1.0))
SILICON = QuantumEfficiency((400.0, 650.0, 950.0, 1100.0), (0.4, 0.6, 0.2, 0.0))
BAND = BandpassFilter(940.0, 60.0, 0.9, 1e-4)


def test_a_line_has_its_mean_and_its_width() -> None:
    wavelength, share = LineSpectrum(950.0, 40.0).nodes()
    assert share.sum() == pytest.approx(1.0)
    mean = (wavelength * share).sum()
    assert mean == pytest.approx(950.0)
    sigma = np.sqrt(((wavelength - mean) ** 2 * share).sum())
    assert sigma == pytest.approx(40.0 / (2.0 * np.sqrt(2.0 * np.log(2.0))), rel=1e-4)


@given(st.floats(1.0, 200.0), st.floats(0.1, 1.0))
def test_the_band_is_as_wide_and_high_as_told(width_nm: float, peak: float) -> None:
    band = BandpassFilter(900.0, width_nm, peak, 0.0)
    at = 900.0 + width_nm * np.array([-5.0, -0.5, 0.0, 0.5, 5.0])
    np.testing.assert_allclose(
        band.transmission(at), peak * np.array([0, 0.5, 1, 0.5, 0]), rtol=1e-9
    )


def test_efficiency_is_read_between_its_wavelengths() -> None:
    np.testing.assert_allclose(
        SILICON.at(np.array([399.0, 400.0, 800.0, 1025.0, 1101.0])), [0.0, 0.4, 0.4, 0.1, 0.0]
    )


def test_electrons_are_photons_times_filter_times_efficiency() -> None:
    line = LineSpectrum(930.0, 0.0)
    band = float(BAND.transmission(np.array(930.0)))
    due = band * float(SILICON.at(np.array(930.0)))
    assert electrons_per_photon(line, SILICON, BAND) == pytest.approx(due, rel=1e-12)
    led = Led(0.02, 930.0, CosinePower(0.3))
    points, lenses = np.array([[0.0, 0.0, 900.0]]), np.zeros((2, 3))
    light = led.photons_per_sr(points, None, lenses, 1e-3)
    made = photoelectrons_per_sr(led, points, None, lenses, 1e-3, efficiency=SILICON, bandpass=BAND)
    np.testing.assert_allclose(made, due * light)


def test_a_wide_source_loses_more_than_a_narrow_one() -> None:
    passed = [electrons_per_photon(LineSpectrum(940.0, width), ALL, BAND) for width in (0, 30, 90)]
    assert passed[0] == pytest.approx(0.9)
    assert passed[0] > passed[1] > passed[2] > 0.4


def test_blocking_alone_passes_far_off_the_band() -> None:
    led = LineSpectrum(950.0, 40.0)
    far = BandpassFilter(2000.0, 10.0, 0.9, 1e-3)
    assert electrons_per_photon(led, SILICON, far) == pytest.approx(
        1e-3 * electrons_per_photon(led, SILICON), rel=1e-9
    )


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: BandpassFilter(0.0, 10.0), "centre_nm"),
        (lambda: BandpassFilter(900.0, -1.0), "width_nm"),
        (lambda: BandpassFilter(900.0, 10.0, 1.1), "peak"),
        (lambda: BandpassFilter(900.0, 10.0, 0.5, 0.6), "blocking"),
        (lambda: BandpassFilter(900.0, 10.0, 0.5, -0.1), "blocking"),
        (lambda: LineSpectrum(-1.0, 0.0), "wavelength_nm"),
        (lambda: LineSpectrum(900.0, -1.0), "width_nm"),
        (lambda: QuantumEfficiency((900.0,), (0.1,)), "wavelengths_nm"),
        (lambda: QuantumEfficiency((900.0, 800.0), (0.1, 0.1)), "wavelengths_nm"),
        (lambda: QuantumEfficiency((800.0, 900.0), (0.1, 1.1)), "efficiencies"),
        (lambda: QuantumEfficiency((800.0, 900.0), (0.1,)), "efficiencies"),
    ],
)
def test_values_without_meaning_are_refused(make: object, field: str) -> None:
    with pytest.raises(InvalidParameter, match=f"{field} is"):
        make()  # type: ignore[operator]
