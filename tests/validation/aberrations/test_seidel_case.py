"""Case seidel: sums and fits agree for the thesis's lens, and the rest is of the fifth order."""

import pytest

from validation.aberrations.seidel_case import STOPS, compute_tables
from validation.all_cases import ALL_CASES


def test_sums_and_fits_agree() -> None:
    (coefficients, left), _ = compute_tables()
    assert len(coefficients.rows) == len(STOPS) * (5 + 4)
    # Against the largest of its kind: distortion all but vanishes for the stop on the curved face.
    largest: dict[str, float] = {}
    for _, _, name, wanted, _, _ in coefficients.rows:
        largest[str(name)] = max(largest.get(str(name), 0.0), abs(float(str(wanted))))
    for _, _, name, wanted, found, _ in coefficients.rows:
        assert abs(float(str(found)) - float(str(wanted))) < 5e-4 * largest[str(name)]
    for ratio in left.column("left, by left at half the size"):
        assert float(str(ratio)) == pytest.approx(32.0, rel=0.05)


def test_the_case_is_there() -> None:
    assert "seidel" in ALL_CASES
