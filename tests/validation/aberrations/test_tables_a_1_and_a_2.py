"""Tables A.1 and A.2: the tracer beside the thesis's simulated and measured distortion."""

from dataclasses import replace

import numpy as np
import pytest

from validation.aberrations import lens_set_up
from validation.aberrations.lens_set_up import (
    TILT_BOUND_RAD,
    SetUp,
    fit_set_up,
    table_a2,
    traced_px,
)
from validation.aberrations.tables_a_1_and_a_2 import TABLE_A1

pytestmark = pytest.mark.slow


# As `lumiline reproduce table-A.2` finds it for the whole line; rounded.
FOUND = SetUp(24.49, -0.035, 0.0168, -0.0465)


def test_the_lens_predicts_both_measured_sides() -> None:
    """With four parameters of the set-up, both sides at once: 8 px RMS or better on each."""
    table = table_a2()
    measured = np.where(table.left, 1.0, -1.0) * (1024.0 - table.measured_px)
    left_over = traced_px(FOUND, table.lateral_mm, 300.0, "whole line") - measured
    for side in (table.left, ~table.left):
        assert np.sqrt(np.mean(left_over[side] ** 2)) <= 8.0
    # It is a set-up that somebody could have made, and the tilts matter.
    assert max(abs(FOUND.lens_tilt_rad), abs(FOUND.sensor_tilt_rad)) < TILT_BOUND_RAD
    straight = traced_px(SetUp(24.49), table.lateral_mm, 300.0, "whole line") - measured
    assert np.sqrt(np.mean(straight**2)) > 1.2 * np.sqrt(np.mean(left_over**2))


@pytest.mark.slow
def test_the_fit_finds_the_set_up_that_readings_came_from(monkeypatch: pytest.MonkeyPatch) -> None:
    table = table_a2()
    truth = SetUp(28.0, 0.2, -0.02, 0.03)
    seen = traced_px(truth, table.lateral_mm, 300.0, "chief ray")
    # The table as it would have been measured: both sides counted downwards from 1024.
    made = replace(table, measured_px=1024.0 - np.where(table.left, 1.0, -1.0) * seen)
    monkeypatch.setattr(lens_set_up, "table_a2", lambda: made)
    found, left_over = fit_set_up("chief ray")
    assert np.abs(left_over).max() < 0.5
    assert found.sensor_mm == pytest.approx(truth.sensor_mm, abs=0.5)


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
