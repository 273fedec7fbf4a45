"""The case of wrong readings: measured shares are the theory's, and poses are not misled."""

import numpy as np
import pytest

from validation.reliability import point_errors, pose_errors


@pytest.mark.parametrize(("sensors", "size"), [(4, 10.0), (5, 20.0), (8, 7.0)])
def test_points_are_detected_and_identified_as_often_as_theory_says(
    sensors: int, size: float
) -> None:
    one = point_errors.run(sensors, size, 800, np.random.default_rng(7))
    # Shares of 800: deviations of 0.018 at most, of a difference of two 0.025.
    assert one.detected == pytest.approx(one.detected_theory, abs=0.06)
    assert one.identified == pytest.approx(one.identified_theory, abs=0.08)
    assert one.wrongly_excluded < 0.005


def test_a_wrong_reading_at_low_redundancy_gives_no_ok_pose() -> None:
    one = pose_errors.run(8, 10.0, 25, np.random.default_rng(7))
    assert one.misled <= 0.04
    assert one.statuses["LOW_RELIABILITY"] > 0
