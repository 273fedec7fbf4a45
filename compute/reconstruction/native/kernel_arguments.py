"""What the kernel is given: a record of addresses and sizes, and its C++ counterpart."""

from typing import Final

import numpy as np

from compute.reconstruction.linear_triangulation import CONDITION_LIMIT
from compute.reconstruction.point_batch import PointFlag
from compute.reconstruction.triangulation import (
    CHI2_ROUNDING_FACTOR,
    DEGENERATE_RATIO,
    INITIAL_DAMPING,
    INTERSECTION_CHI2_TOLERANCE,
    MAX_DAMPING,
    MAX_ITERATIONS,
    STEP_TOLERANCE_MM,
    UNINFORMATIVE_SIGMA_RATIO,
    WEIGHTING_ITERATIONS,
)

CAMERA_FIELDS: Final = 16
"""c, p0, the rotation row by row, x, y, z of the offset, D, and the row's distance."""
CPU_LANES: Final = 4
"""Sensors that the CPU takes together."""
MAX_POWER: Final = 15
"""Highest power of a field angle in a term of distortion."""

_ADDRESSES: Final = {
    # Of the points: (N, S), (N, S); then what is written: (N, 3), (N, 9), (N,), (N, S), (N,).
    "readings": "const double*",
    "sigma": "const double*",
    "position": "double*",
    "covariance": "double*",
    "chi2": "double*",
    "used": "unsigned char*",
    "flags": "int*",
    # Of the cameras, with R sensors last: (16, R), (K, R), (K, 2), (S + 1,), (S w, S w).
    "cameras": "const double*",
    "coefficients": "const double*",
    "powers": "const int*",
    "limits": "const double*",
    "parameters": "const double*",
    # Of the table, with R sensors last; degree 0 without one.
    "values": "const double*",
    "variance": "const double*",
    "valid": "const unsigned char*",
}
_COUNTS: Final = ("terms", "top_power", "degree", "cells_x", "cells_y", "cells_z")

JOB: Final = np.dtype(
    [
        *((name, "<u8") for name in _ADDRESSES),
        *((name, "<i8") for name in _COUNTS),
        ("origin", "<f8", (3,)),
        ("pitch", "<f8", (3,)),
    ]
)
"""One job: N points of one set of cameras; 64-bit words only. ``parameters`` is 0 without
covariance."""

_NEWLINE: Final = "\n        "
JOB_SOURCE: Final = f"""
    // Sensors that are taken together, in rows of R: on the CPU filled up to whole vectors.
#if defined(__CUDA_ARCH__)
    typedef double Lanes;
    const int V = S, R = S;
#else
    typedef double Lanes __attribute__((vector_size({8 * CPU_LANES}), aligned(8), may_alias));
    const int V = (S + {CPU_LANES - 1}) / {CPU_LANES}, R = V * {CPU_LANES};
#endif
    struct Job {{
        {_NEWLINE.join(f"{kind} {name};" for name, kind in _ADDRESSES.items())}
        {_NEWLINE.join(f"long long {name};" for name in _COUNTS)}
        double origin[3], pitch[3];
    }};
    const int camera_fields = {CAMERA_FIELDS}, powers_room = {MAX_POWER + 1};
    const int too_few_sensors = {PointFlag.TOO_FEW_SENSORS:d};
    const int degenerate = {PointFlag.DEGENERATE:d}, no_convergence = {PointFlag.NO_CONVERGENCE:d};
    const int no_redundancy = {PointFlag.NO_REDUNDANCY:d};
    const int inconsistent = {PointFlag.INCONSISTENT:d}, outside_map = {PointFlag.OUTSIDE_MAP:d};
    const int first_steps = {WEIGHTING_ITERATIONS}, max_iterations = {MAX_ITERATIONS};
    const double first_damping = {INITIAL_DAMPING!r}, max_damping = {MAX_DAMPING!r};
    const double settled = {STEP_TOLERANCE_MM!r}, uninformative = {UNINFORMATIVE_SIGMA_RATIO!r};
    const double rounding = {CHI2_ROUNDING_FACTOR!r}, met_chi2 = {INTERSECTION_CHI2_TOLERANCE!r};
    const double condition_limit = {CONDITION_LIMIT!r}, degenerate_ratio = {DEGENERATE_RATIO!r};
    const Job& job = *(const Job*)job_address;
"""
"""Above it stand ``S``, the number of sensors, and ``ROOM``, how many terms there is room for."""


def row_length(sensors: int, *, cuda: bool) -> int:
    """Return R: the length of rows with a value for each sensor."""
    return sensors if cuda else -(-sensors // CPU_LANES) * CPU_LANES
