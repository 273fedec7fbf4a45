"""Correction tables for tests."""

from datetime import UTC, datetime
from typing import Any

import numpy as np

from compute.mapping.grid import VoxelGrid
from compute.mapping.table import CorrectionTable, Degree
from service.api.correction_tables.table_content import TableContent

SENSORS = ("vertical", "horizontal", "diagonal-rising", "diagonal-falling")


def content(
    calibration_hash: str, sensors: tuple[str, ...] = SENSORS, degree: Degree = 3, **changes: Any
) -> TableContent:
    """A table of smooth corrections around the simulated device's working volume."""
    cells = (5, 4, 3)
    generator = np.random.default_rng(8)
    grid = VoxelGrid((-300.0, -300.0, 1300.0), (120.0, 150.0, 200.0), cells)
    arrays = {
        "coefficients_px": generator.normal(
            0.0, 2.0, (len(sensors), *(count + degree for count in cells))
        ),
        "variance_px2": np.full((len(sensors), *(count + 1 for count in cells)), 1e-4),
        "valid": np.ones((len(sensors), *cells), dtype=np.bool_),
    } | changes
    table = CorrectionTable(sensors, calibration_hash, grid, degree, **arrays)
    return TableContent(
        table,
        "sim",
        datetime(2026, 3, 1, 12, 30, tzinfo=UTC),
        {"interpolation": "b-spline", "pitch_mm": [120.0, 150.0, 200.0]},
        {"rms_px": 0.0123, "points": 200},
    )
