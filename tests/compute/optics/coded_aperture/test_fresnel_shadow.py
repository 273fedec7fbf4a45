"""Diffraction at slits against Huygens' integral, its limits, and the table against both."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.optics.coded_aperture.coded_window import CodedWindow, maximal_length_code
from compute.optics.coded_aperture.fresnel_shadow import DiffractedShadow
from compute.optics.coded_aperture.geometric_shadow import GeometricShadow
from tests.compute.optics.coded_aperture.slit_diffraction import (
    code_edges_mm,
    slit_field,
    slit_intensity,
)

Array = NDArray[np.float64]

GAP = 10.0
WAVELENGTH = 0.9e-3
WINDOW = CodedWindow(maximal_length_code(6), 0.1, GAP)

_PANEL, _PANEL_WEIGHT = leggauss(8)
NODES = ((np.arange(100) + 0.5)[:, None] / 50 - 1.0 + _PANEL / 100).ravel()
WEIGHTS = np.tile(_PANEL_WEIGHT / 100, 100)
"""Quadrature on (-1, 1) in a hundred panels."""


def huygens(pixel_mm: float, source: tuple[float, float], edges: Array, wavelength: float) -> float:
    """Integrate the waves of a line source over the slits, with exact distances.

    Kirchhoff's integral in two dimensions, relative to the wave without a mask. Coordinates
    on the mask's axis; the source lies at (x, z), the pixel at (pixel_mm, -GAP).
    """
    x, z = source
    node, weight = NODES, WEIGHTS
    field = 0.0 + 0.0j
    wave = 2.0 * np.pi / wavelength
    direct = np.hypot(pixel_mm - x, z + GAP)
    for start, end in edges.reshape(-1, 2):
        at = (start + end) / 2 + node * (end - start) / 2
        before, behind = np.hypot(at - x, z), np.hypot(at - pixel_mm, GAP)
        lean = (z / before + GAP / behind) / 2.0
        phase = np.exp(1j * wave * (before + behind - direct))
        field += (lean * phase / np.sqrt(before * behind)) @ weight * (end - start) / 2
    return float(abs(field * np.sqrt(direct / (1j * wavelength))) ** 2)


@pytest.mark.parametrize(("angle_deg", "one_wave", "led"), [(0, 0.08, 0.02), (25, 0.25, 0.1)])
def test_slits_diffract_as_huygens_says(angle_deg: float, one_wave: float, led: float) -> None:
    """The closed form keeps the path to second order: far edges come with a wrong phase.

    In the light of an LED, 50 nm wide, those cancel. Prints what is left.
    """
    edges = np.array([-0.6, -0.2, 0.0, 0.35, 0.45, 0.8])
    z, slope = 1000.0, np.tan(np.deg2rad(angle_deg))
    crossing = np.linspace(-0.9, 1.1, 31)
    source = (slope * z, z)
    pixel = crossing - (source[0] - crossing) * GAP / z
    cosine = 1.0 / np.sqrt(1.0 + ((source[0] - crossing) / z) ** 2)
    curvature = cosine**3 * (1.0 / GAP + 1.0 / z)
    steps = np.linspace(-3.0, 3.0, 49)
    bell = np.exp(-(steps**2) / 2) / np.exp(-(steps**2) / 2).sum()
    expected, found = np.zeros((49, 31)), np.zeros((49, 31))
    for number, step in enumerate(steps):
        wavelength = WAVELENGTH * np.exp(step * 50.0 / 900.0 / 2.3548)
        expected[number] = [huygens(at, source, edges, wavelength) for at in pixel]
        width = np.sqrt(wavelength / curvature)
        found[number] = [
            slit_intensity(np.array([at]), edges, float(each))[0]
            for at, each in zip(crossing, width, strict=True)
        ]
    error = abs(found - expected)[24].max(), abs(bell @ (found - expected)).max()
    print(f"{angle_deg} deg: off Huygens by {error[0]:.3f} (one wavelength), {error[1]:.3f} (LED)")
    assert error[0] < one_wave
    assert error[1] < led
    assert np.ptp(expected[24]) > 1.0


def test_short_waves_leave_the_geometric_shadow() -> None:
    edges = np.array([-0.5, -0.1, 0.2, 0.9])
    place = np.array([-0.7, -0.45, -0.3, -0.15, 0.05, 0.3, 0.6, 1.0])
    lit = np.array([0, 1, 1, 1, 0, 1, 1, 0])
    error = [
        abs(slit_intensity(place, edges, width) - lit).max() for width in (0.1, 1e-2, 1e-3, 1e-4)
    ]
    assert error[0] > 0.2
    assert (np.diff(error) < 0.0).all()
    assert error[-1] < 3e-3  # of an edge, at most sqrt(2)/pi x width / distance


@settings(max_examples=15, deadline=None)
@given(
    bars=st.lists(st.floats(0.05, 0.3), min_size=2, max_size=4).filter(lambda b: len(b) % 2 == 0),
    width=st.floats(0.06, 0.12),
)
def test_slits_let_through_the_light_that_falls_on_them(bars: list[float], width: float) -> None:
    edges, reach, step = np.cumsum(bars), 10.0, 1e-3
    place = np.arange(edges.mean() - reach, edges.mean() + reach, step)
    passed = slit_intensity(place, edges, width).sum() * step
    # Beyond the reach E edges leave at most (E width)^2 / (pi^2 reach), if all are in phase.
    tail = (len(edges) * width) ** 2 / (np.pi**2 * reach)
    open_mm = (edges[1::2] - edges[::2]).sum()
    assert open_mm - 2.0 * tail - 1e-4 < passed < open_mm + 1e-3


def test_a_wide_opening_changes_nothing() -> None:
    field = slit_field(np.linspace(-1.0, 1.0, 9), np.array([-1e6, 1e6]), 0.1)
    np.testing.assert_allclose(field, 1.0, atol=1e-6)


def direct_mean(
    at: float, width: float, blur: float, square: float, deviation: float, window: CodedWindow
) -> float:
    """Average the closed form over pixel, penumbra and spectrum by quadrature."""
    node, weight = leggauss(4)
    fine, fine_weight = leggauss(8)
    place = at + node[:, None] * width / 2 + fine * blur / 2
    share = (weight[:, None] * fine_weight / 4.0).ravel()
    waves = np.linspace(-4.0, 4.0, 61) if deviation else np.zeros(1)
    bell = np.exp(-(waves**2) / 2) / np.exp(-(waves**2) / 2).sum()
    return float(
        sum(
            part
            * (
                share
                @ slit_intensity(
                    place.ravel(), code_edges_mm(window), np.sqrt(square * np.exp(wave * deviation))
                )
            )
            for part, wave in zip(bell, waves, strict=True)
        )
    )


@pytest.mark.parametrize(
    ("spectral_nm", "width", "blur"),
    [(50.0, 0.01, 0.003), (50.0, 0.03, 0.1), (2.0, 0.007, 0.02), (0.0, 0.014, 0.005)],
)
def test_the_table_is_the_closed_form_averaged(
    spectral_nm: float, width: float, blur: float
) -> None:
    shadow = DiffractedShadow(
        WINDOW, wavelength_nm=900.0, spectral_width_nm=spectral_nm, finest_mm=width
    )
    rng = np.random.default_rng(5)
    place, curvature = rng.uniform(-3.2, 3.2, 6), rng.uniform(0.05, 0.13, 6)
    one = np.ones(6)
    found = shadow.mean_transmission(place, width * one, blur * one, curvature)
    deviation = spectral_nm / 900.0 / 2.3548
    expected = [
        direct_mean(at, width, blur, WAVELENGTH / bend, deviation, WINDOW)
        for at, bend in zip(place, curvature, strict=True)
    ]
    np.testing.assert_allclose(found, expected, atol=5e-3)
    plain = GeometricShadow(WINDOW).mean_transmission(place, width * one, blur * one, curvature)
    assert abs(plain - expected).max() > 10 * 5e-3


def test_the_table_does_not_depend_on_what_was_asked_before() -> None:
    def shadow() -> DiffractedShadow:
        return DiffractedShadow(WINDOW, wavelength_nm=900.0, spectral_width_nm=50.0, finest_mm=0.01)

    place, one = np.linspace(-4.0, 4.0, 300), np.ones(300)
    bend = np.linspace(0.09, 0.11, 300)
    fresh = shadow().mean_transmission(place, 0.01 * one, 0.01 * one, bend)
    used = shadow()
    for other in (0.05, 0.15):
        used.mean_transmission(place, 0.01 * one, 0.01 * one, other * one)
    again = used.mean_transmission(place, 0.01 * one, 0.01 * one, bend)
    np.testing.assert_array_equal(fresh, again)


@pytest.mark.parametrize("bend", [0.04, 0.1, 0.15])
def test_the_table_keeps_all_light(bend: float) -> None:
    shadow = DiffractedShadow(WINDOW, wavelength_nm=900.0, spectral_width_nm=50.0, finest_mm=0.01)
    place = np.arange(-5.5, 5.5, 0.01)
    one = np.ones_like(place)
    passed = shadow.mean_transmission(place, 0.01 * one, 0.003 * one, bend * one).sum() * 0.01
    assert passed == pytest.approx(sum(WINDOW.code) * WINDOW.bar_mm, rel=5e-3)


def test_the_table_tends_to_the_geometric_shadow() -> None:
    window = CodedWindow((1, 0, 1, 1, 0), 0.2, 2.0)
    place = np.arange(-0.7, 0.7, 0.01)
    one = np.ones_like(place)
    given_ = (place, 0.01 * one, 0.01 * one, one / 2.0)
    plain = GeometricShadow(window).mean_transmission(*given_)
    rms = []
    for wavelength in (900.0, 90.0, 9.0):
        shadow = DiffractedShadow(
            window, wavelength_nm=wavelength, spectral_width_nm=0.05 * wavelength, finest_mm=0.01
        )
        rms.append(float(np.sqrt(((shadow.mean_transmission(*given_) - plain) ** 2).mean())))
    assert rms[0] > 0.1
    assert rms[1] < 0.6 * rms[0]
    assert rms[2] < 0.5 * rms[1]


@settings(max_examples=50, deadline=None)
@given(
    code=st.lists(st.sampled_from([0, 1]), min_size=1, max_size=30).filter(any),
    at=st.floats(-4.0, 4.0),
    width=st.floats(1e-3, 0.5),
    blur=st.floats(0.0, 0.5),
)
def test_a_geometric_shadow_is_the_overlap_with_the_bars(
    code: list[int], at: float, width: float, blur: float
) -> None:
    window = CodedWindow(tuple(code), 0.13, 1.0)
    found = GeometricShadow(window).mean_transmission(
        np.array([at]), np.array([width]), np.array([blur]), np.array([1.0])
    )[0]
    node, weight = (np.arange(400) + 0.5) / 400 - 0.5, 1 / 400
    low, high = at - width / 2 + node * blur, at + width / 2 + node * blur
    lit = np.zeros_like(low)
    for start, end in code_edges_mm(window).reshape(-1, 2):
        lit += np.maximum(np.minimum(high, end) - np.maximum(low, start), 0.0)
    # The sum over the penumbra may miss an edge by one of its 400 steps, per edge within reach.
    allowed = 1e-6 + 0.5 / 400 * min(1.0, blur / width / 400) * len(code_edges_mm(window))
    assert found == pytest.approx((lit * weight).sum() / width, abs=allowed)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("wavelength_nm", 0.0),
        ("wavelength_nm", np.nan),
        ("finest_mm", 0.0),
        ("spectral_width_nm", -1.0),
        ("spectral_width_nm", 451.0),
    ],
)
def test_light_without_meaning_is_refused(field: str, value: float) -> None:
    good = {"wavelength_nm": 900.0, "spectral_width_nm": 50.0, "finest_mm": 0.01}
    with pytest.raises(InvalidParameter, match=f"{field} is {value}"):
        DiffractedShadow(WINDOW, **{**good, field: value})


def test_a_code_too_long_for_its_fringes_is_refused() -> None:
    window = CodedWindow(maximal_length_code(14), 0.1, 0.01)
    with pytest.raises(InvalidParameter, match="shorten the code"):
        DiffractedShadow(window, wavelength_nm=900.0, spectral_width_nm=0.0, finest_mm=0.001)
