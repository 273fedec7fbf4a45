"""Which candidates are fitted together, and where."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from compute.signal.centroid_settings import LEVEL_UNIT
from compute.signal.detection.background_estimate import estimate_background
from compute.signal.fit.candidate_groups import form_groups, initial_widths
from compute.signal.fit.fit_settings import MAX_WINDOW_PX, WIDTH_LIMITS_PX, FitSettings
from compute.signal.peaks import PeakBatch
from tests.compute.signal.synthetic_scans import NOISE, varied_lines

PIXELS = 512
KNOWN = FitSettings(width_px=2.0, width_log_sigma=0.0)  # windows of 9 pixels to either side


def candidates(*lines, width_px=6.0):
    batch = PeakBatch.empty(len(lines), max(len(line) for line in lines))
    for number, line in enumerate(lines):
        batch.count[number] = len(line)
        batch.position_px[number, : len(line)] = line
        batch.width_px[number, : len(line)] = width_px
    return batch


def parts(groups):
    return list(zip(groups.first_candidate.tolist(), groups.count.tolist(), strict=True))


def windows(groups):
    return list(zip(groups.first_px.tolist(), groups.last_px.tolist(), strict=True))


def test_neighbours_whose_windows_overlap_are_together():
    groups = form_groups(candidates([50.0, 68.0, 87.0], [], [3.0, 509.4]), PIXELS, KNOWN)
    assert groups.scan.tolist() == [0, 0, 2, 2]
    assert parts(groups) == [(0, 2), (2, 1), (0, 1), (1, 1)]
    assert windows(groups) == [(41, 77), (78, 96), (0, 12), (500, 511)]
    assert not (groups.split_before | groups.split_after).any()
    # To look for more: as far again, but only to midway between them and to the ends.
    assert groups.extended_first_px.tolist() == [32, 78, 0, 491]
    assert groups.extended_last_px.tolist() == [77, 105, 21, 511]


def test_long_chains_are_cut_at_their_widest_gaps():
    groups = form_groups(candidates([50.0, 60.0, 75.0, 85.0, 97.0, 105.0]), PIXELS, KNOWN)
    assert parts(groups) == [(0, 2), (2, 4)]
    assert windows(groups) == [(41, 67), (68, 114)]
    assert groups.split_after.tolist() == [True, False]
    assert groups.split_before.tolist() == [False, True]
    pairs = form_groups(
        candidates([50.0, 60.0, 75.0]), PIXELS, FitSettings(width_log_sigma=0.0, max_joint_peaks=1)
    )
    assert parts(pairs) == [(0, 1), (1, 1), (2, 1)]


def test_windows_have_an_end():
    wide = FitSettings(width_px=16.0, width_log_sigma=0.0, reach=8.0)
    groups = form_groups(candidates([200.0, 260.0]), PIXELS, wide)
    assert windows(groups) == [(137, 230), (231, 323)]
    assert groups.split_after.tolist() == [True, False]


def test_starting_widths():
    free = FitSettings(width_px=2.0, width_log_sigma=np.inf)
    third = 2.0 * np.sqrt(2.0 * np.log(3.0))
    batch = candidates([10.0], width_px=third * 1.5)
    assert initial_widths(batch, free)[0, 0] == pytest.approx(1.5, rel=1e-6)
    assert initial_widths(batch, KNOWN)[0, 0] == 2.0
    narrow = FitSettings(width_px=2.0, width_log_sigma=0.05)
    assert initial_widths(batch, narrow)[0, 0] == pytest.approx(2.0 * np.exp(-0.1))
    for width, limit in zip((0.01, 1000.0), WIDTH_LIMITS_PX, strict=True):
        assert initial_widths(candidates([10.0], width_px=width), free)[0, 0] == limit


def test_no_candidates():
    assert len(form_groups(PeakBatch.empty(3, 4), PIXELS, KNOWN)) == 0


def test_backgrounds_are_the_searchs():
    from compute.signal.centroid_reference import scan_background

    lines = varied_lines(32, 200, np.random.default_rng(5))
    expected = [scan_background(line.astype(np.int64))[0] / 64 for line in lines]
    np.testing.assert_array_equal(estimate_background(lines).background / LEVEL_UNIT, expected)
    assert len(NOISE) == 1


@given(
    place=st.lists(st.floats(0.0, PIXELS - 1.0), min_size=1, max_size=24, unique=True),
    width=st.floats(0.25, 16.0),
    max_joint_peaks=st.integers(1, 4),
    reach=st.floats(2.0, 8.0),
)
def test_every_candidate_is_in_one_window_and_no_pixel_in_two(place, width, max_joint_peaks, reach):
    settings = FitSettings(
        width_px=width, width_log_sigma=0.0, max_joint_peaks=max_joint_peaks, reach=reach
    )
    batch = candidates(sorted(place))
    groups = form_groups(batch, PIXELS, settings)
    candidate_indices = np.concatenate([np.arange(m, m + c) for m, c in parts(groups)])
    np.testing.assert_array_equal(candidate_indices, np.arange(len(place)))
    assert (groups.count <= max_joint_peaks).all()
    for first, last in (
        (groups.first_px, groups.last_px),
        (groups.extended_first_px, groups.extended_last_px),
    ):
        assert (first[1:] > last[:-1]).all()
        assert (last - first < MAX_WINDOW_PX).all()
        assert first[0] >= 0
        assert last[-1] < PIXELS
    assert (groups.extended_first_px <= groups.first_px).all()
    assert (groups.extended_last_px >= groups.last_px).all()
    for k, (member, count) in enumerate(parts(groups)):
        inside = batch.position_px[0, member : member + count]
        assert groups.first_px[k] - 1 <= inside.min()
        assert inside.max() <= groups.last_px[k] + 1
    np.testing.assert_array_equal(groups.split_after[:-1], groups.split_before[1:])


@pytest.mark.parametrize(
    "wrong",
    [
        {"width_px": 0.1},
        {"width_px": np.nan},
        {"width_log_sigma": -0.1},
        {"width_log_sigma": 1e-200},
        {"width_log_sigma": np.nan},
        {"reach": 1.0},
        {"shape_error": 0.6},
        {"max_joint_peaks": 5},
        {"max_joint_peaks": 2.5},
        {"max_joint_peaks": True},
        {"false_split_rate": 0.0},
        {"background": "curve"},
    ],
)
def test_settings_outside_their_range_are_refused(wrong):
    with pytest.raises(InvalidParameter):
        FitSettings(**wrong)
