"""SensorData: one sensor's samples for the fit, and their normal equations."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.mapping.diagonalised_basis import DiagonalisedBasis
from compute.mapping.p_splines import PenalisedProblem

Array = NDArray[np.float64]

MAX_LEFT_OUT_BLOCKS = 2000
"""Largest number of left-out blocks; of more, evenly spaced ones are taken."""
CHUNK = 4096
"""Number of points whose functions are in memory at once."""


@dataclass(frozen=True, eq=False)
class SensorData:
    """One sensor's samples.

    Args:
        name: the sensor's name.
        points_mm: measurements that it saw, shape (N, 3) [mm].
        numbers: their indices among all measurements, shape (N,).
        samples_px: projection minus measurement, shape (N,) [px].
        variance_px2: of the measurements, shape (N,) [px^2]; ones where unknown.
        known_variance: whether the variances are known.
        block: index of each measurement's block, shape (N,).
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
    """Accumulate the normal equations in chunks, and the blocks to leave out.

    Args:
        data: the samples.
        functions: the R penalised functions.
        parameter_transform: from the camera's parameters to Q functions, shape (P, Q).
        precision: prior precisions of the Q functions, shape (Q,).
    """
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
    """Return the samples of the blocks that are left out, block after block, and the sizes."""
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
    """Evaluate the functions at points and append those of the camera.

    Args:
        functions: the R penalised functions.
        camera_functions: values of the camera's functions, shape (N, Q).
        points_mm: shape (N, 3) [mm].

    Returns:
        Shape (N, R + Q).
    """
    return np.concatenate([functions.values(points_mm), camera_functions], axis=1)
