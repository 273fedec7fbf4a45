"""BarHistory: what it waits for, slots apart, neighbours that are not there."""

import numpy as np
import pytest

from compute.errors import InvalidParameter
from compute.fusion.bar_history import BarExposure, BarHistory

SIGMA = 0.05
STEP_NS = 1_000_000
RATE_PX_S = 1500.0


def exposure(time_ns: int, sensors: int = 2, peaks: int = 1) -> BarExposure[int]:
    position = np.full((sensors, peaks), 100.0 + RATE_PX_S * time_ns * 1e-9)
    position += 300.0 * np.arange(peaks)
    return BarExposure(time_ns, position, np.full(position.shape, SIGMA**2), time_ns)


def history(times: list[int], **of: int) -> BarHistory[int]:
    kept: BarHistory[int] = BarHistory()
    for time_ns in times:
        kept.add(None, exposure(time_ns, **of))
    return kept


def test_readings_are_those_of_the_wanted_time() -> None:
    kept = history([0, STEP_NS, 2 * STEP_NS, 3 * STEP_NS])
    found = kept.at(2_300_000, None)
    assert found is not None
    nearest, aligned = found
    assert nearest.origin == 2 * STEP_NS
    np.testing.assert_allclose(aligned.position_px, 100.0 + RATE_PX_S * 2.3e-3)
    np.testing.assert_allclose(aligned.rate_px_s, RATE_PX_S)


def test_a_clock_that_is_late_is_asked_for_later_times() -> None:
    kept = history([0, STEP_NS, 2 * STEP_NS])
    found = kept.at(1_000_000, None, shift_ns=200_000)
    assert found is not None
    np.testing.assert_allclose(found[1].position_px, 100.0 + RATE_PX_S * 1.2e-3)


def test_it_is_ready_with_the_exposure_behind_the_nearest() -> None:
    kept = history([0, STEP_NS])
    assert not kept.is_ready(900_000, None)
    kept.add(None, exposure(2 * STEP_NS))
    assert kept.is_ready(900_000, None)
    assert not kept.is_ready(1_600_000, None)
    assert not kept.is_ready(900_000, 3)


def test_without_the_one_behind_it_goes_along_a_line() -> None:
    found = history([0, STEP_NS]).at(1_200_000, None)
    assert found is not None
    np.testing.assert_allclose(found[1].position_px, 100.0 + RATE_PX_S * 1.2e-3)
    assert (found[1].variance_px2 > SIGMA**2).all()


def test_what_is_too_far_away_is_not_moved() -> None:
    kept = history([0, STEP_NS])
    assert kept.at(2_500_000, None) is None
    assert BarHistory().at(0, None) is None


def test_slots_are_apart() -> None:
    kept: BarHistory[int] = BarHistory()
    for number in range(6):
        kept.add(number % 2, exposure(number * STEP_NS))
    found = kept.at(2_200_000, 1)
    assert found is not None
    assert found[0].origin in {STEP_NS, 3 * STEP_NS}


def test_exposures_of_different_numbers_of_peaks_go_together() -> None:
    kept: BarHistory[int] = BarHistory()
    for time_ns, peaks in ((0, 3), (STEP_NS, 1), (2 * STEP_NS, 2)):
        kept.add(None, exposure(time_ns, peaks=peaks))
    found = kept.at(1_100_000, None)
    assert found is not None
    assert found[1].position_px.shape == (2, 1)
    np.testing.assert_allclose(found[1].rate_px_s, RATE_PX_S)


def test_a_clock_that_goes_back_begins_anew() -> None:
    kept = history([5 * STEP_NS, 6 * STEP_NS, STEP_NS])
    found = kept.at(6 * STEP_NS, None)
    assert found is not None
    # The only one; alone it is not moved that far.
    assert np.isnan(found[1].position_px).all()
    kept.clear()
    assert kept.newest_ns is None


def test_too_few_are_refused() -> None:
    with pytest.raises(InvalidParameter, match="exposures"):
        BarHistory(2)
