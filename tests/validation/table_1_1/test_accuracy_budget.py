"""Accuracy budgets beside Table 1.1: what is compared with what, and how it comes out."""

import pytest

from compute.optics.profiles.profile_loader import load_profile
from validation.all_cases import ALL_CASES
from validation.result_tables import Cell
from validation.table_1_1.budget_case import (
    FACTOR,
    HEADINGS,
    agrees,
    compute_tables,
    meaning,
    planned,
    rows,
)


def table(name: str) -> list[dict[str, Cell]]:
    return [dict(zip(HEADINGS, row, strict=True)) for row in rows(name)]


def made(ratio: float) -> tuple[Cell, ...]:
    return tuple(ratio if heading == "ratio" else "x" for heading in HEADINGS)


def test_it_is_a_case() -> None:
    assert "accuracy-budget" in ALL_CASES


def test_a_factor_of_three_both_ways() -> None:
    assert [agrees(made(ratio)) for ratio in (0.3, 0.4, 1.0, 2.9, 3.1)] == [
        False, True, True, True, False,
    ]  # fmt: skip
    assert FACTOR == 3.0


def test_a_resolution_that_is_an_accuracy_elsewhere_is_compared_as_that() -> None:
    optotrak = load_profile("optotrak")
    found = {figure.value_mm: meaning(optotrak, figure) for figure in optotrak.published}
    assert found == {0.15: "accuracy", 0.1: "accuracy", 0.01: "resolution"}


@pytest.mark.slow
def test_the_optotrak() -> None:
    found = {(row["figure"], row["axis"]): row for row in table("optotrak")}
    assert set(found) == {
        ("accuracy", "3d"), ("accuracy", "lateral"), ("accuracy", "depth"), ("resolution", "3d"),
    }  # fmt: skip
    assert found["accuracy", "lateral"]["place"] == "z = 2250"
    for row in found.values():
        ratio = row["ratio"]
        assert isinstance(ratio, float)
        assert 1.0 / FACTOR < ratio < FACTOR
    # A marker that moves would blur what was published of still ones.
    _, budget = planned("optotrak", 2250.0)
    [timing] = [one for one in budget.contributions if one.name == "timing"]
    assert timing.rms_mm == 0.0


@pytest.mark.slow
def test_every_row_of_table_1_1_is_of_the_right_size_or_has_a_reason() -> None:
    tables, findings = compute_tables()
    outside = [row for row in tables[0].rows if not agrees(row)]
    assert {(row[0], row[1]) for row in outside} <= {
        ("leo-macellari-1981", "resolution"),
        ("thesis-5.9", "accuracy"),
    }
    assert not any("No reason is known" in one for one in findings)
    assert any("bianchi-1990" in one and "No accuracy was published" in one for one in findings)
