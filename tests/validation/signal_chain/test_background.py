"""Backgrounds along a line: their shapes, sums, and what is refused."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from validation.signal_chain.background import (
    Background,
    BumpBackground,
    ConstantBackground,
    PolynomialBackground,
    SumBackground,
    background_scans,
)


def test_shapes_by_hand() -> None:
    np.testing.assert_array_equal(ConstantBackground(7.0).electrons(3), [7.0, 7.0, 7.0])
    # x is -1, 0, 1: 10 - x + 2 x^2.
    np.testing.assert_allclose(
        PolynomialBackground((10.0, -1.0, 2.0)).electrons(3), [13.0, 10.0, 11.0]
    )
    bump = BumpBackground(5.0, 2.0, 100.0).electrons(10)
    assert bump[5] == 100.0
    np.testing.assert_allclose(bump[[3, 7]], 100.0 * np.exp(-0.5))


@given(st.lists(st.floats(-100.0, 100.0), min_size=1, max_size=5), st.floats(0.0, 500.0))
def test_a_sum_is_the_sum(coefficients: list[float], level: float) -> None:
    parts: tuple[Background, ...] = (
        PolynomialBackground(tuple(coefficients)),
        ConstantBackground(level),
        BumpBackground(20.0, 5.0, -30.0),
    )
    np.testing.assert_allclose(
        SumBackground(parts).electrons(64),
        parts[0].electrons(64) + parts[1].electrons(64) + parts[2].electrons(64),
    )
    assert SumBackground(()).electrons(4).tolist() == [0.0] * 4


def test_each_sensor_has_its_own_line() -> None:
    lines = background_scans([ConstantBackground(1.0), BumpBackground(3.0, 1.0, 9.0)], 8)
    assert lines.shape == (2, 8)
    assert lines[0].tolist() == [1.0] * 8
    assert lines[1, 3] == 9.0
    assert background_scans([], 8).shape == (0, 8)


def test_a_line_that_is_negative_somewhere_is_refused_with_the_place() -> None:
    falling = PolynomialBackground((3.5, -4.5))
    with pytest.raises(InvalidParameter, match="-1 electrons in pixel 9 of sensor 1"):
        background_scans([ConstantBackground(0.0), falling], 10)


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: ConstantBackground(np.nan), "level_electrons"),
        (lambda: PolynomialBackground(()), "coefficients_electrons"),
        (lambda: PolynomialBackground((1.0, np.inf)), "coefficients_electrons"),
        (lambda: BumpBackground(0.0, 0.0, 1.0), "sigma_px"),
        (lambda: BumpBackground(0.0, -1.0, 1.0), "sigma_px"),
    ],
)
def test_values_without_meaning_are_refused(make: object, field: str) -> None:
    with pytest.raises(InvalidParameter, match=field) as refused:
        make()  # type: ignore[operator]
    assert field in refused.value.context
