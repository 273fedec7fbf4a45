"""Constants and records of the triangulation kernel, for C++."""

from typing import Final

from compute.native.records import constants, header
from compute.reconstruction.native.kernel_arguments import CAMERAS, CPU_LANES, MAX_POWER, POINT_JOB
from compute.reconstruction.point_batch import PointFlag
from compute.reconstruction.triangulation import (
    CHI2_ROUNDING_FACTOR,
    CONDITION_LIMIT,
    DEGENERATE_RATIO,
    INITIAL_DAMPING,
    INTERSECTION_CHI2_TOLERANCE,
    MAX_DAMPING,
    MAX_ITERATIONS,
    STEP_TOLERANCE_MM,
    UNINFORMATIVE_SIGMA_RATIO,
    WEIGHTING_ITERATIONS,
)

HEADER: Final = header(
    "lumiline",
    CAMERAS.source,
    POINT_JOB.source,
    constants(
        {
            "cpu_lanes": CPU_LANES,
            "power_capacity": MAX_POWER + 1,
            "flag_too_few_sensors": PointFlag.TOO_FEW_SENSORS,
            "flag_degenerate": PointFlag.DEGENERATE,
            "flag_no_convergence": PointFlag.NO_CONVERGENCE,
            "flag_no_redundancy": PointFlag.NO_REDUNDANCY,
            "flag_inconsistent": PointFlag.INCONSISTENT,
            "flag_outside_map": PointFlag.OUTSIDE_MAP,
            "max_initial_iterations": WEIGHTING_ITERATIONS,
            "max_iterations": MAX_ITERATIONS,
            "initial_damping": INITIAL_DAMPING,
            "max_damping": MAX_DAMPING,
            "step_tolerance_mm": STEP_TOLERANCE_MM,
            "max_sigma_ratio": UNINFORMATIVE_SIGMA_RATIO,
            "chi2_rounding": CHI2_ROUNDING_FACTOR,
            "max_exact_chi2": INTERSECTION_CHI2_TOLERANCE,
            "min_condition": CONDITION_LIMIT,
            "min_singular_ratio": DEGENERATE_RATIO,
        }
    ),
)
