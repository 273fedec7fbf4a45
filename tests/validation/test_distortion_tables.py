"""Tables A.1 and A.2: the tracer beside the thesis's simulated and measured distortion."""

import numpy as np
import pytest

from validation.distortion_tables import TABLE_A1, SetUp, fit_set_up, table_a2, traced_px


def test_the_lens_predicts_both_measured_sides() -> None:
    """Four parameters of the set-up, both sides at once: 8 px RMS or better."""
    table = table_a2()
    set_up, left_over = fit_set_up("whole line")
    for side in (table.left, ~table.left):
        assert np.sqrt(np.mean(left_over[side] ** 2)) <= 8.0
    # A set-up that somebody could have made.
    assert 20.0 < set_up.sensor_mm < 37.0
    assert abs(set_up.offset_mm) < 1.0
    assert max(abs(set_up.lens_tilt_rad), abs(set_up.sensor_tilt_rad)) < 0.14


def test_without_the_lens_s_own_distortion_the_measurement_is_missed() -> None:
    """The set-up's parameters alone do not do it: a pinhole in their place leaves more."""
    table = table_a2()
    tangent = table.lateral_mm / 300.0
    measured = np.where(table.left, 1.0, -1.0) * (1024.0 - table.measured_px)
    # Distance, offset and tilt of a plane behind a pinhole: (a + b u) / (1 + d u).
    design = np.stack([np.ones_like(tangent), tangent, -tangent * measured], axis=1)
    found, *_ = np.linalg.lstsq(design, measured, rcond=None)
    left_over = (found[0] + found[1] * tangent) / (1.0 + found[2] * tangent) - measured
    assert np.sqrt(np.mean(left_over**2)) > 8.0


def test_table_a1_is_no_lens() -> None:
    """The thesis's tracer bends by 62 px at 6.5 degrees and as a square; a lens does neither."""
    fits = TABLE_A1.run().table("share of each part")
    parts = {row[0]: row[1:] for row in fits.rows}
    assert parts["thesis's tracer"][1] == pytest.approx(-101.5, abs=0.5)
    for curve in ("chief ray", "whole line"):
        _, quadratic, cubic, _ = parts[curve]
        assert isinstance(quadratic, float)
        assert isinstance(cubic, float)
        assert abs(quadratic) < 5.0
        assert abs(cubic) < 5.0


def test_a_lens_that_is_its_own_mirror_image_reads_odd_in_the_field() -> None:
    lateral = np.array([20.0, 80.0, 130.0])
    right = traced_px(SetUp(27.0), lateral, 300.0, "whole line")
    left = traced_px(SetUp(27.0), -lateral, 300.0, "whole line")
    assert right == pytest.approx(-left, abs=1e-3)
    tilted = traced_px(SetUp(27.0, sensor_tilt_rad=0.1), lateral, 300.0, "whole line")
    assert np.abs(tilted - right).max() > 5.0
