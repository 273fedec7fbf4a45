"""Cameras whose distortion moves readings by ten pixels, and tables that do as well."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from compute.camera.field_distortion import FieldDistortion, symmetric_terms
from compute.camera.model import SensorModel
from compute.mapping.grid import VoxelGrid
from compute.mapping.table import CorrectionTable, Degree
from tests.compute.rig import rig

Array = NDArray[np.float64]

GRID = VoxelGrid((-450.0, -450.0, 1150.0), (90.0, 100.0, 70.0), (10, 9, 10))


def distorted_rig(sensors: int = 4) -> tuple[SensorModel, ...]:
    """Sensors of which the last has no distortion and the others about 10 px at u = v = 0.3.

    The first has a term of its own.
    """
    models = list(rig(sensors))
    for index in range(sensors - 1):
        terms = symmetric_terms(5)
        coefficients = [0.06, 0.08, -0.1, 0.05, 0.03][: len(terms)]
        if index == 0:
            terms, coefficients = ((0, 2), *terms), [0.01, *coefficients]
        models[index] = replace(
            models[index],
            distortion=FieldDistortion(terms, tuple(coefficients), 15.0 * index - 40.0, 37.0),
        )
    return tuple(models)


def table(
    degree: Degree, sensors: int = 4, size_px: float = 10.0, seed: int = 3
) -> CorrectionTable:
    """Smooth corrections of this size, with variances of about (0.1 px)^2."""
    rng = np.random.default_rng(seed)
    shape = tuple(count + degree for count in GRID.cells)
    places = np.stack(np.meshgrid(*(np.linspace(-1.0, 1.0, n) for n in shape), indexing="ij"), -1)
    waves = rng.normal(size=(sensors, 3)) * 1.5
    phases = rng.uniform(0.0, 6.0, (sensors, 1, 1, 1))
    coefficients = size_px * np.sin(np.einsum("sa,xyza->sxyz", waves, places) + phases)
    nodes = (sensors, *(count + 1 for count in GRID.cells))
    return CorrectionTable(
        tuple(f"s{index + 1}" for index in range(sensors)),
        "0" * 64,
        GRID,
        degree,
        coefficients,
        rng.uniform(0.05, 0.15, nodes) ** 2,
        np.ones((sensors, *GRID.cells), dtype=np.bool_),
    )


def field_points(count: int, seed: int, extent_mm: float = 300.0) -> Array:
    """Points over the table's box, about 1.5 m away."""
    rng = np.random.default_rng(seed)
    return np.array([0.0, 0.0, 1500.0]) + rng.uniform(-extent_mm, extent_mm, (count, 3))
