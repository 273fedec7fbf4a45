"""What the kernel is given: a record of addresses, sizes and settings, and its C++ counterpart."""

from typing import Final

import numpy as np

from compute.reconstruction.native.kernel_arguments import CAMERA_FIELDS, CPU_LANES, MAX_POWER

MAX_TRACKS: Final = 64
"""Of a cluster, and peaks of one: they are bits of a word."""
MAX_OPTIONS: Final = 512
"""Ways in which the tracks of one cluster may be read."""

_ADDRESSES: Final = {
    # Of the tracks: (T, M, 9), (T, M, 9, 9), (T, M, 9, S), (T, M), changed; (T, S, S), read.
    "mean": "double*",
    "covariance": "double*",
    "with_bias": "double*",
    "probability": "double*",
    "bias": "const double*",
    # Of the peaks, (S, K).
    "position": "const double*",
    "noise": "const double*",
    "usable": "const unsigned char*",
    # What is written: (T, S), (T, S), (T, S), (T,), (T,), (T,), (T,); 0 before.
    "choice": "int*",
    "merged": "unsigned char*",
    "chance": "double*",
    "nis": "double*",
    "evidence": "double*",
    "doubtful": "unsigned char*",
    "in_view": "int*",
    # Memory to work in.
    "numbers": "double*",
    "marks": "unsigned char*",
    "partials": "unsigned char*",
    "order": "int*",
    # As of the kernel that makes points, the next three only for their source's sake; then the
    # first and last place of each sensor in view.
    "cameras": "const double*",
    "coefficients": "const double*",
    "powers": "const int*",
    "values": "const double*",
    "parameters": "const double*",
    "variance": "const double*",
    "valid": "const unsigned char*",
    "first": "const double*",
    "last": "const double*",
}
_COUNTS: Final = (
    "tracks",
    "models",
    "room",
    "failed",
    "max_hypotheses",
    "max_grown",
    "terms",
    "top_power",
    "degree",
    "cells_x",
    "cells_y",
    "cells_z",
)
_NUMBERS: Final = (
    "detection_probability",
    "clutter_density_per_px",
    "resolution_px",
    "gate_sigma",
    "max_prediction_sigma_px",
)

JOB: Final = np.dtype(
    [
        *((name, "<u8") for name in _ADDRESSES),
        *((name, "<i8") for name in _COUNTS),
        *((name, "<f8") for name in _NUMBERS),
        ("origin", "<f8", (3,)),
        ("pitch", "<f8", (3,)),
    ]
)
"""One frame; 64-bit words only. ``failed`` is set where there was not room enough."""

PARTIAL_BYTES: Final = 32 + 2 * MAX_TRACKS
"""Of a partial hypothesis."""

_NEWLINE: Final = "\n        "
JOB_SOURCE: Final = f"""
    // Kept as functions: copied to wherever they are called, they take ten seconds to compile.
#define APART __attribute__((noinline))
    typedef double Lanes __attribute__((vector_size({8 * CPU_LANES}), aligned(8), may_alias));
    const int V = (S + {CPU_LANES - 1}) / {CPU_LANES}, R = V * {CPU_LANES};
    struct Job {{
        {_NEWLINE.join(f"{kind} {name};" for name, kind in _ADDRESSES.items())}
        {_NEWLINE.join(f"long long {name};" for name in _COUNTS)}
        double {", ".join(_NUMBERS)};
        double origin[3], pitch[3];
    }};
    const int camera_fields = {CAMERA_FIELDS}, powers_room = {MAX_POWER + 1};
    const int max_tracks = {MAX_TRACKS}, max_options = {MAX_OPTIONS};
    Job& job = *(Job*)job_address;
"""
