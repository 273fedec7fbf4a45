"""The Warp kernels of a strobed tool's step, one for each number of sensors.

Only ``compute.pose.filtering.native.strobed_step`` imports this module, when a step is made: it loads Warp.
"""

from functools import cache
from typing import Any

import warp as wp

from compute.pose.filtering.native.gated_update import CROSSED, FIGURES, TAKING
from compute.pose.filtering.native.imm_predict import MOTION
from compute.pose.filtering.native.kernel_arguments import ARGUMENTS_SOURCE
from compute.pose.filtering.native.predict_measurements import READINGS
from compute.reconstruction.native.algebra import ALGEBRA
from compute.reconstruction.native.correction_table import TABLE
from compute.reconstruction.native.kernel import OPTIONS
from compute.reconstruction.native.kernel_arguments import JOB_SOURCE
from compute.reconstruction.native.projection import CAMERAS


def step_source(sensors: int, room: int) -> str:
    """Return the source for so many sensors, with room for so many terms of distortion."""
    return (
        f"    const int S = {sensors}, ROOM = {room};\n"
        + ARGUMENTS_SOURCE
        + JOB_SOURCE
        + ALGEBRA
        + CAMERAS
        + TABLE
        + MOTION
        + READINGS
        + CROSSED
        + FIGURES
        + TAKING
    )


@cache
def step_kernel(sensors: int, room: int) -> Any:
    """Return the kernel for so many sensors, with room for so many terms of distortion.

    It takes the address of a STEP; launch with one thread, on the CPU.
    """

    def take_step(step_address: wp.uint64) -> None: ...

    native = wp.func_native(step_source(sensors, room))(take_step)

    def strobed_step(step_address: wp.uint64) -> None:
        native(step_address)

    return wp.kernel(module="unique", module_options=OPTIONS)(strobed_step)
