"""Definitions that Python and C++ share: argument record of the strobed-step kernel, constants."""

from typing import Final

from compute.native.records import Record, constants, header
from compute.pose.estimation.pose_reliability import PIVOT_FLOOR
from compute.pose.filtering.association import MAX_EXCLUDED_NIS, NEAR_MISS_PX
from compute.pose.filtering.imm import IMM_STATES
from compute.pose.filtering.second_order import CUBATURE_RADIUS, CURVATURE_SIGMA_FRACTION
from compute.pose.settings import POSE_PARAMETERS
from compute.reconstruction.native.definitions import CAMERAS
from compute.reliability import REDUNDANCY_FLOOR

_OF_FRAMES: Final = {
    # States before, predicted and after, results and reported pose; then the frame's peaks,
    # (S, P).
    "before": "const double*",
    "predicted": "double*",
    "after": "double*",
    "result": "double*",
    "reported_pose": "double*",
    "position": "const double*",
    "variance": "const double*",
    "usable": "const unsigned char*",
    # Number of peaks of each sensor, and the lit marker; -1: none, prediction only.
    "peaks": "long long",
    "lit": "long long",
}
_NUMBERS_OF_FRAMES: Final = {
    "time_s": "double",
    "switch_probability": "double",
    "manoeuvre_factor": "double",
}
_OF_TOOLS: Final[dict[str, str | Record]] = {
    # Covariance factor of the calibration, (S, width, C).
    "columns": "const double*",
    # Motion models: (K, 18), (K, 18, 18), (K,), (5, K * 18 * 18).
    "persistence": "const double*",
    "initial_covariance": "const double*",
    "renewal": "const double*",
    "terms": "const double*",
    # (M, 3) relative to the centroid; (S + 1,), by number of readings; scratch memory.
    "markers": "const double*",
    "chi2_limits": "const double*",
    "scratch": "double*",
    "modes": "long long",
    "errors": "long long",
    "calibration_errors": "long long",
    "gate": "double",
    "radius_mm": "double",
    "principal_distance_px": "double",
    # The centroid in the tool's coordinates and the tip less it.
    "centroid": "double[3]",
    "tip": "double[3]",
    "cameras": CAMERAS,
}

STEP_RECORD: Final = Record("StepRecord", {**_OF_FRAMES, **_NUMBERS_OF_FRAMES, **_OF_TOOLS})
"""Argument record of one step of one tool; 64-bit words only. Members that change from frame to
frame come first."""
STEP: Final = STEP_RECORD.dtype
FRAME_RECORD: Final = Record(
    "FrameRecord", {"steps": "const unsigned long long*", "count": "long long"}
)
"""Argument record of a launch: addresses of the tools' records, and their number."""
FRAME: Final = FRAME_RECORD.dtype
RELIABILITY_RECORD: Final = Record(
    "ReliabilityRecord",
    {
        "step": "StepRecord*",
        # Which sensor's reading of which marker the pose rests on, and sigmas, (M, S).
        "used": "const unsigned char*",
        "sigma": "const double*",
        "scratch": "double*",
        "markers": "long long",
        "readings": "long long",
        "noncentrality": "double",
        # Rotation and centroid.
        "pose": "double[12]",
        # Results: whether there are any; the index of the reading with the largest detectable
        # error in (M, S).
        "solved": "long long",
        "worst": "long long",
        "detectable_sigma": "double",
        "external_tip_mm": "double",
        "external_rotation_rad": "double",
    },
)
"""Argument record of the reliability of one pose."""
RELIABILITY: Final = RELIABILITY_RECORD.dtype
FRAME_FORMAT: Final = "=" + "".join(
    {"double": "d", "long long": "q"}.get(kind, "Q")
    for kind in (_OF_FRAMES | _NUMBERS_OF_FRAMES).values()
)
"""Members of a STEP that change from frame to frame, as ``struct`` packs them."""

POSE: Final = 18
"""Number of values of rotation, centroid, velocity and angular velocity. In an ImmState the mode
probabilities, offsets and covariances follow."""
HEAD: Final = 3
"""Number of values at the head of a result: outcome, number of readings, and their NIS."""
UPDATED: Final = 0
"""Outcome: readings were used, or there were none within the gates."""
MISFIT: Final = 1
"""Outcome: readings within the gates do not fit one another, and none was used."""
_PREDICTION_ONLY: Final = {
    # A covariance has no Cholesky factor.
    "status_indefinite": 2,
    # A sensor has several peaks within the gate.
    "status_contested": 3,
}
"""Outcomes that set only the prediction."""

HEADER: Final = header(
    "lumiline::pose",
    STEP_RECORD.source,
    FRAME_RECORD.source,
    RELIABILITY_RECORD.source,
    constants(
        {
            "D": IMM_STATES,
            "pose_size": POSE,
            "pose_parameters": POSE_PARAMETERS,
            "redundancy_floor": REDUNDANCY_FLOOR,
            "pivot_floor": PIVOT_FLOOR,
            "head_size": HEAD,
            "status_updated": UPDATED,
            "status_misfit": MISFIT,
            **_PREDICTION_ONLY,
            "max_curvature_fraction": CURVATURE_SIGMA_FRACTION,
            "sigma_point_reach": CUBATURE_RADIUS,
            "near_miss_px": NEAR_MISS_PX,
            "max_excluded_nis": MAX_EXCLUDED_NIS,
        }
    ),
    includes=("compute/reconstruction/native/definitions.gen.h",),
)
