"""Constants and the surface record of the ray tracing kernel, for C++."""

from typing import Final

from compute.native.records import constants, header
from compute.optics.tracing.intersection import (
    CONVERGENCE_FRACTION,
    MAX_INTERVALS,
    MAX_STEPS,
    MIN_INTERVAL_FRACTION,
    ROUNDING,
)
from compute.optics.tracing.reference_tracer import MIN_SQUARE, RayStatus
from compute.optics.tracing.surface_records import BACKWARD_SLACK_MM, SURFACE, Form

HEADER: Final = header(
    "lumiline::tracing",
    SURFACE.source,
    constants(
        {
            "form_plane": Form.PLANE,
            "form_quadric": Form.QUADRIC,
            "status_missed": RayStatus.MISSED,
            "status_stopped": RayStatus.STOPPED,
            "status_totally_reflected": RayStatus.TOTALLY_REFLECTED,
            "max_intervals": MAX_INTERVALS,
            "max_steps": MAX_STEPS,
            "min_squared_length": MIN_SQUARE,
            "backward_slack_mm": BACKWARD_SLACK_MM,
            "min_interval_fraction": MIN_INTERVAL_FRACTION,
            "convergence_fraction": CONVERGENCE_FRACTION,
            "rounding": ROUNDING,
        }
    ),
)
