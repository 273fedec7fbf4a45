"""Blooming: charge conserved, the least flow, the simple cases by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compute.optics.detector_array import bloom

WELL = 100.0
charges = st.lists(st.floats(0.0, 900.0), min_size=1, max_size=40)


def test_one_full_pixel_by_hand() -> None:
    """40 of the excess of 100 go to the neighbours, 20 to each; 60 are drained."""
    kept, flow = bloom(np.array([10.0, 200.0, 30.0]), np.array([True, True]), WELL, 0.4)
    np.testing.assert_allclose(kept, [30.0, 100.0, 50.0])
    np.testing.assert_allclose(flow, [0.0, 100.0, 0.0])


def test_charge_passes_through_a_neighbour_that_fills_up() -> None:
    """f1 = 100 + f2/4, f2 = (90 + f1/4 - 100): two full pixels that exchange charge."""
    kept, flow = bloom(np.array([0.0, 200.0, 90.0, 0.0]), np.full(3, True), WELL, 0.5)
    first, second = np.linalg.solve([[1.0, -0.25], [-0.25, 1.0]], [100.0, -10.0])
    np.testing.assert_allclose(flow, [0.0, first, second, 0.0])
    np.testing.assert_allclose(kept, [0.25 * first, 100.0, 100.0, 0.25 * second])


def test_without_blooming_the_excess_is_drained() -> None:
    charge = np.array([50.0, 400.0, 99.0])
    np.testing.assert_array_equal(
        bloom(charge, np.full(2, True), WELL, 0.0)[0], np.minimum(charge, WELL)
    )


def test_charge_does_not_cross_to_another_line() -> None:
    linked = np.array([True, False, True])
    kept, _ = bloom(np.array([0.0, 500.0, 0.0, 0.0]), linked, WELL, 1.0)
    assert kept[2:].tolist() == [0.0, 0.0]


def test_all_of_the_excess_stays_on_the_line_where_nothing_is_drained() -> None:
    charge = np.zeros(201)
    charge[100] = 2000.0
    kept, _ = bloom(charge, np.full(200, True), WELL, 1.0)
    assert kept.sum() == pytest.approx(2000.0)
    np.testing.assert_allclose(kept, kept[::-1], atol=1e-9)
    assert kept[91:110].min() == pytest.approx(WELL)


@given(charges, st.floats(0.0, 1.0), st.data())
def test_what_flows_is_accounted_for(
    charges: list[float], share: float, data: st.DataObject
) -> None:
    charge = np.array(charges)
    size = len(charge) - 1
    linked = np.array(data.draw(st.lists(st.booleans(), min_size=size, max_size=size)), dtype=bool)
    kept, flow = bloom(charge, linked, WELL, share)
    assert (kept <= WELL).all()
    assert (kept >= -1e-9).all()
    assert (flow >= 0.0).all()
    # Only a full well passes charge on.
    np.testing.assert_allclose(kept[flow > 0.0], WELL, rtol=1e-9)
    # Collected = kept + drained + over the ends of the line.
    over_ends = 0.5 * share * (flow[0] + flow[-1])
    over_ends += 0.5 * share * (flow[:-1][~linked].sum() + flow[1:][~linked].sum())
    drained = (1.0 - share) * flow.sum()
    assert charge.sum() == pytest.approx(kept.sum() + drained + over_ends, abs=1e-6)


@given(charges, st.floats(0.0, 0.95))
def test_it_is_where_spilling_pixel_by_pixel_ends(charges: list[float], share: float) -> None:
    """The end does not depend on the order in which the pixels spill: here, all at once."""
    charge = np.array(charges)
    kept, _ = bloom(charge, np.full(len(charge) - 1, True), WELL, share)
    spilled = charge.copy()
    for _ in range(2000):
        excess = np.maximum(spilled - WELL, 0.0)
        if excess.max() < 1e-9:
            break
        spilled -= excess
        spilled[1:] += 0.5 * share * excess[:-1]
        spilled[:-1] += 0.5 * share * excess[1:]
    np.testing.assert_allclose(kept, spilled, atol=1e-5)
