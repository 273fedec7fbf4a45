"""PoseReliabilityKernel: ``pose_reliability`` of a strobed tool in one launch, on the CPU."""

from functools import cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.pose.estimation.pose_reliability import PoseReliability
from compute.pose.filtering.native.definitions import RELIABILITY
from compute.pose.settings import POSE_PARAMETERS
from compute.reliability import noncentrality
from compute.warp_host import PackedLaunch, address

Array = NDArray[np.float64]

MAX_READINGS: Final = 128
"""Most readings of a pose; the work grows with their cube, and NumPy's library is better then."""


class PoseReliabilityKernel:
    """Reliability of the pose of one tool.

    Args:
        step: address of the tool's STEP, which says what cameras and markers there are.
        markers: number M of its markers.
        sensors: number S of sensors.
        capacity: largest number of distortion terms.
        calibration_errors: number C of common errors of the calibration.
    """

    def __init__(
        self, step: int, markers: int, sensors: int, capacity: int, calibration_errors: int
    ) -> None:
        shape = markers, sensors
        self._used, self._sigma = np.zeros(shape, dtype=np.bool_), np.ones(shape)
        most = min(markers * sensors, MAX_READINGS)
        self._scratch = np.empty(scratch_size(most, calibration_errors))
        record = self._record = np.zeros(1, dtype=RELIABILITY)
        record["step"], record["markers"] = step, markers
        for name, array in (
            ("used", self._used),
            ("sigma", self._sigma),
            ("scratch", self._scratch),
        ):
            record[name] = address(array)
        self._launch = PackedLaunch.of_record(reliability_kernel(sensors, capacity), record)

    def of(
        self,
        used: NDArray[np.bool_],
        sigma_px: Array,
        rotation: Array,
        centroid_mm: Array,
        significance: float,
    ) -> PoseReliability | None:
        """Return the reliability of a pose; None: it is left to NumPy.

        Args:
            used: which sensor's reading of which marker it rests on, shape (M, S).
            sigma_px: their standard deviations, shape (M, S) [px].
            rotation: the pose's R_world_tool, shape (3, 3).
            centroid_mm: centroid of the markers, shape (3,) [mm].
            significance: of the chi-square test.
        """
        count = int(np.count_nonzero(used))
        if not POSE_PARAMETERS < count <= MAX_READINGS:
            return None
        record = self._record[0]
        self._used[:], self._sigma[:] = used, sigma_px
        record["readings"] = count
        record["noncentrality"] = noncentrality(count - POSE_PARAMETERS, significance)
        record["pose"][:9], record["pose"][9:] = rotation.ravel(), centroid_mm
        self._launch.run()
        if not record["solved"]:
            return None
        marker, sensor = divmod(int(record["worst"]), used.shape[1])
        return PoseReliability(
            float(record["detectable_sigma"]),
            marker,
            sensor,
            float(record["external_tip_mm"]),
            float(record["external_rotation_rad"]),
        )


@cache
def reliability_kernel(sensors: int, capacity: int) -> Any:
    """Return the kernel; it takes the address of a RELIABILITY.

    Loads Warp. Launch it with one thread, on the CPU.

    Args:
        sensors: number of sensors.
        capacity: largest number of distortion terms.
    """
    from compute.native.native_kernel import native_kernel

    return native_kernel(
        "compute/pose/filtering/native/pose_reliability.h",
        f"lumiline::pose::pose_reliability<{sensors}, {capacity}>(address);",
    )


def scratch_size(readings: int, calibration_errors: int) -> int:
    """Return the number of float64 of the kernel's scratch memory.

    Args:
        readings: largest number of readings.
        calibration_errors: number of common errors of the calibration.
    """
    return readings * (2 * POSE_PARAMETERS + calibration_errors + 2 * readings + 1)
