"""Close peaks taken apart: the text's rules by hand, and what must not change."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from compute.errors import InvalidParameter
from compute.signal.thesis_pipeline.peak_separation import SlopeExtension, ValleyCut
from compute.signal.thesis_pipeline.signal_chain import SignalChain
from tests.compute.signal.thesis_pipeline.pipeline_scans import compact_peak

METHODS: list[ValleyCut] = [ValleyCut(0.0), SlopeExtension(0.0)]
random_lines = arrays(np.float64, 60, elements=st.floats(-50.0, 100.0, width=32))


@settings(max_examples=80, deadline=None)
@given(random_lines, st.floats(0.0, 0.9), st.floats(0.0, 0.5))
def test_whatever_the_line_pieces_are_finite_and_in_order(
    line: np.ndarray, level: float, min_depth: float
) -> None:
    for method in (ValleyCut(level, min_depth), SlopeExtension(level, min_depth)):
        segments = method.separate(line)
        tops = [piece.top_px for piece in segments]
        assert tops == sorted(set(tops))
        for piece in segments:
            assert np.isfinite(piece.values).all()
            assert (piece.values >= 0.0).all()
            assert piece.first_px <= piece.top_px <= piece.last_px
            # Nothing that was measured is changed.
            own = slice(piece.first_px, piece.last_px + 1)
            above = np.maximum(line - level * max(line.max(), 0.0), 0.0)
            np.testing.assert_array_equal(piece.values[own], above[own])
            assert piece.values.max() == above[own].max()
        result = SignalChain(separation=method, threshold_fraction=0.0).run(line)
        assert np.isfinite(result.peaks.position_px[0, : result.peaks.count[0]]).all()


@pytest.mark.parametrize("method", METHODS, ids=["valley", "slopes"])
@settings(max_examples=40, deadline=None)
@given(centre=st.floats(20.0, 40.0), gap=st.floats(17.0, 60.0), height=st.floats(0.3, 3.0))
def test_peaks_that_do_not_overlap_are_unchanged(
    method: ValleyCut, centre: float, gap: float, height: float
) -> None:
    one = 100.0 * compact_peak(centre, 8.0, 128)
    other = 100.0 * height * compact_peak(centre + gap, 8.0, 128)
    segments = method.separate(one + other)
    assert len(segments) == 2
    for piece, peak in zip(segments, (one, other), strict=True):
        np.testing.assert_array_equal(piece.values, peak)
        assert not piece.cut_left
        assert not piece.cut_right


def on_line(*values: float) -> np.ndarray:
    return np.array([0.0, 0.0, 0.0, *values, 0.0, 0.0, 0.0, 0.0])


def test_a_valley_parts_and_belongs_to_both() -> None:
    line = on_line(2.0, 8.0, 10.0, 6.0, 9.0, 4.0)
    left, right = ValleyCut(0.0).separate(line)
    assert left.values[3:9].tolist() == [2.0, 8.0, 10.0, 6.0, 0.0, 0.0]
    assert right.values[3:9].tolist() == [0.0, 0.0, 0.0, 6.0, 9.0, 4.0]
    assert (left.cut_left, left.cut_right, right.cut_left, right.cut_right) == (
        False, True, True, False,
    )  # fmt: skip


def extended(line: np.ndarray, stop: float = 0.01) -> np.ndarray:
    """Return what follows the valley of the left peak."""
    left = SlopeExtension(0.0, stop_fraction=stop).separate(line)[0]
    assert left.cut_right
    return left.values[left.last_px + 1 :]


def test_the_first_interval_takes_the_last_difference() -> None:
    # P(n_e) = 4 of 10; delta = 6 - 4 = 2; then 2 is not smaller than 2, and is halved.
    line = on_line(9.0, 10.0, 6.0, 4.0, 8.0, 9.0)
    assert extended(line, stop=0.2)[:2].tolist() == [2.0, 0.0]
    assert extended(line, stop=0.06)[:4].tolist() == [2.0, 1.0, 0.5, 0.0]


def test_the_second_interval_takes_the_same_sides_greatest_difference() -> None:
    # P = 7 of 10: differences 2 and 1 on the right side, 6 on the left one.
    line = on_line(4.0, 10.0, 8.0, 7.0, 8.0, 9.0)
    assert extended(line, stop=0.2)[:4].tolist() == [5.0, 3.0, 1.0, 0.0]


def test_the_third_interval_takes_the_opposite_sides_greatest_difference() -> None:
    # P = 8 of 10: differences 1 on the right, 5 and 3 on the left.
    line = on_line(2.0, 7.0, 10.0, 9.0, 8.0, 8.5, 9.0)
    assert extended(line, stop=0.2)[:3].tolist() == [3.0, 0.5, 0.0]


@pytest.mark.parametrize(
    ("valley", "first"),
    [(5.0, 5.0 - 2.0), (5.1, 5.1 - 2.9), (7.5, 7.5 - 1.5), (7.6, 7.6 - 6.0)],
)
def test_a_boundary_belongs_to_the_lower_interval(valley: float, first: float) -> None:
    before = {5.0: 7.0, 5.1: 7.1, 7.5: 9.0, 7.6: 9.0}[valley]
    line = on_line(4.0, 10.0, before, valley, 8.5, 8.6)
    assert extended(line)[0] == pytest.approx(first)


def test_extension_is_mirrored() -> None:
    line = on_line(2.0, 7.0, 10.0, 9.0, 8.0, 8.5, 9.0, 3.0)
    there = SlopeExtension(0.0).separate(line)
    back = SlopeExtension(0.0).separate(line[::-1])
    for piece, other in zip(there, reversed(back), strict=True):
        np.testing.assert_array_equal(piece.values, other.values[::-1])


def test_a_level_valley_does_not_go_on_for_ever() -> None:
    line = on_line(9.0, 10.0, 4.0, 4.0, 4.0, 8.0, 9.0)
    segments = SlopeExtension(0.0).separate(line)
    assert [piece.top_px for piece in segments] == [4, 9]
    assert np.isfinite(segments[0].values).all()


def test_ripples_part_nothing_if_they_need_not() -> None:
    line = on_line(5.0, 9.0, 8.8, 10.0, 5.0, 9.0, 4.0)
    assert [piece.top_px for piece in ValleyCut(0.0).separate(line)] == [4, 6, 8]
    assert [piece.top_px for piece in ValleyCut(0.0, 0.1).separate(line)] == [6, 8]


def test_the_zero_line_is_a_fraction_of_the_greatest_value() -> None:
    line = on_line(1.0, 10.0, 1.0, 0.0, 1.9, 0.0)
    (only,) = ValleyCut(0.2).separate(line)
    assert only.values[4] == 8.0
    assert only.values.sum() == 8.0


def test_lines_without_peaks_have_none() -> None:
    for method in METHODS:
        assert method.separate(np.zeros(20)) == ()
        assert method.separate(np.full(20, -3.0)) == ()


def test_bad_settings_are_refused() -> None:
    for make in (
        lambda: ValleyCut(1.0),
        lambda: ValleyCut(0.2, -0.1),
        lambda: SlopeExtension(-0.1),
        lambda: SlopeExtension(stop_fraction=0.0),
    ):
        with pytest.raises(InvalidParameter):
            make()
