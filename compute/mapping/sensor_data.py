"""SensorData: what is fitted of one sensor, and its normal equations."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.mapping.diagonalised_basis import DiagonalisedBasis
from compute.mapping.p_splines import PenalisedProblem

Array = NDArray[np.float64]

MAX_LEFT_OUT_BLOCKS = 2000
"""Blocks that are left out in turn, at most; of more, these are spread evenly over all."""
CHUNK = 4096
"""Points whose functions are held at once."""


@dataclass(frozen=True, eq=False)
class SensorData:
    """What is fitted of one sensor.

    Args:
        name: of the sensor.
        points_mm: measurements that it saw, shape (N, 3) [mm].
        numbers: theirs among all measurements, shape (N,).
        samples_px: projection less measurement, shape (N,) [px].
        variance_px2: of the measurements, shape (N,) [px^2]; ones where not known.
        known_variance: whether they are known.
        block: number of each measurement's block, shape (N,).
        parameter_jacobian: d reading / d parameters of the sensor at points (M, 3), shape (M, P).
        parameter_covariance: of the sensor's parameters, from other measurements, shape (P, P);
            None: these measurements made the calibration.
    """

    name: str
    points_mm: Array
    numbers: NDArray[np.intp]
    samples_px: Array
    variance_px2: Array
    known_variance: bool
    block: NDArray[np.intp]
    parameter_jacobian: Callable[[Array], Array]
    parameter_covariance: Array | None


def accumulate_equations(
    data: SensorData, functions: DiagonalisedBasis, parameter_transform: Array, precision: Array
) -> PenalisedProblem:
    """Gather the normal equations, chunk by chunk, and the blocks to leave out."""
    weight = 1.0 / np.sqrt(data.variance_px2)
    size = len(functions) + parameter_transform.shape[1]
    gram, product = np.zeros((size, size)), np.zeros(size)
    for start in range(0, len(weight), CHUNK):
        part = slice(start, start + CHUNK)
        rows = _whitened_rows(data, functions, parameter_transform, np.arange(len(weight))[part])
        gram += rows.T @ rows
        product += rows.T @ (data.samples_px[part] * weight[part])
    order, sizes = left_out_blocks(data.block)
    tested = _whitened_rows(data, functions, parameter_transform, order)
    square = float(((data.samples_px * weight) ** 2).sum())
    return PenalisedProblem(
        gram,
        product,
        square,
        len(weight),
        precision,
        tested,
        data.samples_px[order] * weight[order],
        sizes,
        data.known_variance,
    )


def left_out_blocks(block: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the measurements of the blocks that are left out, block after block, and sizes."""
    numbers, sizes = np.unique(block, return_counts=True)
    if len(numbers) > MAX_LEFT_OUT_BLOCKS:
        selection = np.linspace(0, len(numbers) - 1, MAX_LEFT_OUT_BLOCKS).astype(np.intp)
        numbers, sizes = numbers[selection], sizes[selection]
    order = np.argsort(block, kind="stable")
    return order[np.isin(block[order], numbers)], sizes


def _whitened_rows(
    data: SensorData,
    functions: DiagonalisedBasis,
    parameter_transform: Array,
    index: NDArray[np.intp],
) -> Array:
    points = data.points_mm[index]
    rows = stack_functions(functions, data.parameter_jacobian(points) @ parameter_transform, points)
    return rows / np.sqrt(data.variance_px2[index])[:, None]


def stack_functions(
    functions: DiagonalisedBasis, camera_functions: Array, points_mm: Array
) -> Array:
    """Return the functions at points (N, 3), and beside them those of the camera (N, Q)."""
    return np.concatenate([functions.values(points_mm), camera_functions], axis=1)
