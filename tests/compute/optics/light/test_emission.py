"""Patterns of emission: half angles, integrals over the sphere, what is refused."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from compute.errors import InvalidParameter
from compute.optics.light.emission import AngularEmission, CosinePower, EvenEmission


def integral(emission: AngularEmission, kinks: tuple[float, ...] = ()) -> float:
    value, _ = quad(
        lambda angle: float(emission.relative(np.array(np.cos(angle)))) * np.sin(angle),
        0.0,
        np.pi,
        points=(*kinks, np.pi / 2),
        limit=200,
    )
    return 2.0 * np.pi * value


@given(st.floats(0.02, 1.5))
def test_half_of_the_intensity_is_left_at_the_half_angle(half_angle_rad: float) -> None:
    emission = CosinePower(half_angle_rad)
    at = emission.relative(np.array([1.0, np.cos(half_angle_rad), 0.0, -0.4, -1.0]))
    np.testing.assert_allclose(at, [1.0, 0.5, 0.0, 0.0, 0.0], atol=1e-9)


def test_sixty_degrees_are_lamberts_law() -> None:
    emission = CosinePower(np.pi / 3)
    assert emission.exponent == pytest.approx(1.0)


@pytest.mark.parametrize("half_angle_rad", [0.1, 0.314, 1.05, 1.4])
def test_the_solid_angle_is_the_integral_of_the_pattern(half_angle_rad: float) -> None:
    emission = CosinePower(half_angle_rad)
    solid_angle_sr = 2.0 * np.pi / (emission.exponent + 1.0)
    assert solid_angle_sr == pytest.approx(integral(emission, (half_angle_rad,)), rel=1e-6)


def test_an_even_beam_is_as_bright_in_all_directions_in_front_and_dark_behind() -> None:
    at = EvenEmission().relative(np.cos([0.0, 0.5, 1.5, 1.6, 3.0]))
    np.testing.assert_array_equal(at, [1.0, 1.0, 1.0, 0.0, 0.0])
    assert integral(EvenEmission()) == pytest.approx(2.0 * np.pi)


@pytest.mark.parametrize("half_angle_rad", [0.0, -1.0, np.pi / 2, np.nan])
def test_half_angles_without_a_pattern_are_refused(half_angle_rad: float) -> None:
    with pytest.raises(InvalidParameter, match="half_angle_rad is"):
        CosinePower(half_angle_rad)
