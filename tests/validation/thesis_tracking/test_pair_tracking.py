"""Two targets along one sensor: window, gaps, subsets, and the velocity-change test."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from validation.thesis_tracking.gap_filling import fill_gaps
from validation.thesis_tracking.pair_tracker import Decision
from validation.thesis_tracking.pair_tracking import PairTracking, PairTracks
from validation.thesis_tracking.quadratic_window import QuadraticWindow
from validation.thesis_tracking.subsets import order_by_detection

Array = NDArray[np.float64]

INTERVAL_S = 1.0 / 30.0
TURN_SCANS = 60
AMPLITUDE_PX = 100.0
SPEED_PX_S = 2.0 * np.pi * AMPLITUDE_PX / (TURN_SCANS * INTERVAL_S)


def circling(scans: int = 200, phase: float = 0.05) -> Array:
    """Return the positions of both ends of a turning bar, (N, 2)."""
    angle = 2.0 * np.pi * np.arange(scans) / TURN_SCANS + phase
    return np.column_stack(
        [200.0 - AMPLITUDE_PX * np.cos(angle), 200 + AMPLITUDE_PX * np.cos(angle)]
    )


def tracked(positions: Array, decision: Decision = "velocity", limit: float = 0.5) -> PairTracks:
    method = PairTracking(limit * SPEED_PX_S, INTERVAL_S, decision=decision)
    return method.run(order_by_detection(positions))


coefficient = st.floats(-100.0, 100.0)


@given(coefficient, coefficient, coefficient, st.integers(3, 12), st.integers(3, 9))
def test_the_window_continues_a_parabola(
    a: float, b: float, c: float, scans: int, points: int
) -> None:
    t = np.arange(scans + 1.0)
    values = a + b * t + c * t**2
    fit = QuadraticWindow(points).fit(values[:-1])
    assert fit.next_position == pytest.approx(values[-1], abs=1e-6)
    assert fit.position == pytest.approx(values[-2], abs=1e-6)
    assert fit.velocity == pytest.approx(b + 2.0 * c * t[-2], abs=1e-6)
    assert fit.acceleration == pytest.approx(2.0 * c, abs=1e-6)


def test_few_points_are_a_line_or_stay() -> None:
    window = QuadraticWindow()
    assert window.next_position([4.0]) == pytest.approx(4.0)
    assert window.next_position([4.0, 7.0]) == pytest.approx(10.0)
    with pytest.raises(InvalidParameter, match="no positions"):
        window.fit([])


def test_the_window_is_the_least_squares_of_the_last_points_only() -> None:
    values = np.random.default_rng(2).normal(size=20)
    fitted = np.polynomial.Polynomial.fit(np.arange(7), values[-7:], 2)
    assert QuadraticWindow().next_position(values) == pytest.approx(float(fitted(7.0)))
    assert QuadraticWindow(5).next_position(values) != pytest.approx(float(fitted(7.0)))


def test_gaps_continue_the_motion_before_them() -> None:
    t = np.arange(20.0)
    values = 3.0 + 2.0 * t - 0.1 * t**2
    holed = values.copy()
    holed[[0, 8, 9, 15]] = np.nan
    found = fill_gaps(holed)
    assert found.created.tolist() == [k in (8, 9, 15) for k in range(20)]
    assert np.isnan(found.position_px[0])
    np.testing.assert_allclose(found.position_px[1:], values[1:], atol=1e-9)


def test_a_long_gap_runs_away_where_the_curve_bends() -> None:
    """What section 6.1.3 says of its own gap filling."""
    values = circling(60)[:, 0]
    holed = values.copy()
    holed[20:24] = np.nan
    error = np.abs(fill_gaps(holed).position_px - values)[20:24]
    assert (np.diff(error) > 0.0).all()
    assert error[-1] > 4.0 * error[0]


def test_subsets_are_the_left_and_the_right_one() -> None:
    subsets = order_by_detection(np.array([[5.0, 2.0], [np.nan, 4.9], [3.0, np.nan], [1.0, 6.0]]))
    np.testing.assert_array_equal(subsets, [[2, 5], [np.nan, 4.9], [3, np.nan], [1, 6]])
    first = order_by_detection(np.array([[5.0, 2.0], [np.nan, 4.9]]), "first")
    np.testing.assert_array_equal(first[1], [4.9, np.nan])


@pytest.mark.parametrize("decision", ["velocity", "prediction"])
def test_identity_is_kept_through_crossings(decision: Decision) -> None:
    truth = circling()
    found = tracked(truth, decision)
    # Scans in which the targets are apart: at a crossing one point may be the wrong one's.
    apart = np.abs(truth[:, 0] - truth[:, 1]) > 25.0
    np.testing.assert_allclose(found.position_px[apart], truth[apart], atol=1e-9)
    crossed = int((np.diff(np.sign(truth[:, 1] - truth[:, 0])) != 0.0).sum())
    assert crossed == 7
    assert (found.switched.sum(axis=0) == crossed).all()


@given(st.floats(0.0, 2.0 * np.pi / TURN_SCANS), st.floats(0.2, 0.8))
def test_velocity_keeps_identity_wherever_the_crossing_falls(phase: float, limit: float) -> None:
    truth = circling(100, phase + 0.3)
    found = tracked(truth, limit=limit).position_px
    apart = np.abs(truth[:, 0] - truth[:, 1]) > 25.0
    np.testing.assert_allclose(found[apart], truth[apart], atol=1e-9)


def test_a_crossing_midway_makes_a_spike_by_velocity_and_none_by_prediction() -> None:
    """Figure 6.6: one wrong point, as the sign of the velocity changes a scan late."""
    truth = circling(100, 2.0 * np.pi / TURN_SCANS * 0.4999)
    wrong = {
        decision: np.abs(tracked(truth, decision).position_px - truth).max(axis=1)
        for decision in ("velocity", "prediction")
    }
    assert wrong["prediction"].max() < 1e-9
    spikes = np.flatnonzero(wrong["velocity"] > 1e-9)
    assert len(spikes)
    # Once a crossing, and never two scans in a row: the direction changes "temporarily".
    assert len(spikes) <= 3
    assert (np.diff(spikes) > 1).all()


def test_a_limit_above_twice_the_velocity_misses_every_crossing() -> None:
    truth = circling()
    found = tracked(truth, limit=2.1)
    assert not found.switched.any()
    np.testing.assert_allclose(found.position_px, np.sort(truth, axis=1))


def test_a_limit_below_the_motions_own_change_goes_over_at_the_ends() -> None:
    """At an end the sign changes too; only the limit keeps the track."""
    assert (tracked(circling(), limit=0.01).switched.sum(axis=0) > 6).all()


def test_predictions_are_a_fraction_of_a_pixel_off() -> None:
    """Section 6.1.3: "acceptable, not exceeding a fraction of a pixel"."""
    truth = circling()
    found = tracked(truth, "prediction")
    error = np.abs(found.predicted_px[7:] - truth[7:])
    assert error.max() < 1.0


def test_a_target_covered_while_crossing_is_made_up() -> None:
    truth = circling()
    seen = truth.copy()
    covered = np.abs(truth[:, 0] - truth[:, 1]) < 12.0
    seen[covered] = np.column_stack([seen[covered].mean(axis=1), np.full(covered.sum(), np.nan)])
    found = tracked(seen, "prediction")
    assert found.created.any()
    # Made up points stay near for so long; the identities are those of the start.
    assert np.abs(found.position_px - truth).max() < 15.0


def test_refused() -> None:
    with pytest.raises(InvalidParameter, match="velocity_limit_px_s is 0"):
        PairTracking(0.0, 0.1)
    with pytest.raises(InvalidParameter, match="points is 2"):
        PairTracking(1.0, 0.1, points=2)
    with pytest.raises(InvalidParameter, match="first scan"):
        PairTracking(1.0, 0.1).run(np.array([[1.0, np.nan], [1.0, 2.0]]))
    with pytest.raises(InvalidParameter, match="one of"):
        order_by_detection(np.zeros((1, 2)), "last")  # type: ignore[arg-type]
