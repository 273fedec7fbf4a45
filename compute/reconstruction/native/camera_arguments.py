"""What kernels are given of cameras and their correction table: the fields that records share."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.mapping.table import CorrectionTable
from compute.reconstruction.native.kernel_arguments import CAMERA_FIELDS

Array = NDArray[np.float64]
Put = Callable[[str, NDArray[Any]], None]
"""Keeps an array where the kernel reads it, and writes its address into the record's field."""


def fill_cameras(
    job: NDArray[np.void],
    put: Put,
    cameras: CameraStack,
    corrections: CorrectionTable | None,
    row: int,
) -> None:
    """Write cameras and table into a record with the fields of JOB, or with those that it has.

    Args:
        job: one record.
        put: for the arrays.
        cameras: S cameras.
        corrections: their table; None: none.
        row: length of rows with a value for each sensor, as of ``row_length``.
    """
    put("cameras", _filled(_fields(cameras), row))
    put("coefficients", _filled(cameras.coefficients.T, row))
    put("powers", np.array(cameras.terms, dtype=np.int32).reshape(-1, 2))
    job["terms"] = len(cameras.terms)
    job["top_power"] = max((max(term) for term in cameras.terms), default=0)
    if corrections is None:
        return
    has = job.dtype.names or ()
    for name, values in (
        ("values", corrections.coefficients_px),
        ("variance", corrections.variance_px2),
        ("valid", corrections.valid.astype(np.uint8)),
    ):
        if name in has:
            put(name, _filled(np.moveaxis(values, 0, -1), row))
    job["degree"] = corrections.degree
    job["cells_x"], job["cells_y"], job["cells_z"] = corrections.grid.cells
    job["origin"], job["pitch"] = corrections.grid.origin_mm, corrections.grid.pitch_mm


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
