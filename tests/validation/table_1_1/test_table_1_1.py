"""Table 1.1 beside predictions: what the geometry alone explains must come out."""

from functools import cache

import numpy as np
import pytest

from compute.optics.profiles.profile_loader import load_profile, profile_names
from validation.all_cases import ALL_CASES
from validation.result_tables import Cell
from validation.table_1_1.case import (
    COMPARED,
    HEADINGS,
    WORDS,
    along,
    compute_tables,
    finding,
    planned,
    rows,
)
from validation.table_1_1.remarks import remark, template_errors_px


@cache
def table(name: str) -> list[dict[str, Cell]]:
    return [dict(zip(HEADINGS, row, strict=True)) for row in rows(name)]


def number(cell: Cell) -> float:
    assert isinstance(cell, float)
    return cell


def test_it_is_a_case() -> None:
    assert "table-1.1" in ALL_CASES
    quantities = {f.quantity for name in profile_names() for f in load_profile(name).published}
    assert quantities <= set(COMPARED)
    assert {one for names in COMPARED.values() for one in names} == set(WORDS)
    assert set(WORDS) <= set(HEADINGS)


@pytest.mark.slow
def test_half_a_pixel_makes_macellaris_figures() -> None:
    """0.6 mm across at 5 m, which section 2.3 takes from half a pixel; 4.4 mm in depth with it."""
    rows = [row for row in table("macellari-1983") if row["figure"] == "resolution"]
    [across] = [row for row in rows if row["published"] == 0.6]
    assert across["axis"] == "lateral"
    assert number(across["half px"]) == pytest.approx(0.6, rel=0.1)
    [depth] = [row for row in rows if row["axis"] == "depth"]
    assert depth["published"] == 4.4
    assert number(depth["half px"]) == pytest.approx(4.4, rel=0.1)


def test_mitchelsons_lateral_figure_is_more_than_its_rounding() -> None:
    """0.5 mm in a field of 1.5 m is 1.4 steps of 12 bits; the rounding is 1/sqrt(12) of one."""
    [row] = table("mitchelson-1971")
    assert (row["axis"], row["published"]) == ("lateral", 0.5)
    assert row["c.o.g."] is None
    assert row["pattern"] is None
    step = 2.0 * number(row["half px"])
    # 26 deg at 3 m, and 4096 steps; the middle sensor alone measures along Y.
    assert step == pytest.approx(2.0 * 3000.0 * np.tan(np.radians(13.0)) / 4096, rel=0.05)
    assert number(row["bound"]) == pytest.approx(step / np.sqrt(12.0), rel=1e-6)
    profile = load_profile("mitchelson-1971")
    found = planned("mitchelson-1971", 3000.0)
    assert found.noise.centre is not None
    x, y, z = found.noise.centre
    text = remark(profile, found)
    assert f"{0.5 / y:.2g} to {0.5 / x:.2g} times less" in text
    assert f"{z:.2g} mm in depth" in text
    assert 0.5 / y > 4.0


def made(quantity: str, published: float | None, **predicted: float | None) -> tuple[Cell, ...]:
    figures = dict.fromkeys(WORDS) | predicted | {"c.o.g.": predicted.get("cog")}
    return ("device", quantity, "x", 1000.0, published, *(figures[name] for name in WORDS))


@pytest.mark.parametrize(
    ("quantity", "published", "words"),
    [
        ("accuracy", 0.11, "x 0.11 mm is of the size of the noise at its bound (0.1)"),
        ("accuracy", 0.01, "is 0.1 times the least compared, the noise at its bound (0.1)"),
        ("accuracy", 0.9, "is of the size of half a pixel in every reading (1)"),
        ("accuracy", 2.0, "lies between half a pixel in every reading (1) and the median"),
        ("accuracy", 10.0, "is 3.3 times the largest compared, the median distortion (3)"),
        ("max error", 10.0, "is of the size of the worst distortion (10)"),
        ("max error", 2.9, "between half a pixel in every reading (1) and the worst distortion"),
        ("resolution", 3.0, "is 3 times the largest compared, half a pixel in every reading (1)"),
        ("resolution", 0.4, "the noise by centre of gravity (0.21) and half a pixel"),
        ("accuracy", 0.25, "noise by centre of gravity (0.21) and of the fixed pattern (0.3)"),
    ],
)
def test_the_findings_follow_the_rows(quantity: str, published: float, words: str) -> None:
    figures = {"bound": 0.1, "cog": 0.21, "pattern": 0.3, "distortion": 3.0, "worst": 10.0}
    cells = made(quantity, published, **figures, **{"half px": 1.0})
    text = finding("device", [cells])
    assert words in text
    assert f"{published:g} mm" in text


def test_a_coded_windows_half_pixel_is_not_passed_over() -> None:
    """Of the largest predicted figure, whichever it is, and not of the distortion alone."""
    cells = made("accuracy", 0.6, bound=0.014, distortion=0.003, **{"half px": 9.4})
    assert "lies between the noise at its bound (0.014) and half a pixel" in finding("a", [cells])


def test_what_is_not_known_is_not_compared() -> None:
    cells = made("accuracy", 0.6)
    assert "beside no prediction" in finding("device", [cells])
    assert "no figure was published" in finding("device", [made("accuracy", None, bound=1.0)])
    # Simulated readings have no noise.
    cells = made("accuracy", 0.1, bound=0.1, **{"half px": 2.0})
    assert "bound" not in finding("thesis-5.2", [cells])


def test_axes() -> None:
    values = (3.0, 4.0, 12.0)
    assert [along(values, axis) for axis in ("x", "y", "z")] == [3.0, 4.0, 12.0]
    assert along(values, "depth") == 12.0
    assert along(values, "lateral") == 4.0
    assert along(None, "depth") is None
    with pytest.raises(ValueError, match="3d is not one axis"):
        along(values, "3d")


def test_a_figure_without_an_axis_stands_beside_lateral_and_depth() -> None:
    found = [row for row in table("optotrak") if row["published"] == 0.01]
    assert [row["axis"] for row in found] == ["lateral", "depth"]
    assert number(found[0]["half px"]) < number(found[1]["half px"])


def test_a_largest_error_is_compared_with_the_worst_place() -> None:
    rows = {(row["figure"], row["axis"]): row for row in table("macellari-1983")}
    middle, worst = rows["resolution", "depth"], rows["max error", "z"]
    for column in ("bound", "c.o.g.", "pattern", "half px"):
        assert number(worst[column]) > number(middle[column])


@pytest.mark.slow
def test_remarks_say_the_figures() -> None:
    owen = remark(load_profile("owen-1995"), planned("owen-1995", 1500.0))
    x, y, z = planned("owen-1995", 1500.0).dilution.centre or (0.0, 0.0, 0.0)
    assert "published 5 and 8.9 times worse" in owen
    assert f"make it {z / x:.2g} and {z / y:.2g} times" in owen
    assert remark(load_profile("bar"), planned("bar", 1500.0)) == ""


@pytest.mark.slow
def test_codas_templates_fit_their_distance() -> None:
    """The errors that the remark gives: those of the distance itself, and of another."""
    coda = load_profile("coda-mpx30")
    own, other = (template_errors_px(coda, at, 2500.0) for at in (2500.0, 3000.0))
    assert own.shape == (25, 3)
    assert np.sqrt(np.square(own).mean()) < 0.03
    assert np.sqrt(np.square(other).mean()) > 2.0 * np.sqrt(np.square(own).mean())
    text = remark(coda, planned("coda-mpx30", 3000.0))
    assert f"by {np.sqrt(np.square(other).mean()):.2g} and " in text


def test_a_device_without_figures_has_rows_of_predictions() -> None:
    tables, findings = compute_tables(["bar"])
    assert [row[2] for row in tables[0].rows] == ["lateral", "depth"]
    for row in tables[0].rows:
        assert row[4] is None
        assert all(isinstance(value, float) for value in row[5:])
    assert "bar: no figure was published." in findings
