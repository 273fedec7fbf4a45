"""Blinking codes: their distances, and markers told by them through drops and false peaks."""

from itertools import product

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.tracking.blink_codes import BlinkCodes, blink_codes
from compute.tracking.blink_decoding import BlinkModel, identify_blinking_markers

Array = NDArray[np.float64]

CODES = blink_codes(12, 18, 5)
SMALL = blink_codes(8, 13, 4)


def turned(word: str, shift: int) -> str:
    return word[shift:] + word[:shift]


def differences(one: str, other: str) -> int:
    return sum(a != b for a, b in zip(one, other, strict=True))


def shown(
    codes: BlinkCodes,
    phase: NDArray[np.intp],
    scans: int,
    rng: np.random.Generator,
    missed: float = 0.0,
    false: float = 0.0,
    low: float = 0.0,
) -> Array:
    """Amplitudes of all markers, each of a brightness of its own, shape (M, scans)."""
    marker = np.arange(len(codes))[:, None]
    on = codes.bits[marker, (phase[:, None] + np.arange(scans)) % codes.length]
    bright = np.exp(rng.normal(0.0, 1.0, (len(codes), 1)))
    own = bright * np.where(on, 1.0, low) * np.exp(0.1 * rng.standard_normal(on.shape))
    stray = np.exp(rng.uniform(-2.3, 2.3, on.shape))
    chance = rng.random(on.shape)
    if low > 0.0:
        return np.where(chance < missed, np.nan, own)
    return np.where(
        on, np.where(chance < missed, np.nan, own), np.where(chance < false, stray, np.nan)
    )


@given(st.integers(1, 12), st.integers(6, 12), st.integers(1, 5), st.booleans())
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.filter_too_much])
def test_codes_keep_their_distance(markers: int, length: int, distance: int, cyclic: bool) -> None:
    """Compared as texts, word by word and turn by turn."""
    assume(distance <= length)
    try:
        codes = blink_codes(markers, length, distance, cyclic=cyclic)
    except InvalidParameter:
        assume(False)
    assert len(set(codes.words)) == markers
    least = length
    for (a, one), (b, other) in product(enumerate(codes.words), repeat=2):
        for shift in range(length if cyclic else 1):
            if (a, shift) != (b, 0):
                least = min(least, differences(one, turned(other, shift)))
    assert codes.minimum_distance == least >= distance


def test_what_has_not_its_distance_is_refused() -> None:
    with pytest.raises(InvalidParameter, match="least distance is 1"):
        BlinkCodes(("0011", "0111", "1100"), 3, cyclic=False)
    # Four apart as they stand, the same after a turn.
    BlinkCodes(("0011", "1100"), 4, cyclic=False)
    with pytest.raises(InvalidParameter, match="least distance is 0"):
        BlinkCodes(("0011", "1100"), 1)
    # A word that is its own turn says nothing of the phase.
    with pytest.raises(InvalidParameter, match="least distance is 0"):
        BlinkCodes(("0101",), 1)
    with pytest.raises(InvalidParameter, match="lengths"):
        BlinkCodes(("01", "011"), 1)
    with pytest.raises(InvalidParameter, match="other characters"):
        BlinkCodes(("012",), 1)
    with pytest.raises(InvalidParameter, match="markers need longer words"):
        blink_codes(50, 8, 4)
    for wrong in ({"length": 21}, {"markers": 0}, {"distance": 14}):
        with pytest.raises(InvalidParameter):
            blink_codes(**({"markers": 2, "length": 13, "distance": 3} | wrong))


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.1), st.floats(0.0, 0.1))
@settings(max_examples=40, deadline=None)
def test_markers_are_named_rightly_or_not_at_all(seed: int, missed: float, false: float) -> None:
    rng = np.random.default_rng(seed)
    phase = rng.integers(0, CODES.length, len(CODES))
    seen = shown(CODES, phase, 2 * CODES.length, rng, missed, false)
    order = rng.permutation(len(CODES))
    found = identify_blinking_markers(CODES, seen[order])
    named = found.marker >= 0
    assert named.mean() > 0.7
    # At 0.001 each, of twelve: two wrong ones come once in ten thousand.
    assert (found.marker[named] != order[named]).sum() <= 1
    right = found.marker == order
    np.testing.assert_array_equal(found.phase[right], phase[order][right])


def test_a_single_word_is_enough_without_errors() -> None:
    rng = np.random.default_rng(1)
    phase = rng.integers(0, CODES.length, len(CODES))
    found = identify_blinking_markers(CODES, shown(CODES, phase, CODES.length, rng))
    np.testing.assert_array_equal(found.marker, np.arange(len(CODES)))
    np.testing.assert_array_equal(found.phase, phase)
    assert (found.errors == 0).all()
    assert (found.confidence > 0.999).all()


def test_errors_are_counted() -> None:
    rng = np.random.default_rng(2)
    phase = np.zeros(len(CODES), dtype=np.intp)
    seen = shown(CODES, phase, 2 * CODES.length, rng)
    lit = np.flatnonzero(np.isfinite(seen[3]))[:2]
    dark = np.flatnonzero(np.isnan(seen[3]))[:1]
    seen[3, lit], seen[3, dark] = np.nan, 1.0
    found = identify_blinking_markers(CODES, seen)
    assert found.marker[3] == 3
    assert found.errors[3] == 3
    assert found.errors.sum() == 3


def test_half_a_word_is_not_enough_unless_the_phase_is_known() -> None:
    rng = np.random.default_rng(3)
    phase = np.zeros(len(SMALL), dtype=np.intp)
    short = shown(SMALL, phase, 8, rng)
    free = identify_blinking_markers(SMALL, short, BlinkModel(confidence_threshold=0.9))
    known = identify_blinking_markers(SMALL, short, BlinkModel(confidence_threshold=0.9), phase=0)
    assert (free.marker >= 0).sum() < (known.marker >= 0).sum()
    named = known.marker >= 0
    np.testing.assert_array_equal(known.marker[named], np.flatnonzero(named))
    later = identify_blinking_markers(SMALL, shown(SMALL, phase + 5, 26, rng), phase=5 + 13)
    np.testing.assert_array_equal(later.marker, np.arange(len(SMALL)))


def test_lights_that_do_not_blink_a_word_are_not_named() -> None:
    rng = np.random.default_rng(4)
    steady = np.exp(0.1 * rng.standard_normal((50, 36)))
    steady[rng.random(steady.shape) < 0.05] = np.nan
    chance = np.where(
        rng.random((300, 36)) < 0.5, np.exp(rng.uniform(-2.0, 2.0, (300, 36))), np.nan
    )
    for lights in (steady, chance, np.full((1, 36), np.nan)):
        assert (identify_blinking_markers(CODES, lights).marker < 0).all()


def test_markers_that_only_get_fainter() -> None:
    """A third of the light in "off" scans: told by the amplitudes alone."""
    rng = np.random.default_rng(5)
    phase = rng.integers(0, CODES.length, len(CODES))
    seen = shown(CODES, phase, 2 * CODES.length, rng, missed=0.05, low=0.33)
    found = identify_blinking_markers(
        CODES, seen, BlinkModel(off_level=0.33, log_amplitude_sigma=0.15)
    )
    np.testing.assert_array_equal(found.marker, np.arange(len(CODES)))
    assert (found.errors <= 1).all()
    # By a model that expects darkness, each is named rightly or not at all.
    dark = identify_blinking_markers(CODES, seen).marker
    named = dark >= 0
    assert named.sum() < len(CODES)
    np.testing.assert_array_equal(dark[named], np.flatnonzero(named))


def test_sensors_add_up_and_one_that_sees_nothing_says_nothing() -> None:
    rng = np.random.default_rng(6)
    phase = rng.integers(0, SMALL.length, len(SMALL))
    lines = [shown(SMALL, phase, SMALL.length, rng, 0.25, 0.1) for _ in range(3)]
    how = BlinkModel(miss_probability=0.25, false_alarm_probability=0.1)
    one = identify_blinking_markers(SMALL, lines[0], how)
    blind = np.full_like(lines[0], np.nan)
    np.testing.assert_allclose(
        identify_blinking_markers(SMALL, np.stack([lines[0], blind], axis=1), how).confidence,
        one.confidence,
    )
    three = identify_blinking_markers(SMALL, np.stack(lines, axis=1), how)
    assert (three.marker >= 0).sum() > (one.marker >= 0).sum()
    named = three.marker >= 0
    np.testing.assert_array_equal(three.marker[named], np.flatnonzero(named))


def test_of_two_lights_of_one_name_neither_is_named_unless_one_is_likelier() -> None:
    rng = np.random.default_rng(7)
    phase = np.zeros(len(CODES), dtype=np.intp)
    seen = shown(CODES, phase, 2 * CODES.length, rng)
    twice = np.concatenate([seen, seen[:1]])
    found = identify_blinking_markers(CODES, twice)
    assert found.marker[0] == found.marker[-1] == -1
    np.testing.assert_array_equal(found.marker[1:-1], np.arange(1, len(CODES)))
    worse = twice.copy()
    worse[-1, np.flatnonzero(np.isfinite(worse[-1]))[:4]] = np.nan
    found = identify_blinking_markers(CODES, worse)
    assert found.marker[0] == 0
    assert found.marker[-1] == -1


def test_brightness_and_unit_do_not_matter() -> None:
    rng = np.random.default_rng(8)
    seen = shown(CODES, np.arange(len(CODES)), 36, rng, 0.1, 0.1)
    one, other = (
        identify_blinking_markers(CODES, seen),
        identify_blinking_markers(CODES, 4096.0 * seen),
    )
    np.testing.assert_allclose(one.confidence, other.confidence)
    np.testing.assert_array_equal(one.marker, other.marker)


def test_requests_that_mean_nothing() -> None:
    fixed = BlinkCodes(("0011", "1100"), 4, cyclic=False)
    with pytest.raises(InvalidParameter, match="phase"):
        identify_blinking_markers(fixed, np.ones((1, 4)))
    with pytest.raises(InvalidParameter, match="not positive"):
        identify_blinking_markers(CODES, np.zeros((1, 18)))
    with pytest.raises(InvalidParameter, match="shape"):
        identify_blinking_markers(CODES, np.ones(18))
    with pytest.raises(InvalidParameter, match="miss_probability is 1"):
        BlinkModel(miss_probability=1.0)
    with pytest.raises(InvalidParameter, match="log_amplitude_sigma"):
        BlinkModel(off_level=1.0)
