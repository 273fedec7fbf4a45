"""Arguments of the triangulation kernel: addresses and sizes, for NumPy and C++."""

from typing import Final

from compute.native.records import Record

CAMERA_FIELDS: Final = 16
"""c, p0, the rotation row by row, x, y, z of the offset, D, and the row's distance."""
CPU_LANES: Final = 4
"""Sensors that the CPU takes together."""
MAX_POWER: Final = 15
"""Highest power of a field angle in a term of distortion."""

CAMERAS: Final = Record(
    "CameraRecord",
    {
        # With R sensors last: (16, R), (K, R); (K, 2).
        "models": "const double*",
        "coefficients": "const double*",
        "powers": "const int*",
        # Of the correction table, with R sensors last.
        "table_values": "const double*",
        "table_variance": "const double*",
        "table_valid": "const unsigned char*",
        "terms": "long long",
        "max_power": "long long",
        # Of the table; 0 without one.
        "degree": "long long",
        "cells": "long long[3]",
        "origin_mm": "double[3]",
        "pitch_mm": "double[3]",
    },
)
"""Cameras and their correction table, as all kernels take them; 64-bit words only."""

POINT_JOB: Final = Record(
    "PointJob",
    {
        # (N, S), (N, S); then what is written: (N, 3), (N, 9), (N,), (N, S), (N,).
        "readings": "const double*",
        "sigma": "const double*",
        "position": "double*",
        "covariance": "double*",
        "chi2": "double*",
        "used": "unsigned char*",
        "flags": "int*",
        # (S + 1,); (S w, S w) of the cameras' parameters, 0: without covariance.
        "chi2_limits": "const double*",
        "parameter_covariance": "const double*",
        "cameras": CAMERAS,
    },
)
"""One job: N points of one set of cameras; 64-bit words only."""
JOB: Final = POINT_JOB.dtype


def row_length(sensors: int, *, cuda: bool) -> int:
    """Return R, the padded length of rows with a value for each sensor.

    Args:
        sensors: number of sensors S.
        cuda: whether the rows are for CUDA, which needs no padding.
    """
    return sensors if cuda else -(-sensors // CPU_LANES) * CPU_LANES
