"""Geometry of the pyramidal calibration target with 19 LEDs."""

import numpy as np
from numpy.typing import NDArray

# Test 5.4 of the thesis (Appendix G): X to the right, Y up, Z towards the cameras [mm].
_SURVEYED_MM = (
    (72, 757, -1004),
    (-10, 757, -1003),
    (-78, 757, -1001),
    (-138, 799, -1010),
    (-117, 896, -1021),
    (-100, 983, -1044),
    (23, 1035, -1050),
    (-57, 1036, -1049),
    (124, 877, -1021),
    (105, 973, -1042),
    (49, 758, -1316),
    (-31, 758, -1316),
    (128, 837, -1298),
    (113, 915, -1284),
    (97, 1001, -1268),
    (-125, 857, -1295),
    (-109, 935, -1281),
    (-29, 1033, -1266),
    (41, 1033, -1265),
)


def calibration_target_points_mm() -> NDArray[np.float64]:
    """Return the LEDs relative to their mean, shape (19, 3) [mm], in the order of Test 5.4."""
    surveyed = np.array(_SURVEYED_MM, dtype=np.float64)
    shape: NDArray[np.float64] = surveyed - surveyed.mean(axis=0)
    return shape
