"""Table 5.5: one arrangement explains all its rows, by covariance and by simulation."""

import numpy as np
import pytest

from validation.all_cases import ALL_CASES
from validation.table_5.table_5_5 import (
    ALTERNATIVES,
    PUBLISHED,
    REPEATS,
    Arrangement,
    mean_absolute,
    misfit,
    predicted,
    simulated,
)

FIGURES = np.array(list(PUBLISHED.values()))
ROWS = list(PUBLISHED)


@pytest.mark.slow
def test_it_is_a_case_with_a_row_for_each_row() -> None:
    result = ALL_CASES["table-5.5"].run()
    for axis in range(3):
        table = result.table("XYZ"[axis])  # type: ignore[union-attr]
        assert table.column("thesis") == pytest.approx(FIGURES[:, axis])
        assert table.column("predicted") == pytest.approx(
            mean_absolute(predicted(Arrangement()))[:, axis]
        )
    assert len(PUBLISHED) == 18
    assert sorted(ROWS[-1]) == list(range(1, 8))


def test_all_rows_within_what_one_run_of_16_points_scatters() -> None:
    noisy = simulated()
    away = np.abs(FIGURES - noisy.mean_absolute_mm) / noisy.scatter_mm
    # 54 figures: the largest of so many normal deviations stays below 3.5 with 98 %.
    assert away.max() < 3.5
    # And 95 % of them within two.
    assert (away < 2.0).sum() >= 48
    scale, spread = misfit(Arrangement())
    assert 0.9 < scale < 1.1
    assert spread < 0.15


def test_prediction_and_simulation_agree() -> None:
    noisy = simulated()
    ours = mean_absolute(predicted(Arrangement()))
    error = noisy.scatter_mm / np.sqrt(REPEATS)
    assert (np.abs(noisy.mean_absolute_mm - ours) < 5.0 * error).all()
    rms = np.sqrt((predicted(Arrangement()) ** 2).mean(axis=1))
    np.testing.assert_allclose(noisy.rms_mm, rms, rtol=0.1)


def test_a_detector_at_a_right_angle_exchanges_depth_and_width() -> None:
    ours = mean_absolute(predicted(Arrangement()))
    ahead, across = ours[ROWS.index((1,))], ours[ROWS.index((3,))]
    np.testing.assert_allclose(ahead, across[[2, 1, 0]], rtol=1e-6)
    diagonal = ours[ROWS.index((2,))]
    assert diagonal[0] == pytest.approx(diagonal[2], rel=0.05)


@pytest.mark.parametrize(
    "name",
    [
        "the detector of Test 5.2, 190 x 150 mm",
        "corners of cubes of 500 and 250 mm",
        "a volume of 1000 mm^3: cubes of 10 and 5 mm",
        "2000 mm to the near face of the cube",
    ],
)
def test_other_readings_of_the_text_do_not_explain_it(name: str) -> None:
    assert misfit(ALTERNATIVES[name])[1] > 2.0 * misfit(Arrangement())[1]
