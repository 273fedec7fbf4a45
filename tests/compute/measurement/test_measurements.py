"""Measurements: shapes, weights, refusals, order and density."""

from math import log

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from compute.errors import InvalidParameter
from compute.measurement.flag_policy import STANDARD_POLICY, FlagPolicy
from compute.measurement.measurements import Measurements, check_sensors
from compute.signal.peaks import PeakFlag


def one(flags: int, sigma: float = 0.1, policy: FlagPolicy = STANDARD_POLICY) -> Measurements:
    marks = np.array([[flags]], np.int32)
    return Measurements.of(np.array([[7.0]]), np.array([[sigma]]), marks, policy)


@pytest.mark.parametrize("flag", list(PeakFlag))
def test_one_flag_follows_its_rule(flag: PeakFlag) -> None:
    rule, found = next(rule for rule in STANDARD_POLICY.rules if rule.flag is flag), one(int(flag))
    used = rule.use != "refused"
    assert found.usable[0, 0] == used
    assert found.suspect[0, 0] == (rule.use == "suspect")
    assert found.can_initiate[0, 0] == (used and rule.initiates)
    assert found.shared[0, 0] == rule.shared
    assert found.found_px[0, 0] == 7.0
    if used:
        wanted = (0.1 * rule.sigma_factor) ** 2 + rule.added_sigma_px**2
        assert found.variance_px2[0, 0] == pytest.approx(wanted, rel=1e-14)
        assert found.sigma_px[0, 0] ** 2 == pytest.approx(wanted, rel=1e-14)
    else:
        assert np.isnan(found.position_px[0, 0])
        assert np.isnan(found.sigma_px[0, 0])
        assert found.variance_px2[0, 0] == 1.0


def test_a_clipped_shadow_is_used() -> None:
    shadows = FlagPolicy.of_method("shadow", known_shape=False)
    assert one(int(PeakFlag.CLIPPED), policy=shadows).can_initiate.all()


@given(
    arrays(np.float64, (3, 5), elements=st.floats(0.0, 9.0).map(lambda x: round(x, 1))),
    arrays(np.bool_, (3, 5)),
    arrays(np.int32, (3, 5), elements=st.integers(0, 255)),
    st.permutations(range(5)),
)
def test_sorted_peaks_do_not_depend_on_their_order(position, there, flags, order) -> None:
    rng = np.random.default_rng(0)
    position = np.where(there, position, np.nan)
    sigma = rng.uniform(0.01, 0.2, position.shape)
    flags = np.where(there, flags, 0).astype(np.int32)
    plain = Measurements.of(position, sigma, flags)
    first = plain.sort()
    again = Measurements.of(position[:, order], sigma[:, order], flags[:, order]).sort()
    np.testing.assert_array_equal(first.position_px, again.position_px)
    np.testing.assert_array_equal(first.variance_px2, again.variance_px2)
    assert first.position_px.shape[1] == max(int(plain.count.max()), 1)
    assert (first.count == plain.count).all()
    index = first.original_index
    assert index is not None
    rows = np.arange(3)[:, None]
    np.testing.assert_array_equal(plain.position_px[rows, index], first.position_px)
    np.testing.assert_array_equal(plain.sigma_px[rows, index], first.sigma_px)
    for row, count in zip(first.position_px, first.count, strict=True):
        assert (np.diff(row[:count]) >= 0.0).all()
        assert np.isnan(row[count:]).all()


@given(arrays(np.bool_, (2, 4)), arrays(np.int32, (2, 4), elements=st.integers(0, 255)))
def test_a_part_keeps_indices_and_weights(chosen, flags) -> None:
    position = np.arange(8.0).reshape(2, 4)
    whole = Measurements.of(position, np.full((2, 4), 0.1), flags)
    part = whole.only(chosen)
    assert (part.usable == (whole.usable & chosen)).all()
    np.testing.assert_array_equal(part.position_px[part.usable], position[part.usable])
    np.testing.assert_array_equal(part.variance_px2, np.where(part.usable, whole.variance_px2, 1.0))
    assert not (part.can_initiate & ~chosen).any()
    assert (part.found_px == position).all()


def test_exposures_of_a_batch_are_those_alone() -> None:
    rng = np.random.default_rng(3)
    position = np.where(rng.random((4, 3, 2)) < 0.2, np.nan, rng.uniform(0, 9, (4, 3, 2)))
    sigma, flags = np.full(position.shape, 0.1), rng.integers(0, 256, position.shape)
    marks = np.where(np.isfinite(position), flags, 0).astype(np.int32)
    light = rng.uniform(1.0, 2.0, position.shape)
    batch = Measurements.weigh(position, sigma, marks, light, STANDARD_POLICY)
    for index in range(4):
        alone = Measurements.weigh(
            position[index], sigma[index], marks[index], light[index], STANDARD_POLICY
        )
        for name in ("position_px", "variance_px2", "can_initiate", "suspect", "shared"):
            np.testing.assert_array_equal(
                getattr(batch.exposure(index), name), getattr(alone, name)
            )


def test_readings_of_choices() -> None:
    position = np.array([[3.0, 1.0], [5.0, np.nan]])
    found = Measurements.of(position, np.full((2, 2), 0.1))
    readings, sigma = found.readings(np.array([[0, -1], [1, 0]]))
    np.testing.assert_array_equal(readings, [[3.0, np.nan], [1.0, 5.0]])
    np.testing.assert_array_equal(np.isnan(sigma), np.isnan(readings))
    alone, _ = found.unambiguous_readings()
    np.testing.assert_array_equal(alone, [np.nan, 5.0])
    assert found.is_near(np.array([[2.5, 9.0], [np.nan, 5.0]]), 1.0).tolist() == [
        [True, False],
        [False, True],
    ]


def test_density_of_peaks() -> None:
    position = np.array([[0.0, 10.0, 20.0], [0.0, 10.0, np.nan], [5.0, 5.0, 5.0]])
    found = Measurements.of(position, np.ones((3, 3)))
    assert found.log_density(1e-3, 4.0) == pytest.approx([log(0.1), log(1e-3), log(0.5)])


def test_what_is_not_finite_is_not_used() -> None:
    position, sigma = np.full((1, 3), 7.0), np.array([[np.inf, np.nan, 0.1]])
    assert Measurements.of(position, sigma).usable.tolist() == [[False, False, True]]


@pytest.mark.parametrize(
    ("shape", "sigma", "flags", "message"),
    [
        ((4,), np.ones(4), None, r"\(4,\); it must be \(sensors, peaks\)"),
        ((4, 2), np.ones((4, 3)), None, r"sigma_px has the shape \(4, 3\)"),
        ((4, 2), np.ones((4, 2)), np.zeros((4, 1)), r"peak flags has the shape \(4, 1\)"),
        ((4, 2), np.zeros((4, 2)), None, r"sigma_px\[0, 0\] is 0.0"),
    ],
)
def test_bad_input_is_refused_with_its_value(shape, sigma, flags, message) -> None:
    with pytest.raises(InvalidParameter, match=message):
        Measurements.of(np.full(shape, 7.0), sigma, flags)


def test_measurements_of_other_sensors_are_refused() -> None:
    with pytest.raises(InvalidParameter, match=r"\(1, 1\); it must be \(4, K\)"):
        check_sensors(one(0), 4)
