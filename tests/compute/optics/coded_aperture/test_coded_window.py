"""Coded windows: what is refused, and what makes a maximal-length code one."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from compute.optics.coded_aperture.coded_window import CodedWindow, maximal_length_code
from tests.compute.optics.coded_aperture.slit_diffraction import code_edges_mm


@pytest.mark.parametrize("order", range(2, 12))
def test_all_shifts_of_a_maximal_length_code_correlate_alike(order: int) -> None:
    code = 2 * np.array(maximal_length_code(order)) - 1
    own = [int(code @ np.roll(code, shift)) for shift in range(len(code))]
    assert own[0] == len(code) == 2**order - 1
    assert set(own[1:]) == {-1}


@given(code=st.lists(st.sampled_from([0, 1]), min_size=1, max_size=60).filter(any))
def test_the_edges_bound_the_transparent_bars(code: list[int]) -> None:
    window = CodedWindow(tuple(code), 0.1, 5.0)
    edges = code_edges_mm(window).reshape(-1, 2)
    middles = (np.arange(len(code)) + 0.5 - len(code) / 2) * 0.1
    inside = [bool(((edges[:, 0] < x) & (x < edges[:, 1])).any()) for x in middles]
    assert inside == [bit == 1 for bit in code]
    assert np.diff(edges, axis=1).sum() == pytest.approx(0.1 * sum(code))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("code", ()),
        ("code", (1, 2)),
        ("code", (0, 0)),
        ("bar_mm", 0.0),
        ("bar_mm", np.nan),
        ("gap_mm", 0.0),
        ("gap_mm", -1.0),
        ("gap_mm", np.inf),
        ("plate_thickness_mm", -0.1),
        ("plate_thickness_mm", np.nan),
        ("plate_index", 0.99),
        ("plate_index", np.nan),
        ("height_mm", 0.0),
    ],
)
def test_a_window_that_cannot_be_is_refused(field: str, value: object) -> None:
    good: dict[str, object] = {"code": (1, 0, 1), "bar_mm": 0.1, "gap_mm": 5.0}
    with pytest.raises(InvalidParameter, match=f"{field} (is|has) ") as refused:
        CodedWindow(**{**good, field: value})  # type: ignore[arg-type]
    assert field in refused.value.context


@pytest.mark.parametrize("order", [1, 17])
def test_an_order_out_of_range_is_refused(order: int) -> None:
    with pytest.raises(InvalidParameter, match=f"order is {order}; it must be 2 to 16"):
        maximal_length_code(order)
