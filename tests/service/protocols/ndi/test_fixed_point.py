"""Numbers of fixed width."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.protocols.ndi.tracking import TooLarge, millimetres, unit


@given(st.floats(-9.99994, 9.99994))
def test_units_come_back(value: float):
    text = unit(value)
    assert len(text) == 6
    assert text[0] in "+-"
    assert int(text) * 1e-4 == pytest.approx(value, abs=0.5001e-4)


@given(st.lists(st.floats(-9999.994, 9999.994), max_size=3))
def test_lengths_come_back(values: list[float]):
    text = millimetres(values)
    assert len(text) == 7 * len(values)
    found = [int(text[place : place + 7]) * 1e-2 for place in range(0, len(text), 7)]
    assert found == pytest.approx(values, abs=0.5001e-2)


@pytest.mark.parametrize("value", [9.99995, 10.0, -1e9, math.inf, -math.inf, math.nan])
def test_what_does_not_fit(value: float):
    with pytest.raises(TooLarge):
        unit(value)


@pytest.mark.parametrize("value", [9999.995, -1e4, math.inf, math.nan])
def test_lengths_that_do_not_fit(value: float):
    with pytest.raises(TooLarge):
        millimetres([0.0, value])


def test_nothing_has_no_minus():
    assert unit(-0.00001) == "+00000"
    assert millimetres((-0.001, 12.345, -9999.99)) == "+000000+001234-999999"
