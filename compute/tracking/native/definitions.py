"""Constants and records of the association kernel, for C++."""

from typing import Final

from compute.native.records import constants, header
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
from compute.tracking.native.kernel_arguments import (
    ASSOCIATION,
    MAX_OPTIONS,
    MAX_TRACKS,
    PARTIAL_BYTES,
)

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
            "max_given_up_fraction": PRUNED_WEIGHT_THRESHOLD,
            "lost_sigma_factor": LOST_SIGMA_FACTOR,
            "min_reported_probability": ASSOCIATION_PROBABILITY_THRESHOLD,
            "min_mode_probability": MIN_MODE_PROBABILITY,
            "max_iterations": MAX_ITERATIONS,
        }
    ),
    includes=("compute/reconstruction/native/definitions.gen.h",),
)
