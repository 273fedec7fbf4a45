"""Cameras and their correction table as the record that kernels read."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.mapping.table import CorrectionTable
from compute.reconstruction.native.kernel_arguments import CAMERA_FIELDS

Array = NDArray[np.float64]
Keep = Callable[[NDArray[Any]], int]
"""Keeps an array where the kernel reads it, and returns its address there."""


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
