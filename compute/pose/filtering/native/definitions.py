"""Definitions of the strobed-step kernel for C++: constants and its argument record."""

from typing import Final

from compute.native.records import constants, header
from compute.pose.filtering.imm_model import IMM_STATES
from compute.pose.filtering.native.kernel_arguments import (
    CONTESTED,
    CURVED,
    HEAD,
    MISFIT,
    POSE,
    STEP_RECORD,
    TAKEN,
)
from compute.pose.filtering.second_order import CUBATURE_RADIUS, CURVATURE_SIGMA_FRACTION

HEADER: Final = header(
    "lumiline::pose",
    STEP_RECORD.source,
    constants(
        {
            "D": IMM_STATES,
            "pose_size": POSE,
            "head_size": HEAD,
            "status_taken": TAKEN,
            "status_curved": CURVED,
            "status_contested": CONTESTED,
            "status_misfit": MISFIT,
            "max_curvature_fraction": CURVATURE_SIGMA_FRACTION,
            "sigma_point_reach": CUBATURE_RADIUS,
        }
    ),
    includes=("compute/reconstruction/native/definitions.gen.h",),
)
