"""Records and constants of the association and prediction kernels, for NumPy and C++."""

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

PREDICTION: Final = Record(
    "PredictionJob",
    {
        # Of the tracks: (T, M, 9), (T, M, 9, 9), (T, M, 9, S), (T, M), and (T,).
        "mean": "const double*",
        "covariance": "const double*",
        "bias": "const double*",
        "probability": "const double*",
        "step_s": "const double*",
        # Results, of the same shapes.
        "predicted_mean": "double*",
        "predicted_covariance": "double*",
        "predicted_bias": "double*",
        "predicted_probability": "double*",
        # Their mixtures: (T, 9), (T, 9, 9), (T, 9, S); null: not wanted.
        "mixed_mean": "double*",
        "mixed_covariance": "double*",
        "mixed_bias": "double*",
        "tracks": "long long",
        "models": "long long",
        "sensors": "long long",
        # The model whose acceleration others without one take when they mix; -1: none does.
        "acceleration_source": "long long",
        "has_acceleration": "long long[2]",
        "noise_psd": "double[2]",
        "mean_sojourn_s": "double",
    },
)
"""Tracks that are predicted, each over its own time; 64-bit words only."""

HEADER: Final = header(
    "lumiline::tracking",
    ASSOCIATION.source,
    PREDICTION.source,
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
