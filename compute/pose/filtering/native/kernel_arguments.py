"""What the kernel of a strobed tool's step is given: a record of addresses, sizes and numbers."""

from typing import Final

import numpy as np

from compute.pose.filtering.imm_model import IMM_STATES
from compute.pose.filtering.second_order import CUBATURE_RADIUS, CURVATURE_SIGMA_FRACTION

_OF_FRAMES: Final = {
    # ImmState before, predicted and after, the results, and what is reported of the pose; then
    # (S, P) of the frame's peaks.
    "before": "const double*",
    "predicted": "double*",
    "after": "double*",
    "result": "double*",
    "reported_pose": "double*",
    "position": "const double*",
    "variance": "const double*",
    "usable": "const unsigned char*",
}
_OF_TOOLS: Final = {
    # The cameras (JOB of compute.reconstruction), (S, width, C) of the calibration's errors.
    "cameras": "const void*",
    "columns": "const double*",
    # Of the modes: (K, 18), (K, 18, 18), (K,), (5, K * 18 * 18).
    "states": "const double*",
    "initial_covariance": "const double*",
    "constant_velocity": "const double*",
    "terms": "const double*",
    # (M, 3) about the centroid; (S + 1,), by how many readings; memory to work in.
    "markers": "const double*",
    "limits": "const double*",
    "scratch": "double*",
}
_FRAME_COUNTS: Final = ("peaks", "lit")
"""Peaks of each sensor, and the marker that is lit; -1: none, the tool is only predicted."""
_TOOL_COUNTS: Final = ("modes", "errors", "own_errors")
_FRAME_NUMBERS: Final = ("time_s", "change", "manoeuvre")
_TOOL_NUMBERS: Final = ("gate", "radius", "focal")
_TOOL_PLACES: Final = ("middle", "tip")
"""The centroid in the tool's coordinates and the tip less it, (3,)."""

STEP: Final = np.dtype(
    [
        *((name, "<u8") for name in _OF_FRAMES),
        *((name, "<i8") for name in _FRAME_COUNTS),
        *((name, "<f8") for name in _FRAME_NUMBERS),
        *((name, "<u8") for name in _OF_TOOLS),
        *((name, "<i8") for name in _TOOL_COUNTS),
        *((name, "<f8") for name in _TOOL_NUMBERS),
        *((name, "<f8", (3,)) for name in _TOOL_PLACES),
    ]
)
"""One step of one tool; 64-bit words only. What changes from frame to frame comes first."""
FRAME_WORDS: Final = len(_OF_FRAMES) + len(_FRAME_COUNTS)
"""Addresses and counts of a frame; its numbers follow."""
FRAME_NUMBERS: Final = len(_FRAME_NUMBERS)

POSE: Final = 18
"""Rotation, centroid, velocity and turn rate; modes have their chances behind it, then how far
each is off the widest, and their spreads."""
FIGURES: Final = {
    "rotation": (3, 3),
    "angular_velocity_rad_s": (3,),
    "translation_mm": (3,),
    "covariance": (6, 6),
    "tip_mm": (3,),
    "tip_covariance_mm2": (3, 3),
    "velocity_mm_s": (3,),
}
"""Of ReportedPose, one after another."""
FIGURES_SIZE: Final = 66
HEAD: Final = 4
"""Of a result: what became of it, the number of readings, their NIS, and the widest mode's."""

TAKEN: Final = 0
"""Readings were taken, or there were none within the gates."""
CURVED: Final = 1
"""The curvature matters, and the covariance has no root: nothing but the prediction is there."""
CONTESTED: Final = 2
"""A sensor has several peaks within the gate: likewise."""
MISFIT: Final = 3
"""The readings do not fit one another: likewise."""


def imm_state_size(imm: int, errors: int) -> int:
    """Return how many numbers K modes with E common errors are."""
    return POSE + imm * (1 + IMM_STATES + IMM_STATES * (IMM_STATES + errors))


def result_size(sensors: int, errors: int) -> int:
    """Return how many numbers a result is.

    The head; which peak of each sensor was taken, -1: none; the state of all modes together;
    the whitened innovations, (n, 1 + E).
    """
    return HEAD + sensors + POSE + 144 + 12 * errors + sensors * (1 + errors)


def scratch_size(sensors: int, imm: int, errors: int) -> int:
    """Return how many numbers the kernel works in."""
    wide = IMM_STATES + errors
    mixing = imm * imm + IMM_STATES * IMM_STATES + IMM_STATES
    readings = sensors * (errors + wide) + imm * (sensors * (1 + wide) + 2)
    return mixing + readings + IMM_STATES * wide


def _listed(kinds: dict[str, str]) -> str:
    return "".join(f"\n        {kind} {name};" for name, kind in kinds.items())


ARGUMENTS_SOURCE: Final = f"""
    struct Step {{{_listed(_OF_FRAMES)}
        long long {", ".join(_FRAME_COUNTS)};
        double {", ".join(_FRAME_NUMBERS)};{_listed(_OF_TOOLS)}
        long long {", ".join(_TOOL_COUNTS)};
        double {", ".join(_TOOL_NUMBERS)};
        double {", ".join(f"{name}[3]" for name in _TOOL_PLACES)};
    }};
    const Step& step = *(const Step*)step_address;
    const unsigned long long job_address = (unsigned long long)step.cameras;
    const int D = {IMM_STATES}, pose_size = {POSE}, head = {HEAD};
    const int taken = {TAKEN}, curved = {CURVED}, contested = {CONTESTED}, misfit = {MISFIT};
    const double bent_share = {CURVATURE_SIGMA_FRACTION!r}, reach = {CUBATURE_RADIUS!r};
    const int K = (int)step.modes, E = (int)step.errors, W = D + E;
"""
"""Above it stand ``S``, the number of sensors, and ``ROOM``, as in compute.reconstruction."""
