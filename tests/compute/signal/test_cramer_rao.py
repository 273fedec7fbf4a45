"""Cramer-Rao bound of a position: closed forms of a Gaussian line, refusals."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from compute.signal.cramer_rao import fisher_information, position_bound


def gaussian(width: float, electrons: float) -> tuple[np.ndarray, np.ndarray]:
    place = np.arange(401) - 200.3
    light = electrons * np.exp(-(place**2) / (2 * width**2)) / (width * np.sqrt(2 * np.pi))
    return light, light * place / width**2


@given(width=st.floats(1.5, 20.0), electrons=st.floats(10.0, 1e7))
def test_a_gaussian_line_in_photon_noise_alone(width: float, electrons: float) -> None:
    bound = position_bound(*gaussian(width, electrons), 0.0, known_brightness=True)
    assert float(bound) == pytest.approx(width / np.sqrt(electrons), rel=1e-3)


@given(width=st.floats(1.5, 20.0), electrons=st.floats(10.0, 1e4))
def test_a_gaussian_line_in_read_noise_alone(width: float, electrons: float) -> None:
    read = 1e5
    expected = read * np.sqrt(4.0 * width**3 * np.sqrt(np.pi)) / electrons
    bound = position_bound(*gaussian(width, electrons), read**2, known_brightness=True)
    assert float(bound) == pytest.approx(expected, rel=1e-3)


def test_position_bound_without_light_is_infinite() -> None:
    assert np.isinf(position_bound(np.zeros(9), np.zeros(9), 0.0))


def test_fisher_information_is_the_weighted_product_of_the_derivatives() -> None:
    rng = np.random.default_rng(2)
    jacobian, variance = rng.normal(size=(5, 3, 40)), rng.uniform(1.0, 9.0, (5, 40))
    expected = (jacobian / variance[:, None]) @ jacobian.transpose(0, 2, 1)
    found = fisher_information(tuple(jacobian.transpose(1, 0, 2)), variance)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("variance", [-1.0, np.nan, np.inf])
def test_position_bound_refuses_a_noise_variance_out_of_range(variance: float) -> None:
    with pytest.raises(InvalidParameter, match="it must be zero or positive"):
        position_bound(np.full(5, 1.0), np.ones(5), variance)
