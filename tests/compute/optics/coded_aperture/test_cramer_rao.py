"""The Cramer-Rao bound of a shift, and how far from it plain correlation is."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from compute.optics.coded_aperture.coded_window import CodedWindow, maximal_length_code
from compute.optics.coded_aperture.correlation_decoding import decode_mask
from compute.optics.coded_aperture.cramer_rao import shift_bound_px
from compute.optics.coded_aperture.mask_optics import MaskOptics
from tests.compute.optics.coded_aperture.mask_sensors import sensor_behind


def gaussian(width: float, electrons: float) -> tuple[np.ndarray, np.ndarray]:
    place = np.arange(401) - 200.3
    light = electrons * np.exp(-(place**2) / (2 * width**2)) / (width * np.sqrt(2 * np.pi))
    return light, light * place / width**2


@given(width=st.floats(1.5, 20.0), electrons=st.floats(10.0, 1e7))
def test_a_gaussian_line_in_photon_noise_alone(width: float, electrons: float) -> None:
    bound = shift_bound_px(*gaussian(width, electrons), 0.0)
    assert float(bound) == pytest.approx(width / np.sqrt(electrons), rel=1e-3)


@given(width=st.floats(1.5, 20.0), electrons=st.floats(10.0, 1e4))
def test_a_gaussian_line_in_read_noise_alone(width: float, electrons: float) -> None:
    read = 1e5
    expected = read * np.sqrt(4.0 * width**3 * np.sqrt(np.pi)) / electrons
    bound = shift_bound_px(*gaussian(width, electrons), read)
    assert float(bound) == pytest.approx(expected, rel=1e-3)


def test_nothing_tells_nothing() -> None:
    assert np.isinf(shift_bound_px(np.zeros(9), np.zeros(9), 0.0))


@pytest.mark.parametrize(
    ("electrons", "read"), [(-1.0, 1.0), (1.0, -1.0), (1.0, np.nan), (np.nan, 1)]
)
def test_noise_without_meaning_is_refused(electrons: float, read: float) -> None:
    with pytest.raises(InvalidParameter, match=r"it must be zero or positive"):
        shift_bound_px(np.full(5, electrons), np.ones(5), read)


@pytest.mark.parametrize("read", [10.0, 60.0])
def test_how_far_plain_correlation_is_from_the_bound(read: float) -> None:
    """Prints the deviation of the decoded shift beside the bound, at two places in a pixel."""
    window = CodedWindow(maximal_length_code(6), 0.15, 10.0, 3.0, 1.5)
    optics = MaskOptics(
        window,
        [sensor_behind(10.0)],
        pixel_height_mm=0.2,
        emitter_width_mm=0.5,
        wavelength_nm=900.0,
        spectral_width_nm=50.0,
    )
    x = np.array([0.0, 40.0, 41.0])
    step = 1e-2
    points = np.array([(a + d, 0.0, 2000.0) for a in x for d in (-step, 0.0, step)])
    lines = optics.solid_angles(points).solid_angle_sr[:, 0].reshape(3, 3, -1)
    readings = optics.readings(points)[:, 0].reshape(3, 3)
    scale = 2000.0 / lines.max()
    template = lines[0, 1]
    rng = np.random.default_rng(11)
    for place in (1, 2):
        mean = scale * lines[place, 1]
        slope = (
            scale * (lines[place, 2] - lines[place, 0]) / (readings[place, 2] - readings[place, 0])
        )
        bound = float(shift_bound_px(mean, slope, read))
        noisy = rng.poisson(mean, (400, mean.size)) + read * rng.standard_normal((400, mean.size))
        shift = decode_mask(noisy, template).shift_px
        ratio = float(shift.std(ddof=1)) / bound
        bias = float(shift.mean()) - (readings[place, 1] - readings[0, 1])
        print(
            f"read noise {read:.0f}: bound {bound:.4f} px, correlation {ratio:.2f} of it, ", end=""
        )
        print(f"off by {bias:+.4f} px")
        # 400 draws know a deviation to 3.5 %: nothing unbiased is below the bound.
        assert ratio > 0.85
        assert ratio < 5.0
        assert abs(bias) < 0.25
