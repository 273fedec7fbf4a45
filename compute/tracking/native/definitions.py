"""Records and constants of the association kernel, for NumPy and C++."""

from typing import Final

from compute.native.records import Record, constants, header
from compute.reconstruction.native.definitions import CAMERAS
from compute.tracking.association import (
    ASSOCIATION_PROBABILITY_THRESHOLD,
    LOST_SIGMA_FACTOR,
    MAX_ITERATIONS,
    PRUNED_WEIGHT_THRESHOLD,
    RELINEARISATION_STEP_MM,
    SUSPECT_RESIDUAL_SIGMA,
)
from compute.tracking.joint_events import (
    MIN_MERGE_PROBABILITY,
    NEGLIGIBLE_WEIGHT_RATIO,
    SHARE_FRACTION_VARIANCE,
    SHARED_PEAK_REACH,
)
from compute.tracking.motion_model import MIN_MODE_PROBABILITY

MAX_TRACKS: Final = 64
"""Of a cluster, and peaks of one: they are bits of a word."""
MAX_OPTIONS: Final = 512
"""Ways in which the tracks of one cluster may be read."""

ASSOCIATION: Final = Record(
    "AssociationJob",
    {
        # Of the tracks: (T, M, 9), (T, M, 9, 9), (T, M, 9, S), (T, M), changed; (T, S, S), read.
        "mean": "double*",
        "covariance": "double*",
        "with_bias": "double*",
        "mode_probability": "double*",
        "bias": "const double*",
        # Of the peaks, (S, K).
        "position": "const double*",
        "noise": "const double*",
        "usable": "const unsigned char*",
        # Results: (T, S), (T, S), (T, S), (T,), (T,), (T,), (T,); 0 before.
        "choice": "int*",
        "merged": "unsigned char*",
        "choice_probability": "double*",
        "nis": "double*",
        "evidence": "double*",
        "hypotheses_pruned": "unsigned char*",
        "in_view": "int*",
        # Memory to work in.
        "numbers": "double*",
        "marks": "unsigned char*",
        "partials": "unsigned char*",
        "order": "int*",
        # The first and last position of each sensor in view.
        "first": "const double*",
        "last": "const double*",
        "tracks": "long long",
        "models": "long long",
        "room": "long long",
        "failed": "long long",
        "max_hypotheses": "long long",
        "max_grown": "long long",
        "detection_probability": "double",
        "clutter_density_per_px": "double",
        "resolution_px": "double",
        "gate_sigma": "double",
        "max_prediction_sigma_px": "double",
        "cameras": CAMERAS,
    },
)
"""One frame; 64-bit words only. ``failed`` is set where there was not room enough."""
JOB: Final = ASSOCIATION.dtype

PARTIAL_BYTES: Final = 32 + 2 * MAX_TRACKS
"""Of a partial hypothesis."""

HEADER: Final = header(
    "lumiline::tracking",
    ASSOCIATION.source,
    constants(
        {
            "max_cluster_tracks": MAX_TRACKS,
            "max_options": MAX_OPTIONS,
            "partial_event_bytes": PARTIAL_BYTES,
            "merged_variance_factor": SHARE_FRACTION_VARIANCE,
            "min_relative_weight": NEGLIGIBLE_WEIGHT_RATIO,
            "min_merge_probability": MIN_MERGE_PROBABILITY,
            "neighbour_reach": SHARED_PEAK_REACH,
            "suspect_sigma": SUSPECT_RESIDUAL_SIGMA,
            "relinearisation_mm": RELINEARISATION_STEP_MM,
            "max_pruned_fraction": PRUNED_WEIGHT_THRESHOLD,
            "lost_sigma_factor": LOST_SIGMA_FACTOR,
            "min_reported_probability": ASSOCIATION_PROBABILITY_THRESHOLD,
            "min_mode_probability": MIN_MODE_PROBABILITY,
            "max_iterations": MAX_ITERATIONS,
        }
    ),
    includes=("compute/reconstruction/native/definitions.gen.h",),
)
