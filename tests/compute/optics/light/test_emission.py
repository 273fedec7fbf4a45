"""Patterns of emission: half angles, integrals over the sphere, what is refused."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from compute.errors import InvalidParameter
from compute.optics.light.emission import AngularEmission, CosinePower, TabulatedEmission

TABLE = TabulatedEmission((0.0, 0.2, 0.5, 1.2), (4.0, 3.6, 1.0, 0.1))


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
    assert emission.solid_angle_sr == pytest.approx(np.pi)


@pytest.mark.parametrize("half_angle_rad", [0.1, 0.314, 1.05, 1.4])
def test_the_solid_angle_is_the_integral_of_the_pattern(half_angle_rad: float) -> None:
    emission = CosinePower(half_angle_rad)
    assert emission.solid_angle_sr == pytest.approx(integral(emission, (half_angle_rad,)), rel=1e-6)


def test_a_table_is_read_between_its_angles_and_is_dark_beyond() -> None:
    at = TABLE.relative(np.cos([0.0, 0.1, 0.35, 1.2, 1.21, 2.0]))
    np.testing.assert_allclose(at, [1.0, 0.95, 0.575, 0.025, 0.0, 0.0], atol=1e-9)
    assert TABLE.solid_angle_sr == pytest.approx(integral(TABLE, TABLE.angles_rad[1:]), rel=1e-9)


@pytest.mark.parametrize("half_angle_rad", [0.0, -1.0, np.pi / 2, np.nan])
def test_half_angles_without_a_pattern_are_refused(half_angle_rad: float) -> None:
    with pytest.raises(InvalidParameter, match="half_angle_rad is"):
        CosinePower(half_angle_rad)


@pytest.mark.parametrize(
    ("angles", "intensities", "field"),
    [
        ((0.0,), (1.0,), "angles_rad"),
        ((0.1, 0.2), (1.0, 1.0), "angles_rad"),
        ((0.0, 0.2, 0.2), (1.0, 1.0, 1.0), "angles_rad"),
        ((0.0, 1.6), (1.0, 1.0), "angles_rad"),
        ((0.0, np.nan), (1.0, 1.0), "angles_rad"),
        ((0.0, 0.2), (1.0,), "intensities"),
        ((0.0, 0.2), (0.0, 1.0), "intensities"),
        ((0.0, 0.2), (1.0, -0.1), "intensities"),
        ((0.0, 0.2), (1.0, np.inf), "intensities"),
    ],
)
def test_tables_without_meaning_are_refused(
    angles: tuple[float, ...], intensities: tuple[float, ...], field: str
) -> None:
    with pytest.raises(InvalidParameter, match=f"{field} is"):
        TabulatedEmission(angles, intensities)
