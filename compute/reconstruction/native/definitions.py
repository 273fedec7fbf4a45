"""Records and constants of the kernels' cameras and of the triangulation kernel."""

from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.mapping.table import MAX_GROWTH_CELLS, CorrectionTable
from compute.native.records import Record, constants, header
from compute.reconstruction.point_batch import PointFlag
from compute.reconstruction.triangulation import (
    CHI2_ROUNDING_FACTOR,
    CONDITION_LIMIT,
    DEGENERATE_RATIO,
    INITIAL_DAMPING,
    INTERSECTION_CHI2_TOLERANCE,
    MAX_DAMPING,
    MAX_ITERATIONS,
    STEP_TOLERANCE_MM,
    UNINFORMATIVE_SIGMA_RATIO,
    WEIGHTING_ITERATIONS,
)
from compute.reliability import REDUNDANCY_FLOOR

Array = NDArray[np.float64]
Keep = Callable[[NDArray[Any]], int]
"""Keeps an array where the kernel reads it, and returns its address there."""

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
        # (N, S), (N, S); then what is written: (N, 3), (N, 9), (N,), (N,), (N, S), (N,).
        "readings": "const double*",
        "sigma": "const double*",
        "position": "double*",
        "covariance": "double*",
        "chi2": "double*",
        "external_reliability": "double*",
        "used": "unsigned char*",
        "flags": "int*",
        # (S + 1,), (S + 1,); (S w, S w) of the cameras' parameters, 0: without covariance.
        "chi2_limits": "const double*",
        "noncentralities": "const double*",
        "parameter_covariance": "const double*",
        "cameras": CAMERAS,
    },
)
"""One job: N points of one set of cameras; 64-bit words only."""
JOB: Final = POINT_JOB.dtype

HEADER: Final = header(
    "lumiline",
    CAMERAS.source,
    POINT_JOB.source,
    constants(
        {
            "cpu_lanes": CPU_LANES,
            "power_capacity": MAX_POWER + 1,
            "flag_too_few_sensors": PointFlag.TOO_FEW_SENSORS,
            "flag_degenerate": PointFlag.DEGENERATE,
            "flag_no_convergence": PointFlag.NO_CONVERGENCE,
            "flag_no_redundancy": PointFlag.NO_REDUNDANCY,
            "flag_inconsistent": PointFlag.INCONSISTENT,
            "flag_outside_map": PointFlag.OUTSIDE_MAP,
            "flag_no_covariance": PointFlag.NO_COVARIANCE,
            "max_growth_cells": MAX_GROWTH_CELLS,
            "max_initial_iterations": WEIGHTING_ITERATIONS,
            "max_iterations": MAX_ITERATIONS,
            "initial_damping": INITIAL_DAMPING,
            "max_damping": MAX_DAMPING,
            "step_tolerance_mm": STEP_TOLERANCE_MM,
            "max_sigma_ratio": UNINFORMATIVE_SIGMA_RATIO,
            "chi2_rounding": CHI2_ROUNDING_FACTOR,
            "max_exact_chi2": INTERSECTION_CHI2_TOLERANCE,
            "min_condition": CONDITION_LIMIT,
            "min_singular_ratio": DEGENERATE_RATIO,
            "min_redundancy": REDUNDANCY_FLOOR,
        }
    ),
)


def row_length(sensors: int, *, cuda: bool) -> int:
    """Return R, the padded length of rows with a value for each sensor.

    Args:
        sensors: number of sensors S.
        cuda: whether the rows are for CUDA, which needs no padding.
    """
    return sensors if cuda else -(-sensors // CPU_LANES) * CPU_LANES


def fill_cameras(
    record: NDArray[np.void],
    keep: Keep,
    cameras: CameraStack,
    corrections: CorrectionTable | None,
    row: int,
) -> None:
    """Write cameras and their correction table into a CAMERAS record.

    Args:
        record: the record.
        keep: for the arrays.
        cameras: S cameras.
        corrections: their table; None: none.
        row: length of rows with a value for each sensor, as of ``row_length``.
    """
    record["models"] = keep(_filled(_fields(cameras), row))
    record["coefficients"] = keep(_filled(cameras.coefficients.T, row))
    record["powers"] = keep(np.array(cameras.terms, dtype=np.int32).reshape(-1, 2))
    record["terms"] = len(cameras.terms)
    record["max_power"] = max((max(term) for term in cameras.terms), default=0)
    if corrections is None:
        return
    for name, values in (
        ("table_values", corrections.coefficients_px),
        ("table_variance", corrections.variance_px2),
        ("table_valid", corrections.valid.astype(np.uint8)),
    ):
        record[name] = keep(_filled(np.moveaxis(values, 0, -1), row))
    record["degree"] = corrections.degree
    record["cells"] = corrections.grid.cells
    record["origin_mm"], record["pitch_mm"] = corrections.grid.origin_mm, corrections.grid.pitch_mm


def _filled(values: NDArray[Any], row: int) -> NDArray[Any]:
    """Return values with the sensors last, filled up with zeros to rows of this length."""
    filled = np.zeros((*values.shape[:-1], row), dtype=values.dtype)
    filled[..., : values.shape[-1]] = values
    return filled


def _fields(cameras: CameraStack) -> Array:
    """Return the cameras' parameters with the sensors last, shape (16, S)."""
    fields = np.concatenate(
        [
            cameras.principal_distance_px[None],
            cameras.principal_point_px[None],
            cameras.rotation.reshape(-1, 9).T,
            cameras.offset_mm.T,
            cameras.cubic_per_px2[None],
            cameras.row_behind_mm[None],
        ]
    )
    assert len(fields) == CAMERA_FIELDS
    return fields
