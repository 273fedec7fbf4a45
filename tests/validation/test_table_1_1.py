"""Table 1.1 beside predictions: what the geometry alone explains must come out."""

from functools import cache

import pytest

from compute.optics.profiles.loader import load_profile, profile_names
from validation.all_cases import ALL_CASES
from validation.table_1_1 import HEADINGS, REASONS, along, finding, rows, work_out
from validation.tables import Cell


@cache
def table(name: str) -> list[dict[str, Cell]]:
    return [dict(zip(HEADINGS, row, strict=True)) for row in rows(name)]


def number(cell: Cell) -> float:
    assert isinstance(cell, float)
    return cell


def test_it_is_a_case() -> None:
    assert "table-1.1" in ALL_CASES
    assert set(REASONS) <= set(profile_names())
    # Every device with a figure has its finding.
    assert {name for name in profile_names() if load_profile(name).published} == set(REASONS)


def test_half_a_pixel_makes_macellaris_figures() -> None:
    """0.6 mm across and 4.4 mm along the view at 5 m, section 2.3, by geometry alone."""
    by_axis = {(row["figure"], row["axis"]): row for row in table("macellari-1983")}
    across = by_axis["resolution", "lateral"]
    assert across["published"] == 0.6
    assert number(across["half px"]) == pytest.approx(0.6, rel=0.1)
    depth = by_axis["max error", "z"]
    assert depth["published"] == 4.4
    assert number(depth["half px"]) == pytest.approx(4.4, rel=0.1)


def test_12_bits_make_mitchelsons() -> None:
    [row] = table("mitchelson-1971")
    assert row["published"] == 0.5
    assert number(row["bound"]) == pytest.approx(0.5, rel=0.25)
    assert row["c.o.g."] is None


def test_the_findings_follow_the_rows() -> None:
    made = ("device", "accuracy", "x", 1000.0)
    predicted = (0.1, 0.2, 1.0, 3.0, 10.0)
    for published, words in (
        (0.11, "is the noise"),
        (0.01, "is 10 times below the noise"),
        (0.9, "is half a pixel"),
        (5.0, "lies between noise and uncorrected distortion"),
        (50.0, "is 5 times above the worst distortion"),
    ):
        assert words in finding("device", [(*made, published, *predicted)])
    assert "no figure was published" in finding("device", [(*made, None, *predicted)])


def test_axes() -> None:
    values = (3.0, 4.0, 12.0)
    assert [along(values, axis) for axis in ("x", "y", "z")] == [3.0, 4.0, 12.0]
    assert along(values, "depth") == 12.0
    assert along(values, "lateral") == 4.0
    assert along(values, "3d") == 13.0
    assert along(None, "3d") is None


def test_a_device_without_figures_has_a_row_of_predictions() -> None:
    tables, findings = work_out(["bar"])
    [row] = tables[0].rows
    assert row[4] is None
    assert all(isinstance(value, float) for value in row[5:])
    assert "bar: no figure was published." in findings
