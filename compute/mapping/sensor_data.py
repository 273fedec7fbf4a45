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


@dataclass(frozen=True, eq=False)
class CorrectionFunctions:
    """Functions of which a correction is composed: R penalised ones and Q of the camera.

    Args:
        functions: the penalised functions.
        parameter_jacobian: as in SensorData.
        parameter_transform: from the camera's parameters to its Q functions, shape (P, Q).
        precision: prior precisions of these, shape (Q,).
    """

    functions: DiagonalisedBasis
    parameter_jacobian: Callable[[Array], Array]
    parameter_transform: Array
    precision: Array

    def values(self, points_mm: Array) -> Array:
        """Evaluate all functions at points (N, 3), shape (N, R + Q)."""
        of_camera = self.parameter_jacobian(points_mm) @ self.parameter_transform
        return np.concatenate([self.functions.values(points_mm), of_camera], axis=1)

    def in_chunks(self, points_mm: Array, reduce: Callable[[Array], Array]) -> Array:
        """Evaluate all functions at points in chunks, and reduce them to one value a point, (N,).

        Args:
            points_mm: shape (N, 3) [mm].
            reduce: takes the functions at a chunk's points, shape (n, R + Q), and returns shape
                (n,).
        """
        starts = range(0, len(points_mm), CHUNK)
        return np.concatenate(
            [reduce(self.values(points_mm[start : start + CHUNK])) for start in starts]
        )


def accumulate_equations(data: SensorData, model: CorrectionFunctions) -> PenalisedProblem:
    """Accumulate the normal equations in chunks, and the blocks to leave out.

    Args:
        data: the samples.
        model: the functions.
    """
    weight = 1.0 / np.sqrt(data.variance_px2)
    size = len(model.functions) + len(model.precision)
    gram, product = np.zeros((size, size)), np.zeros(size)
    for start in range(0, len(weight), CHUNK):
        part = slice(start, start + CHUNK)
        rows = model.values(data.points_mm[part]) / np.sqrt(data.variance_px2[part])[:, None]
        gram += rows.T @ rows
        product += rows.T @ (data.samples_px[part] * weight[part])
    order, sizes = left_out_blocks(data.block)
    return PenalisedProblem(
        gram,
        product,
        float(((data.samples_px * weight) ** 2).sum()),
        len(weight),
        model.precision,
        model.values(data.points_mm[order]) / np.sqrt(data.variance_px2[order])[:, None],
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
