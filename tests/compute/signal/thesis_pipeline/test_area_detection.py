"""Weighted areas: a partition of the signal, kept by maximum times sum."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from compute.errors import InvalidParameter
from compute.signal.thesis_pipeline.area_detection import WeightedAreas
from tests.compute.signal.thesis_pipeline.pipeline_scans import compact_peak

random_lines = arrays(np.float64, 60, elements=st.floats(-50.0, 100.0, width=32))
fractions = st.floats(0.0, 0.9)


@settings(max_examples=60, deadline=None)
@given(random_lines, fractions)
def test_the_areas_are_the_whole_signal_above_the_level(line: np.ndarray, level: float) -> None:
    """[6.3]: S is the sum of all areas, targets' and noise's."""
    found = WeightedAreas(level, 0.0)
    above = line > level * max(line.max(), 0.0)
    areas = found.find_areas(line)
    assert sum(area.total for area in areas) == pytest.approx(line[above].sum())
    assert sum(area.last_px - area.first_px + 1 for area in areas) == above.sum()
    for area in areas:
        run = line[area.first_px : area.last_px + 1]
        assert area.weight == pytest.approx(run.max() * run.sum())
    np.testing.assert_array_equal(found.apply(line), np.where(above, line, 0.0))


@settings(max_examples=60, deadline=None)
@given(random_lines, fractions, st.floats(0.0, 1.0))
def test_the_heaviest_is_kept_and_no_pixel_is_changed(
    line: np.ndarray, level: float, keep: float
) -> None:
    found = WeightedAreas(level, keep)
    kept = found.apply(line)
    assert ((kept == line) | (kept == 0.0)).all()
    all_areas = found.find_areas(line)
    if all_areas:
        assert max(all_areas, key=lambda area: area.weight) in found.select_areas(line)


def test_wide_noise_is_dropped_where_a_sum_would_keep_it() -> None:
    target = 60.0 * compact_peak(100.0, 5.0, 300)
    wide = np.where((np.arange(300) >= 180) & (np.arange(300) < 230), 7.0, 0.0)
    areas = WeightedAreas(0.1, 0.5).find_areas(target + wide)
    assert [area.first_px for area in areas] == [97, 180]
    assert areas[1].total > areas[0].total
    kept = WeightedAreas(0.1, 0.5).select_areas(target + wide)
    assert [area.first_px for area in kept] == [97]


def test_bad_settings_are_refused() -> None:
    for values in ((-0.1, 0.5), (0.96, 0.5), (0.1, 1.1), (float("nan"), 0.5)):
        with pytest.raises(InvalidParameter):
            WeightedAreas(*values)
