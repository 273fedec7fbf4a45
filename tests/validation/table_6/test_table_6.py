"""Tables 6.1 and 6.2: the bar from generated readings, and why the thesis's figures are so."""

from dataclasses import replace

import numpy as np
import pytest

from validation.section_6.rotating_bar import BAR_MM
from validation.table_6 import table_6_1
from validation.table_6.moving_bar import (
    bar,
    by_known,
    generated,
    kinematics_along_x,
    length_and_angle,
    printed,
    rounded,
    statistics,
)
from validation.table_6.table_6_1 import (
    DIGITS,
    exact,
    frame_errors,
    printed_frame,
    rounded_statistics,
)
from validation.table_6.table_6_2 import (
    DISTANCE,
    factor_for,
    longer,
    matched,
    mismatched,
    moved_p0,
    optimised,
    set_up,
    sigma_of_x,
)
from validation.table_6.table_6_2 import compute_tables as table_6_2
from validation.thesis_data import load_cameras


@pytest.fixture(autouse=True)
def few_grids(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table_6_1, "GRIDS", 12)


@pytest.mark.parametrize("table", ["6.1", "6.2"])
@pytest.mark.parametrize("half", ["DLT", "BA"])
def test_printed_statistics_belong_together(table: str, half: str) -> None:
    """Typed from the text: the five figures of an axis cannot be just any."""
    mean, deviation, absolute, of_absolute, largest = printed(table, half)
    assert (np.abs(mean) <= absolute * 1.01).all()
    assert (absolute <= largest).all()
    # Both deviations are about one sum of squares, but for n/(n - 1).
    np.testing.assert_allclose(
        mean**2 + deviation**2, absolute**2 + of_absolute**2, rtol=0.06, atol=0.0
    )


def test_the_bar() -> None:
    of = bar("3 m")
    assert of.points_mm.shape == (25 + 61, 2, 3)
    assert length_and_angle(of.points_mm.reshape(-1, 3), of) == pytest.approx((0.0, 0.0))
    longer_bar = of.centre_mm + (of.points_mm - of.centre_mm) * (1.0 + 1.0 / BAR_MM)
    turned = of.points_mm - of.centre_mm
    c, s = np.cos(0.01), np.sin(0.01)
    turned = turned @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + of.centre_mm
    assert length_and_angle(longer_bar.reshape(-1, 3), of)[0] == pytest.approx(1.0)
    assert length_and_angle(turned.reshape(-1, 3), of)[1] == pytest.approx(np.rad2deg(0.01))


def test_kinematics_of_errors() -> None:
    of = bar("1 m")
    shifted = of.points_mm + np.array([0.3, 0.0, 0.0])
    assert kinematics_along_x(shifted.reshape(-1, 3), of) == pytest.approx((0.0, 0.0), abs=1e-8)
    zigzag = of.points_mm.copy()
    zigzag[::2, :, 0] += 0.1
    assert kinematics_along_x(zigzag.reshape(-1, 3), of) == pytest.approx((3.0, 180.0))


def test_rounding() -> None:
    readings = np.array([[1.23456, 9.87654, 0.0, -1.00006]])
    np.testing.assert_allclose(rounded(readings, DIGITS, np.zeros(4)), readings, atol=5.1e-5)
    shift = np.full(4, 3e-5)
    moved = rounded(readings, DIGITS, shift)
    assert (np.abs(moved - readings) <= 5.0e-5 + 1e-12).all()
    np.testing.assert_allclose((moved + shift) * 1e4, np.round((moved + shift) * 1e4), atol=1e-6)


@pytest.mark.parametrize("distance", ["3 m", "1 m"])
def test_exact_readings_give_the_points_back(distance: str) -> None:
    truth = bar(distance).points_mm.reshape(-1, 3)
    for way, most in (("as published", 1e-5), ("normalised", 1e-8), ("metric", 1e-8)):
        assert np.abs(exact(distance, way) - truth).max() < most, way
    assert np.abs(exact(distance, "known") - truth).max() < 1e-9


def test_rounding_gives_figures_of_the_thesiss_size_at_1_m_only() -> None:
    thesis = printed("6.1", "DLT")[2]
    near, far = (rounded_statistics(distance)[2] for distance in ("1 m", "3 m"))
    assert (near > thesis / 5.0).all()
    assert (near < thesis * 2.0).all()
    assert (far < thesis / 8.0).all()
    # Depth is the worst.
    assert near[2] > 2.0 * near[:2].max()
    # With equal readings the metric calibration is as good, and no better.
    np.testing.assert_allclose(rounded_statistics("1 m", "metric")[2], near, rtol=0.3)


def test_rounding_gives_chapter_5_too() -> None:
    for row in table_6_1.FRAME_ROWS:
        share = printed_frame(*row) / frame_errors(*row[2:])
        assert (share > 0.15).all(), row
        assert (share < 1.5).all(), row


def test_a_common_principal_distance_moves_z_alone() -> None:
    of = bar(DISTANCE)
    found = statistics(mismatched(longer(factor_for(8.02, of)), of), of)
    assert found[0, 2] == pytest.approx(8.02, abs=1e-6)
    assert np.abs(found[:, :2]).max() < 1e-6
    assert found[1, 2] < 1e-6


def test_principal_points_do_not() -> None:
    of = bar(DISTANCE)
    found = statistics(mismatched(moved_p0(), of), of)
    assert (np.abs(found[0, :2]) > 5.0 * np.abs(printed("6.2", "DLT")[0, :2])).all()
    # What moves Z by millimetres spreads X by tenths of them.
    assert found[1, 0] > 0.05 * abs(found[0, 2])
    assert printed("6.2", "DLT")[1, 0] < 0.01 * printed("6.2", "DLT")[0, 2]


@pytest.mark.parametrize("sensor", range(4))
def test_whichever_principal_point_moves_z_spreads_x_alike(sensor: int) -> None:
    of = bar(DISTANCE)
    cameras = list(set_up())
    cameras[sensor] = replace(cameras[sensor], p0=cameras[sensor].p0 + 0.01)
    found = statistics(mismatched(tuple(cameras), of), of)
    assert found[1, 0] / abs(found[0, 2]) * 8.02 == pytest.approx(sigma_of_x(8.02, of), rel=1e-3)
    assert sigma_of_x(8.02, of) > 50.0 * printed("6.2", "DLT")[1, 0]


def test_calibrated_alike_any_cameras_give_the_points_back() -> None:
    of = bar(DISTANCE)
    truth = of.points_mm.reshape(-1, 3)
    for cameras in (set_up(), moved_p0(), optimised()):
        assert np.abs(matched(cameras, of) - truth).max() < 1e-7
        assert np.abs(matched(cameras, of, metric=True) - truth).max() < 1e-7
        known = by_known(cameras, generated(cameras, of.points_mm), of.centre_mm)
        assert np.abs(known - truth).max() < 1e-9


def test_tables_have_figures_beside_the_thesis() -> None:
    for tables, findings in (table_6_1.compute_tables(), table_6_2()):
        assert len(findings) == 4
        for table in tables:
            numbers = [cell for row in table.rows for cell in row if isinstance(cell, float)]
            assert numbers
            assert np.isfinite(numbers).all()
    assert load_cameras("5.5 and 5.6") == set_up()
