"""Arguments of the association kernel: addresses, sizes and settings, for NumPy and C++."""

from typing import Final

from compute.native.records import Record
from compute.reconstruction.native.kernel_arguments import CAMERAS

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
        # What is written: (T, S), (T, S), (T, S), (T,), (T,), (T,), (T,); 0 before.
        "choice": "int*",
        "merged": "unsigned char*",
        "choice_probability": "double*",
        "nis": "double*",
        "evidence": "double*",
        "doubtful": "unsigned char*",
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
