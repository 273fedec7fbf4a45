"""Alignment in time: parabolas exactly, the variance of noise, markers apart, what is missing."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from compute.fusion.alignment import MAX_SIGMA_PX, AlignmentSettings, align

SIGMA = 0.05


def variances(position: np.ndarray) -> np.ndarray:
    return np.full(position.shape, SIGMA**2)


@given(
    at=st.floats(-1.5e-3, 1.5e-3),
    before=st.floats(5e-4, 3e-3),
    after=st.floats(5e-4, 3e-3),
    rate=st.floats(-5000.0, 5000.0),
    bend=st.floats(-5e4, 5e4),
)
def test_a_parabola_is_read_exactly(
    at: float, before: float, after: float, rate: float, bend: float
) -> None:
    times = np.array([at - before, at, at + after])
    position = (700.0 + rate * times + 0.5 * bend * times**2)[:, None, None]
    found = align(tuple(times), position, variances(position))
    assert found.position_px[0, 0] == pytest.approx(700.0, abs=1e-7)
    assert found.rate_px_s[0, 0] == pytest.approx(rate, abs=1e-3)


@pytest.mark.parametrize("at", [0.0, 3e-4, -5e-4])
def test_its_variance_is_that_of_its_noise(at: float) -> None:
    rng = np.random.default_rng(4)
    times = (at - 1e-3, at, at + 1e-3)
    trials = 4000
    position = 500.0 + SIGMA * rng.standard_normal((3, trials, 1))
    found = align(times, position, variances(position))
    stated = found.variance_px2[:, 0]
    np.testing.assert_allclose(stated, stated[0])
    measured = np.var(found.position_px[:, 0])
    assert measured == pytest.approx(stated[0], rel=5.0 * np.sqrt(2.0 / trials))


def test_the_readings_of_a_long_time_count_once_each() -> None:
    """A filter that averages many aligned readings has the noise of as many raw ones."""
    rng = np.random.default_rng(5)
    count, step = 400, 1e-3
    raw = SIGMA * rng.standard_normal((count, 300))
    aligned = [
        align((-0.6 * step, 0.4 * step, 1.4 * step), raw[k - 1 : k + 2, :, None],
              variances(raw[k - 1 : k + 2, :, None])).position_px[:, 0]
        for k in range(1, count - 1)
    ]  # fmt: skip
    means = np.mean(aligned, axis=0)
    assert np.std(means) == pytest.approx(SIGMA / np.sqrt(count), rel=0.15)


def test_markers_that_cross_keep_their_rates() -> None:
    times = np.array([-1.2e-3, -2e-4, 8e-4])
    courses = np.array([[900.0, 4000.0], [903.0, -4000.0], [905.0, 0.0]])
    position = (courses[:, 0] + courses[:, 1] * times[:, None])[:, None, :]
    # As detection does: in ascending order, whichever marker it is.
    position = np.sort(position, axis=2)
    found = align(tuple(times), position, variances(position))
    rates = dict(zip(np.round(found.position_px[0], 6), found.rate_px_s[0], strict=True))
    assert rates == {
        start: pytest.approx(rate, abs=1e-3) for start, rate in ((900.0, 4000.0),
        (903.0, -4000.0), (905.0, 0.0))
    }  # fmt: skip


def test_two_peaks_that_claim_one_have_it_neither() -> None:
    """Two markers that were one peak before and after: what they did between is not known."""
    position = np.array([[[500.0, np.nan]], [[502.9, 503.1]], [[506.0, np.nan]]])
    at_once = align((-1e-3, 0.0, 1e-3), position, variances(position))
    np.testing.assert_allclose(at_once.position_px[0], [502.9, 503.1])
    np.testing.assert_array_equal(at_once.rate_px_s, 0.0)
    later = align((-1.4e-3, -4e-4, 6e-4), position, variances(position))
    assert np.isnan(later.position_px).all()


@pytest.mark.parametrize(("missing", "other"), [(0, 2), (2, 0)])
def test_with_one_neighbour_it_goes_along_a_line(missing: int, other: int) -> None:
    times = np.array([-8e-4, 2e-4, 1.2e-3])
    position = (300.0 + 2000.0 * times)[:, None, None]
    position[missing] = np.nan
    found = align(tuple(times), position, variances(position))
    assert found.position_px[0, 0] == pytest.approx(300.0)
    assert found.rate_px_s[0, 0] == pytest.approx(2000.0)
    settings = AlignmentSettings()
    bend = settings.max_acceleration_px_s2 / 6.0 * times[1] * times[other]
    assert found.variance_px2[0, 0] >= bend**2


def test_alone_it_stays_where_time_has_hardly_passed_and_goes_otherwise() -> None:
    position = np.full((3, 1, 1), np.nan)
    position[1] = 200.0
    near = align((-1e-3, 1e-6, 1e-3), position, variances(position))
    assert near.position_px[0, 0] == 200.0
    assert SIGMA**2 < near.variance_px2[0, 0] < MAX_SIGMA_PX**2
    far = align((-1e-3, 4e-4, 2e-3), position, variances(position))
    assert np.isnan(far.position_px[0, 0])


def test_times_that_do_not_rise_are_refused() -> None:
    position = np.zeros((3, 1, 1))
    with pytest.raises(InvalidParameter, match="rise"):
        align((0.0, 0.0, 1.0), position, variances(position))


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(InvalidParameter, match="max_rate_px_s"):
        AlignmentSettings(max_rate_px_s=0.0)
