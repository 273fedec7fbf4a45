"""What the kernel of a strobed tool's step is given: a record of addresses, sizes and numbers."""

from typing import Final

from compute.native.records import Record
from compute.pose.filtering.imm_model import IMM_STATES
from compute.reconstruction.native.kernel_arguments import CAMERAS

_OF_FRAMES: Final = {
    # Modes before, predicted and after, the results, and what is reported of the pose; then
    # (S, P) of the frame's peaks.
    "before": "const double*",
    "predicted": "double*",
    "after": "double*",
    "result": "double*",
    "reported_pose": "double*",
    "position": "const double*",
    "variance": "const double*",
    "usable": "const unsigned char*",
    # Peaks of each sensor, and the marker that is lit; -1: none, the tool is only predicted.
    "peaks": "long long",
    "lit": "long long",
}
_NUMBERS_OF_FRAMES: Final = {
    "time_s": "double",
    "switch_probability": "double",
    "manoeuvre_factor": "double",
}
_OF_TOOLS: Final[dict[str, str | Record]] = {
    # (S, width, C) of the calibration's errors.
    "columns": "const double*",
    # Of the modes: (K, 18), (K, 18, 18), (K,), (5, K * 18 * 18).
    "persistence": "const double*",
    "initial_covariance": "const double*",
    "renewal": "const double*",
    "terms": "const double*",
    # (M, 3) about the centroid; (S + 1,), by how many readings; memory to work in.
    "markers": "const double*",
    "chi2_limits": "const double*",
    "scratch": "double*",
    "modes": "long long",
    "errors": "long long",
    "own_errors": "long long",
    "gate": "double",
    "radius_mm": "double",
    "principal_distance_px": "double",
    # The centroid in the tool's coordinates and the tip less it.
    "centroid": "double[3]",
    "tip": "double[3]",
    "cameras": CAMERAS,
}

STEP_RECORD: Final = Record("StepRecord", {**_OF_FRAMES, **_NUMBERS_OF_FRAMES, **_OF_TOOLS})
"""One step of one tool; 64-bit words only. What changes from frame to frame comes first."""
STEP: Final = STEP_RECORD.dtype
FRAME_WORDS: Final = len(_OF_FRAMES)
"""Addresses and counts of a frame; its numbers follow."""
FRAME_NUMBERS: Final = len(_NUMBERS_OF_FRAMES)

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
