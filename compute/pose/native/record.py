"""What the kernel of a strobed tool's step is given: a record of addresses, sizes and numbers."""

from typing import Final

import numpy as np

from compute.pose.curvature import BENT_SHARE, REACH
from compute.pose.regime_model import MOVING

_OF_FRAMES: Final = {
    # Regimes before, predicted and after, the results, and what is reported of the pose; then
    # (S, P) of the frame's peaks.
    "before": "const double*",
    "predicted": "double*",
    "after": "double*",
    "result": "double*",
    "figures": "double*",
    "position": "const double*",
    "variance": "const double*",
    "usable": "const unsigned char*",
}
_OF_TOOLS: Final = {
    # The cameras (JOB of compute.reconstruction), (S, width, C) of the calibration's errors.
    "cameras": "const void*",
    "columns": "const double*",
    # Of the regimes: (K, 18), (K, 18, 18), (K,), (5, K * 18 * 18).
    "states": "const double*",
    "begun": "const double*",
    "brief": "const double*",
    "terms": "const double*",
    # (M, 3) about the centroid; (S + 1,), by how many readings; memory to work in.
    "markers": "const double*",
    "limits": "const double*",
    "scratch": "double*",
}
_FRAME_COUNTS: Final = ("peaks", "lit")
"""Peaks of each sensor, and the marker that is lit; -1: none, the tool is only predicted."""
_TOOL_COUNTS: Final = ("regimes", "errors", "own_errors")
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
"""Rotation, centroid, velocity and turn rate; regimes have their chances behind it, then how far
each is off the widest, and their spreads."""
FIGURES: Final = {
    "rotation": (3, 3),
    "turn_rate_rad_s": (3,),
    "translation_mm": (3,),
    "covariance": (6, 6),
    "tip_mm": (3,),
    "tip_covariance_mm2": (3, 3),
    "velocity_mm_s": (3,),
}
"""Of PoseFigures, one after another."""
FIGURES_SIZE: Final = 66
HEAD: Final = 4
"""Of a result: what became of it, the number of readings, their NIS, and the widest regime's."""

TAKEN: Final = 0
"""Readings were taken, or there were none within the gates."""
CURVED: Final = 1
"""The curvature matters, and the covariance has no root: nothing but the prediction is there."""
CONTESTED: Final = 2
"""A sensor has several peaks within the gate: likewise."""
MISFIT: Final = 3
"""The readings do not fit one another: likewise."""


def regimes_size(regimes: int, errors: int) -> int:
    """Return how many numbers K regimes with E common errors are."""
    return POSE + regimes * (1 + MOVING + MOVING * (MOVING + errors))


def result_size(sensors: int, errors: int) -> int:
    """Return how many numbers a result is.

    The head; which peak of each sensor was taken, -1: none; the state of all regimes together;
    the whitened innovations, (n, 1 + E).
    """
    return HEAD + sensors + POSE + 144 + 12 * errors + sensors * (1 + errors)


def scratch_size(sensors: int, regimes: int, errors: int) -> int:
    """Return how many numbers the kernel works in."""
    wide = MOVING + errors
    mixing = regimes * regimes + MOVING * MOVING + MOVING
    readings = sensors * (errors + wide) + regimes * (sensors * (1 + wide) + 2)
    return mixing + readings + MOVING * wide


def _listed(kinds: dict[str, str]) -> str:
    return "".join(f"\n        {kind} {name};" for name, kind in kinds.items())


STEP_SOURCE: Final = f"""
    struct Step {{{_listed(_OF_FRAMES)}
        long long {", ".join(_FRAME_COUNTS)};
        double {", ".join(_FRAME_NUMBERS)};{_listed(_OF_TOOLS)}
        long long {", ".join(_TOOL_COUNTS)};
        double {", ".join(_TOOL_NUMBERS)};
        double {", ".join(f"{name}[3]" for name in _TOOL_PLACES)};
    }};
    const Step& step = *(const Step*)step_address;
    const unsigned long long job_address = (unsigned long long)step.cameras;
    const int D = {MOVING}, pose_size = {POSE}, head = {HEAD};
    const int taken = {TAKEN}, curved = {CURVED}, contested = {CONTESTED}, misfit = {MISFIT};
    const double bent_share = {BENT_SHARE!r}, reach = {REACH!r};
    const int K = (int)step.regimes, E = (int)step.errors, W = D + E;
"""
"""Above it stand ``S``, the number of sensors, and ``ROOM``, as in compute.reconstruction."""
