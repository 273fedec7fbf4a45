"""Case fusion: with other random numbers each time, fused points are as good as on one clock."""

import os

import numpy as np
import pytest

from validation.all_cases import ALL_CASES
from validation.fusion.case import CASE, compare

SEED = (
    int(np.random.default_rng().integers(2**31))
    if os.environ.get("LUMILINE_TEST_EXAMPLES") == "random"
    else 5
)


def test_the_case_is_there() -> None:
    assert "fusion" in ALL_CASES
    assert CASE.options == ("seed", "trials")


@pytest.mark.slow
@pytest.mark.parametrize("speed_mm_s", [0.0, 2000.0])
def test_fused_points_and_poses_are_as_good_as_on_one_clock(speed_mm_s: float) -> None:
    found = compare(speed_mm_s, 20e-6, 6, 1.6, SEED)
    points, poses = found.points, found.poses
    print(f"seed {SEED}")
    assert points["refined"].rms_mm < 1.02 * points["one clock"].rms_mm
    assert poses["refined"].rms_mm < 1.05 * poses["one clock"].rms_mm
    # A calibration's errors are the same in a run: six runs are few.
    assert 2.2 < points["refined"].nees.mean() < 4.0
    assert poses["refined"].nees.mean() < 8.0
    if speed_mm_s:
        assert points["left out"].rms_mm > 1.05 * points["one clock"].rms_mm
        assert points["left out"].nees.mean() > points["refined"].nees.mean() + 0.3
