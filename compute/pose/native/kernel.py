"""The Warp kernels of a strobed tool's step, one for each number of sensors.

Only ``compute.pose.native.strobed_step`` imports this module, when a step is made: it loads Warp.
"""

from functools import cache
from typing import Any

import warp as wp

from compute.pose.native.motion import MOTION
from compute.pose.native.readings import READINGS
from compute.pose.native.record import STEP_SOURCE
from compute.pose.native.taking import CROSSED, FIGURES, TAKING
from compute.reconstruction.native.algebra import ALGEBRA
from compute.reconstruction.native.cameras import CAMERAS
from compute.reconstruction.native.job import JOB_SOURCE
from compute.reconstruction.native.kernel import OPTIONS
from compute.reconstruction.native.table import TABLE


def step_source(sensors: int, room: int) -> str:
    """Return the source for so many sensors, with room for so many terms of distortion."""
    return (
        f"    const int S = {sensors}, ROOM = {room};\n"
        + STEP_SOURCE
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
